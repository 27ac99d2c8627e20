"""``stereorig reproduce``: measure a stored analysis again, and say whether it comes out the same."""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.compute.functions import measure_step
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.verify import require_data_folder
from stereorig.server.workflows.repetition.repeat import Repetition, repeat


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.description = (
        "Measure an analysis again from the stored images, settings and calibration, and compare it with its results: "
        "equal to the last bit; within, the same points and every difference at most a tenth of its standard "
        "uncertainty; or differs, with the changes in version, libraries and processor. The data folder is only read; "
        "a service may run on it. Ends with 1 when something differs."
    )
    parser.add_argument("analysis", metavar="TEST/ANALYSIS", help="ids; TEST alone: all its analyses")
    parser.add_argument("--data", type=Path, default=Path("data"), help="data folder (default: ./data)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="keep the repeated results in this new folder")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Measure, compare, print."""
    require_data_folder(args.data)
    tests = TestStore(DataFolder(args.data))
    test_id, _, analysis_id = args.analysis.partition("/")
    wanted = [analysis_id] if analysis_id else tests.analyses.ids(test_id)
    if not wanted:
        raise InputError(f"Test {test_id} has no analysis.", code="no_results", remedy="Measure it first.")
    found = []
    with _folder(args.out) as out:
        for one in wanted:
            tests.analyses.path(test_id, one)
            into = out / one
            into.mkdir()
            found.append(_repeat(tests, test_id, one, into))
    if args.json:
        print(json.dumps({"repetitions": [one.document() for one in found]}, indent=1))
    else:
        print("\n".join(line for one in found for line in one.lines()))
    return 1 if any(one.verdict == "differs" for one in found) else 0


def _repeat(tests: TestStore, test_id: str, analysis_id: str, folder: Path) -> Repetition:
    progress = ProgressLine()
    try:
        return repeat(
            tests,
            test_id,
            analysis_id,
            folder,
            measure_step,
            on_step=lambda n, k, of: progress.show(f"step {n}", k / of),
        )
    finally:
        progress.close()


@contextlib.contextmanager
def _folder(out: Path | None) -> Iterator[Path]:
    """Yield a new folder; one without a name is removed again."""
    if out is None:
        with tempfile.TemporaryDirectory(prefix="stereorig-") as folder:
            yield Path(folder)
        return
    try:
        out.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            f"The folder {out} cannot be made ({error.strerror}).",
            code="output_unusable",
            remedy="Give a folder that is not there yet.",
        ) from error
    yield out
