"""Entry point: picks the subcommand, turns every expected error into one line and an exit status."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from core.errors import Cancelled, StereorigError
from server.base.library_threads import one_library_thread
from server.base.memory import go_on, hurry
from server.formats.version import software_version
from server.worker.kernel_compiler import compiled_aside

# name -> (module, one-line help); each module has add_arguments(parser) and run(args) -> int,
# and is imported only when it is asked for, so that `--help` and errors in one do not wait for the others
COMMANDS: dict[str, tuple[str, str]] = {
    "serve": ("server.cli.operation.serve", "start the service"),
    "keys": ("server.cli.operation.keys", "make, list and remove keys for the service"),
    "demo": ("server.cli.operation.demo", "run one of the paper's experiments on the simulated rig, over HTTP"),
    "devices": ("server.cli.operation.devices", "list cameras and serial ports, and what is wrong with them"),
    "doctor": ("server.cli.operation.doctor", "check the whole bench: cameras, stage, disk, machine"),
    "rigfile": ("server.cli.operation.rigfile", "check rig files; print every key with its meaning"),
    "simstage": ("server.cli.operation.simstage", "run a simulated motion controller on a socket or pty"),
    "simframe": ("server.cli.operation.simframe", "run a simulated load frame that pulls the strip of a simulated rig"),
    "live": ("server.cli.operation.live", "measure a test while it runs: begin, show, stop"),
    "calibrate": ("server.cli.measurement.calibrate", "calibrate a pair of cameras from grid images"),
    "expect": ("server.cli.operation.expect", "predict what a planned measurement will leave uncertain"),
    "channels": ("server.cli.operation.channels", "a load frame's record, aligned with the steps of a test by time"),
    "guide": ("server.cli.operation.guide", "calibrate on a running service from a target held by hand"),
    "noise": ("server.cli.measurement.noise", "measure the cameras' noise from repeated frames"),
    "measure": ("server.cli.measurement.measure", "measure shape and displacement from image files"),
    "report": ("server.cli.measurement.report", "write a report of results: one HTML file that a lab can file"),
    "verify": ("server.cli.operation.verify", "check a data folder: damage, leftovers, checksums"),
    "reproduce": ("server.cli.evidence.reproduce", "measure a stored analysis again and compare"),
    "certify": ("server.cli.evidence.certify", "judge the measuring system by known motions and lengths"),
    "compare-model": ("server.cli.evidence.compare_model", "compare a measured step with a finite element result"),
    "bundle": ("server.cli.evidence.bundle", "pack a test into one file, or open such a file"),
    "repair": ("server.cli.operation.repair", "put a data folder in order after a crash"),
    "trash": ("server.cli.operation.trash", "what was deleted: list, restore, remove for good"),
    "gauge": ("server.cli.measurement.gauge", "read extensometers, lines and areas off measured results"),
    "calibration": (
        "server.cli.measurement.calibration_files",
        "calibration files to and from other programs; epipolar checks",
    ),
    "export": ("server.cli.measurement.export", "results as NetCDF, CSV, VTU, MATLAB, HDF5, figures and films"),
}

#: commands that load the kernels
_MEASURING = ("measure", "reproduce")
_NEGATIVE_LIST = re.compile(r"-[\d.]+(e[-+]?\d+)?,")


def _measuring(module: str) -> ModuleType:
    """Load a command that measures: its libraries compute on one thread each."""
    one_library_thread()
    hurry()
    try:
        return importlib.import_module(module)
    finally:
        go_on()


class _OneLineParser(argparse.ArgumentParser):
    """A parser whose complaints have the form of every other error: code, cause, remedy in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"stereorig: wrong_usage: {message}. Remedy: see {self.prog} --help\n")


def _joined(arguments: Sequence[str]) -> list[str]:
    """Join ``--roi -5,0,9,9`` to ``--roi=-5,0,9,9``: argparse takes a list that starts with a minus for an option."""
    result: list[str] = []
    for argument in arguments:
        if result and result[-1].startswith("--") and "=" not in result[-1] and _NEGATIVE_LIST.match(argument):
            result[-1] += f"={argument}"
        else:
            result.append(argument)
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status (0 done, 1 failed, 2 wrong usage, 3 to 5 in part, 130 stopped)."""
    arguments = _joined(sys.argv[1:] if argv is None else argv)
    parser = _OneLineParser(prog="stereorig", description="Stereo measurement of shape and displacement.")
    parser.add_argument("--version", action="version", version=f"stereorig {software_version()}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (module, text) in COMMANDS.items():
        sub = subparsers.add_parser(name, help=text, description=text)
        if arguments and arguments[0] == name:
            command = _measuring(module) if name in _MEASURING else importlib.import_module(module)
            command.add_arguments(sub)
            sub.set_defaults(run=command.run)
    args = parser.parse_args(arguments)
    try:
        with compiled_aside():
            return int(args.run(args))
    except Cancelled as error:
        print(f"stereorig: {error}", file=sys.stderr)
        return 130
    except StereorigError as error:
        print(f"stereorig: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stereorig: interrupted", file=sys.stderr)
        return 130
