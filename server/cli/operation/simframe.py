"""``stereorig simframe``: a simulated load frame that pulls the strip of a simulated rig."""

from __future__ import annotations

import argparse
import threading

from core.errors import InputError
from server.cli.operation.live import add_service, client_of
from sim.load_frame import LoadFrame


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Run a simulated load frame on a TCP port of this machine until interrupted: it takes RATE, HOLD, POS? and "
        "FORCE? as lines, and pulls the strip before the cameras of a service with a simulated rig."
    )
    parser.add_argument("--port", type=int, default=5026, help="TCP port on 127.0.0.1, 0 for any (default: 5026)")
    add_service(parser)


def run(args: argparse.Namespace) -> int:
    """Serve the load frame until interrupted."""
    if not 0 <= args.port <= 65535:
        raise InputError(f"--port {args.port} is not from 0 to 65535.")
    with client_of(args) as client:

        def pull(strain: float) -> None:
            client.call("PUT", "/sim/scene", json={"scene": "strip", "load": 100.0 * strain})

        pull(0.0)
        try:
            frame = LoadFrame(pull, port=args.port)
        except OSError as error:
            raise InputError(
                f"Port {args.port} cannot be used: {error}.",
                code="port_unusable",
                remedy="Give another --port; 0 takes any.",
            ) from error
        with frame:
            print(f"simulated load frame on 127.0.0.1:{frame.port}", flush=True)
            threading.Event().wait()
    return 0
