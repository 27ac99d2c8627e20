"""``stereorig simframe``: a simulated load frame that pulls the strip of a simulated rig."""

from __future__ import annotations

import argparse
import threading

from stereorig.server.cli.operation.live import add_service, client_of
from stereorig.server.cli.ports import check_port, port_unusable
from stereorig.sim.load_frame import LoadFrame


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
    check_port(args)
    with client_of(args) as client:

        def pull(strain: float) -> None:
            client.call("PUT", "/sim/scene", json={"scene": "strip", "load": 100.0 * strain})

        pull(0.0)
        try:
            frame = LoadFrame(pull, port=args.port)
        except OSError as error:
            raise port_unusable(str(args.port), error) from error
        with frame:
            print(f"simulated load frame on 127.0.0.1:{frame.port}", flush=True)
            threading.Event().wait()
    return 0
