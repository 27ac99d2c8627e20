"""Entries of the catalogue's index, as the folders' documents give them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from stereorig.core.errors import FileFormatError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.steps import StepRecord
from stereorig.server.documents.tests import AnalysisRecord, TestRecord
from stereorig.server.store.calibrations import CalibrationStore
from stereorig.server.store.catalog import Entry
from stereorig.server.store.folder import DataFolder, is_id
from stereorig.server.store.indexing.lost_jobs import LostJobs
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.trash import Trash


def calibration_entry(store: CalibrationStore, calibration_id: str) -> dict[str, object]:
    """A calibration's entry in a list."""
    made = store.read(calibration_id)
    return {
        "id": calibration_id,
        "state": made.state,
        "label": made.plan.label,
        "created_utc": made.plan.created_utc,
        "verdict": made.verdict if isinstance(made.verdict, dict) else None,  # an imported file may hold anything
        "decision": None if made.review is None else made.review.decision,
    }


def test_entry(test: TestRecord) -> dict[str, object]:
    """A test's entry in a list."""
    return {name: getattr(test, name) for name in ("id", "name", "specimen", "calibration_id", "created_utc")}


def step_entry(step: StepRecord) -> dict[str, object]:
    """A step's entry in a list."""
    names = ("n", "label", "load_n", "timestamp_utc", "source", "captured_utc", "skew_ms")
    return {**{name: getattr(step, name) for name in names}, "quality": step.quality_code}


def analysis_entry(
    analysis: AnalysisRecord, job_id: str | None = None, steps_failed: Sequence[int] = ()
) -> dict[str, object]:
    """Entry of an analysis in a list, with the last job that worked on it, and the steps that failed in it."""
    names = ("id", "kind", "label", "calibration_id", "created_utc")
    entry = {**{name: getattr(analysis, name) for name in names}, "job_id": job_id}
    return {**entry, "steps_failed": sorted(steps_failed)} if steps_failed else entry


def entries_of_test(tests: TestStore, test_id: str, lost: LostJobs, trouble: list[str]) -> list[Entry]:
    """Everything that the index holds of a test; documents that cannot be read are left out and reported.

    Parameters
    ----------
    lost
        Called with every document.
    trouble
        Gets a line for each document that cannot be read.
    """
    entries: list[Entry] = []

    def take(subject: str, read: Callable[[], Entry]) -> None:
        try:
            entries.append(read())
        except (FileFormatError, NotFoundError, KeyError, TypeError) as error:
            trouble.append(f"{subject}: {error}")

    def test() -> Entry:
        document = tests.read(test_id)
        lost.made(document.request, {"test_id": test_id})
        return "test", "", test_id, test_entry(document)

    def step(n: int, document: StepRecord | FileFormatError) -> Entry:
        if isinstance(document, FileFormatError):
            raise document
        lost.step(test_id, document)
        return "step", test_id, f"{n:04d}", step_entry(document)

    def analysis(analysis_id: str) -> Entry:
        document = tests.analyses.read(test_id, analysis_id)
        runs = tests.analyses.jobs(test_id, analysis_id)
        summary = tests.analyses.whole_summary(test_id, analysis_id)
        lost.analysis(document, runs, summary)
        job_id = runs[-1].job_id if runs else None
        known = summary is not None and summary.job_id in (None, job_id)
        failed = [int(n) for n in summary.steps_failed] if summary is not None and known else []
        return "analysis", test_id, analysis_id, analysis_entry(document, job_id, failed)

    take(f"test {test_id}", test)
    for n, document in tests.steps.documents(test_id):
        take(f"step {n} of test {test_id}", partial(step, n, document))
    for analysis_id in tests.analyses.ids(test_id):
        take(f"analysis {analysis_id} of test {test_id}", partial(analysis, analysis_id))
    return entries


def check_trash(folder: DataFolder) -> list[str]:
    """Put the trash in order; its entries keep their ids."""
    trash = Trash(folder.root)
    done = trash.tidy()
    for trash_id in trash.ids():
        folder.ids.reserve(trash_id)
        try:
            ids = trash.entry(trash_id).plain()
        except (FileFormatError, NotFoundError):
            continue  # `stereorig verify` and the list of the trash report it
        for name, letter in (("test_id", "t"), ("analysis_id", "a"), ("calibration_id", "c"), ("noise_id", "n")):
            if is_id(str(ids.get(name)), letter):
                folder.ids.reserve(str(ids[name]))
    return done
