"""Entry point: picks the subcommand, turns every expected error into one line and an exit status."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn

from stereorig.core.errors import Cancelled, StereorigError
from stereorig.core.lazy import load_module
from stereorig.server.base.library_threads import one_library_thread
from stereorig.server.base.priority import go_on, hurry
from stereorig.server.formats.version import software_version
from stereorig.server.worker.kernel_compiler import compiled_aside

# name -> (module, one-line help); each module has add_arguments(parser) and run(args) -> int,
# and is imported only when it is asked for, so that `--help` and errors in one do not wait for the others
COMMANDS: dict[str, tuple[str, str]] = {
    "serve": ("stereorig.server.cli.operation.serve", "start the service"),
    "keys": ("stereorig.server.cli.operation.keys", "make, list and remove keys for the service"),
    "demo": (
        "stereorig.server.cli.operation.demo",
        "run one of the paper's experiments on the simulated rig, over HTTP",
    ),
    "devices": ("stereorig.server.cli.operation.devices", "list cameras and serial ports, with their faults"),
    "doctor": ("stereorig.server.cli.operation.doctor", "check the whole bench: cameras, stage, disk, machine"),
    "rigfile": ("stereorig.server.cli.operation.rigfile", "check rig files; print every key with its meaning"),
    "simstage": ("stereorig.server.cli.operation.simstage", "run a simulated motion controller on a socket or pty"),
    "simframe": (
        "stereorig.server.cli.operation.simframe",
        "run a simulated load frame that pulls the strip of a simulated rig",
    ),
    "live": ("stereorig.server.cli.operation.live", "measure a test while it runs: begin, show, stop"),
    "calibrate": (
        "stereorig.server.cli.measurement.calibrate",
        "calibrate a pair of cameras from images of a target; --by-hand: on a running service",
    ),
    "expect": ("stereorig.server.cli.planning.expect", "predict the uncertainties of a planned measurement"),
    "print": ("stereorig.server.cli.planning.prints", "calibration targets and speckle as PDF or SVG, in true mm"),
    "channels": (
        "stereorig.server.cli.operation.channels",
        "a load frame's record, aligned with the steps of a test by time",
    ),
    "guide": ("stereorig.server.cli.operation.guide", "calibrate on a running service from a target held by hand"),
    "noise": ("stereorig.server.cli.measurement.noise", "measure the cameras' noise from repeated frames"),
    "measure": ("stereorig.server.cli.measurement.measure", "measure shape and displacement from image files"),
    "report": (
        "stereorig.server.cli.measurement.report",
        "write a report of results: one HTML file that a lab can file",
    ),
    "verify": (
        "stereorig.server.cli.operation.verify",
        "check a data folder: damage, leftovers, checksums; --repair: put it in order",
    ),
    "reproduce": ("stereorig.server.cli.evidence.reproduce", "measure a stored analysis again and compare"),
    "certify": ("stereorig.server.cli.evidence.certify", "judge the measuring system by known motions and lengths"),
    "compare-model": (
        "stereorig.server.cli.evidence.compare_model",
        "compare a measured step with a finite element result",
    ),
    "evaluate": ("stereorig.server.cli.evidence.evaluate", "run an installed evaluation over measured results"),
    "bundle": ("stereorig.server.cli.evidence.bundle", "pack a test into one file, or open such a file"),
    "repair": ("stereorig.server.cli.operation.repair", "put a data folder in order after a crash"),
    "trash": ("stereorig.server.cli.operation.trash", "deleted data: list, restore, remove for good"),
    "gauge": ("stereorig.server.cli.measurement.gauge", "read extensometers, lines and areas off measured results"),
    "calibration": (
        "stereorig.server.cli.measurement.calibration_files",
        "calibration files to and from other programs; epipolar checks",
    ),
    "export": (
        "stereorig.server.cli.measurement.export",
        "results as NetCDF, CSV, VTU, MATLAB, HDF5, figures and films",
    ),
}

#: how the help lists them; the others are for tests, or older names of what is listed
GROUPS: dict[str, tuple[str, ...]] = {
    "rig": ("serve", "keys", "devices", "doctor", "rigfile", "demo"),
    "calibrate": ("print", "expect", "calibrate", "calibration", "noise", "certify"),
    "measure": ("measure", "live", "channels"),
    "look": ("gauge", "export", "report", "evaluate", "compare-model"),
    "keep": ("verify", "bundle", "reproduce", "trash"),
}
#: option of a command that stands for a command of its own
_FOLDED = {("calibrate", "--by-hand"): "guide", ("verify", "--repair"): "repair"}
#: commands that load the kernels
_MEASURING = ("measure", "reproduce")
_NEGATIVE_LIST = re.compile(r"-[0-9.]+(e[-+]?[0-9]+)?,")


def _measuring(module: str) -> ModuleType:
    """Load a command that measures: its libraries compute on one thread each."""
    one_library_thread()
    hurry()
    try:
        return load_module(module)
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


def _unfolded(arguments: Sequence[str]) -> list[str]:
    """Return ``guide ...`` for ``calibrate --by-hand ...``, and so on."""
    for (command, option), name in _FOLDED.items():
        if arguments and arguments[0] == command and option in arguments:
            return [name, *(one for one in arguments[1:] if one != option)]
    return list(arguments)


def _listed() -> str:
    """Return the commands by group, as the help shows them."""
    lines = []
    for group, names in GROUPS.items():
        lines += [f"{group}:", *(f"  {name:<15}{COMMANDS[name][1]}" for name in names), ""]
    return "\n".join([*lines, "stereorig COMMAND --help lists the options of a command."])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status (0 done, 1 failed, 2 wrong usage, 3 to 5 in part, 130 stopped)."""
    arguments = _unfolded(_joined(sys.argv[1:] if argv is None else argv))
    parser = _OneLineParser(
        prog="stereorig",
        description="Stereo measurement of shape and displacement.",
        epilog=_listed(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"stereorig {software_version()}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (module, text) in COMMANDS.items():
        sub = subparsers.add_parser(name, description=text)
        if arguments and arguments[0] == name:
            command = _measuring(module) if name in _MEASURING else load_module(module)
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
