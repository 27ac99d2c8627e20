"""``stereorig demo``: one of the paper's experiments on the simulated rig, over HTTP, against the truth."""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Any

from stereorig.core.errors import FileFormatError
from stereorig.server.cli.terminal import ProgressLine, duration
from stereorig.server.demo.client import ServiceClient
from stereorig.server.demo.process import running_service
from stereorig.server.demo.session import DemoCheck, DemoRun, Outcome
from stereorig.server.formats.files import make_folder, write_bytes
from stereorig.server.formats.results.summary import to_json
from stereorig.server.formats.version import software_version

# experiment -> (rig file, description)
EXPERIMENTS = {
    "plate": ("sim_paper.toml", "clamped circular plate under ten pressures"),
    "steel": ("sim_paper.toml", "profile of a ground steel plate"),
    "panel": ("sim_panel.toml", "centre-cracked panel in tension"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--experiment", choices=sorted(EXPERIMENTS), default="plate", help="which one (plate)")
    parser.add_argument("--out", metavar="DIR", help="folder for pictures, results and report.json (demo_<experiment>)")


def run(args: argparse.Namespace) -> int:
    """Run one experiment; 1 if a figure misses its limit."""
    config_name, title = EXPERIMENTS[args.experiment]
    config = find_config(config_name)
    out = Path(args.out or f"demo_{args.experiment}").absolute()
    make_folder(out)
    progress = ProgressLine()
    note = _Notes(progress)
    started = time.monotonic()
    note(f"stereorig {software_version()} demo: {title}")
    log = out / "service.log"
    log.unlink(missing_ok=True)
    with _terminated_like_interrupted(), contextlib.closing(progress):
        note("starting the service (the first start on a machine compiles kernels, half a minute or so) ...")
        with running_service(config, out / "data", log) as url:
            note(f"service: {url}, log: {log}")
            with ServiceClient(url, on_progress=note.progress) as client:
                outcome = _experiment(DemoRun(client, _true_rig(config), config, out, note), args.experiment)
    seconds = time.monotonic() - started
    return _finish(out, args.experiment, title, outcome, seconds)


def _true_rig(config: Path) -> Any:
    from stereorig.sim.rig import SimRig

    return SimRig.from_toml(config)


def _experiment(session: DemoRun, name: str) -> Outcome:
    from stereorig.server.demo import calibration
    from stereorig.server.demo.drawing import fields
    from stereorig.server.demo.experiments import panel, plate, steel

    session.note("calibrating: both stages move, the grid is imaged ...")
    made = session.calibrate()
    report = calibration.describe(session, made)
    for line in report.lines:
        session.note(line)
    session.note("")
    outcome: Outcome = {"plate": plate, "steel": steel, "panel": panel}[name].run(session, made.id)
    outcome.checks = report.checks + outcome.checks
    outcome.pictures = fields.calibration(session.out, report.views) | outcome.pictures
    outcome.data["calibration"] = {"id": made.id, "checks": made.checks, "verdict": made.verdict}
    return outcome


def _finish(out: Path, experiment: str, title: str, outcome: Outcome, seconds: float) -> int:
    missed = [check for check in outcome.checks if not check.passed]
    write_bytes(
        out / "report.json",
        to_json(
            {
                "experiment": experiment,
                "title": title,
                "software_version": software_version(),
                "seconds": round(seconds, 1),
                "passed": not missed,
                "checks": [_as_dict(c) for c in outcome.checks],
                "pictures": outcome.pictures,
                "figures": outcome.data,
                "table": outcome.lines,
            }
        ),
    )
    print()
    print("\n".join(outcome.lines))
    print()
    for name, caption in outcome.pictures.items():
        print(f"  {out / name}: {caption}")
    print()
    met = len(outcome.checks) - len(missed)
    print(f"{met} of {len(outcome.checks)} figures within their limits, in {duration(seconds)}")
    for check in missed:
        true = "" if check.true is None else f", true {check.true:.4g}"
        found = f"found {check.found:.4g} {check.unit}{true}"
        cause = f"{check.name}: {found}, error {check.error:+.4g}, limit {check.limit:g}."
        print(f"stereorig: limit_missed: {cause} Remedy: see {out / 'report.json'}.", file=sys.stderr)
    return 1 if missed else 0


def _as_dict(check: DemoCheck) -> dict[str, object]:
    return asdict(check) | {"error_unit": check.error_unit or check.unit, "passed": check.passed}


class _Notes:
    """Prints lines, and the progress of the job that runs."""

    def __init__(self, line: ProgressLine) -> None:
        self._line = line

    def __call__(self, text: str) -> None:
        self._line.note(text)

    def progress(self, phase: str, done: int, total: int, eta_s: float | None) -> None:
        """Show how far a job is."""
        left = "" if eta_s is None else f", about {duration(eta_s)} left"
        share = "" if total <= 0 else f" {100 * done / total:.0f} %"
        self._line.status(f"{phase}{share}{left}")


def find_config(name: str) -> Path:
    """Find a rig file that comes with the program: in the checkout, the working folder, or the installation.

    Raises
    ------
    FileFormatError
        ``file_missing``.
    """
    folders = [Path(__file__).resolve().parents[3], Path.cwd(), Path(sys.prefix) / "share" / "stereorig"]
    for folder in folders:
        if (folder / "config" / name).is_file():
            return folder / "config" / name
    raise FileFormatError(
        f"The rig file config/{name} was not found.", code="file_missing", remedy="Run this from the project's folder."
    )


@contextlib.contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """Let SIGTERM unwind like Ctrl-C, so that the service is stopped."""

    def stop(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
