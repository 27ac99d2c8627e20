"""``stereorig simstage``: a simulated motion controller on a line of its own."""

from __future__ import annotations

import argparse
import threading

from stereorig.core.errors import InputError
from stereorig.server.cli.ports import check_port, port_unusable
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Run a simulated controller that speaks the real one's language on a TCP port of this machine or a pty, until "
        "interrupted: to try real cameras without a stage, or a driver of your own. Its url goes into [stage]."
    )
    add = parser.add_argument
    add("--driver", choices=["esp301", "smc100", "conex-cc"], default="esp301", help="which one (default: esp301)")
    add("--axes", type=int, nargs="+", default=[1, 2], help="axes or addresses (default: 1 2)")
    add("--port", type=int, default=5301, help="TCP port on 127.0.0.1, 0 for any (default: 5301)")
    add("--pty", action="store_true", help="a pseudo terminal in place of a TCP port")
    add(
        "--travel",
        type=float,
        nargs=2,
        default=[-12.0, 12.0],
        metavar=("LOW", "HIGH"),
        help="travel in mm from home (default: -12 12)",
    )


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    highest = 3 if args.driver == "esp301" else 31
    if not all(1 <= axis <= highest for axis in args.axes):
        raise InputError(f"--axes {args.axes} are not all from 1 to {highest}.")
    check_port(args)
    if not args.travel[0] < 0.0 < args.travel[1]:
        raise InputError(f"--travel {args.travel} does not extend to both sides of home, 0.")
    controller = make_controller(args.driver, args.axes, travel_mm=tuple(args.travel))
    try:
        server = ControllerServer(controller, "pty" if args.pty else "socket", port=args.port).start()
    except OSError as error:
        raise port_unusable(str(args.port), error) from error
    with server:
        print(f'simulated {args.driver} with axes {args.axes}: url = "{server.url}"', flush=True)
        threading.Event().wait()
    return 0
