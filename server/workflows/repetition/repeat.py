"""An analysis measured again from the stored images, settings and calibration, each step compared with its result."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from stereorig.core.errors import Cancelled, FileFormatError, StateError, StereorigError, StorageError
from stereorig.server.compute.functions import measure_step
from stereorig.server.compute.tasks import StepTask
from stereorig.server.documents.tests import AnalysisRecord
from stereorig.server.formats.environment import Change
from stereorig.server.formats.files import sha256_of
from stereorig.server.formats.manifest import checked_bytes, is_there
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.results.repeated import WITHIN_U, StepRepetition, Verdict, changes_of, compare_results
from stereorig.server.store.tests.steps import StepFiles
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.worker.dask_cluster import ClusterError
from stereorig.server.worker.executor import WorkerDiedError
from stereorig.server.workflows.analysis.tasks import is_independent, task_of
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import run_task

Measure = Callable[[StepTask], object]

_ORDER: tuple[Verdict, ...] = ("equal", "within", "differs")


@dataclass(frozen=True)
class Repetition:
    """The comparison of an analysis with its repetition.

    Attributes
    ----------
    verdict
        The worst of its steps, see :class:`stereorig.server.results.repeated.StepRepetition`.
    steps
        Those that were compared.
    not_measured
        Steps that the analysis has not measured; they are not repeated.
    changes
        Differences since then in program, libraries and processor.
    """

    test_id: str
    analysis_id: str
    steps: tuple[StepRepetition, ...]
    not_measured: tuple[int, ...]
    changes: tuple[Change, ...]

    @property
    def verdict(self) -> Verdict:
        """The worst of the steps'."""
        return max((step.verdict for step in self.steps), key=_ORDER.index)

    def document(self) -> dict[str, object]:
        """Return it as plain data."""
        return {
            "test_id": self.test_id,
            "analysis_id": self.analysis_id,
            "verdict": self.verdict,
            "within_u": WITHIN_U,
            "changes": [asdict(change) for change in self.changes],
            "steps": [asdict(step) for step in self.steps],
            "not_measured": list(self.not_measured),
        }

    def lines(self) -> list[str]:
        """Return it as text, a line each; the verdict last."""
        lines = [f"changed: {change.text()}" for change in self.changes]
        for step in self.steps:
            judged = [one for one in step.differences if one.over_u is not None]
            worst = max(judged, key=lambda one: one.over_u or 0.0, default=None)
            text = "equal to the last bit" if step.verdict == "equal" else "differs: " + "; ".join(step.reasons)
            if step.verdict == "within":
                most = "" if worst is None else f": {worst.name} by {worst.over_u:.1e} of it at most"
                text = f"the same within its uncertainty{most}"
            lines.append(f"step {step.n}: {text}")
        if self.not_measured:
            lines.append(f"not measured, so not repeated: steps {', '.join(map(str, self.not_measured))}")
        return [*lines, f"{self.verdict}: {self.test_id}/{self.analysis_id}, {len(self.steps)} steps measured again"]


def repeat(
    tests: TestStore,
    test_id: str,
    analysis_id: str,
    folder: Path,
    measure: Measure,
    *,
    on_step: Callable[[int, int, int], None] = lambda _n, _k, _of: None,
) -> Repetition:
    """Measure an analysis again into another folder, and compare.

    Parameters
    ----------
    folder
        An empty folder for the results; the caller removes it.
    measure
        Measures a step's task; its result file is there when this returns.
    on_step
        Called before each step with its number, how many are done, and of how many.

    Raises
    ------
    NotFoundError
        There is no such test or analysis.
    StateError
        ``analysis_unmeasured`` if no step of it was measured.
    FileFormatError
        ``checksum_mismatch``, ``step_changed``, ``calibration_changed``: an input of the analysis has changed or is
        gone, so that nothing can be repeated.
    """
    document = tests.analyses.read(test_id, analysis_id)
    finished, failed = tests.analyses.finished_steps(test_id, analysis_id), _failed(tests, test_id, analysis_id)
    wanted = [n for n in document.steps if n in finished or n in failed]
    if not set(wanted) & set(finished):
        raise StateError(
            f"Analysis {analysis_id} of test {test_id} has no measured step to repeat.",
            code="analysis_unmeasured",
            remedy="Continue the analysis first, or name another one.",
        )
    _copy_inputs(tests.analyses.path(test_id, analysis_id), document, folder)
    done: dict[int, StepFiles] = {}
    found: list[StepRepetition] = []
    changes: dict[Change, None] = {}
    for k, n in enumerate(wanted):
        on_step(n, k, len(wanted))
        before = tests.analyses.result_file(test_id, analysis_id, n) if n in finished else None
        found.append(_one(tests, document, n, done, folder, measure, before, failed.get(n)))
        if before is not None and n in done:
            changes |= dict.fromkeys(changes_of(before, result_in(folder, n)))
    rest = tuple(n for n in document.steps if n not in wanted)
    return Repetition(test_id, analysis_id, tuple(found), rest, tuple(changes))


def _one(
    tests: TestStore,
    document: AnalysisRecord,
    n: int,
    done: dict[int, StepFiles],
    folder: Path,
    measure: Measure,
    before: Path | None,
    failed_by: str | None,
) -> StepRepetition:
    earlier = {} if is_independent(document) else done
    task = task_of(tests, document, n, earlier, None, folder)
    try:
        measure(task)
    except (Cancelled, FileFormatError, StorageError, WorkerDiedError, ClusterError):
        raise
    except StereorigError as error:
        if before is None and error.code == failed_by:
            return StepRepetition(n, "equal")
        if before is not None and n == document.steps[0]:
            raise  # nothing can be measured after it
        was = "was measured" if before is not None else f"had failed with {failed_by}"
        return StepRepetition(n, "differs", (f"it {was}, and fails now: {error.code}: {error.cause}",))
    done[n] = tests.steps.read(document.test_id, n)
    if before is None:
        return StepRepetition(n, "differs", (f"it had failed with {failed_by}, and is measured now",))
    return compare_results(before, result_in(folder, n), n)


def result_in(folder: Path, n: int) -> Path:
    """Path of the repeated result of a step."""
    return folder / f"step_{n:04d}.nc"


def _failed(tests: TestStore, test_id: str, analysis_id: str) -> dict[int, str]:
    """Codes of the steps that failed."""
    summary = tests.analyses.summary(test_id, analysis_id)
    return {} if summary is None else {int(n): problem.code for n, problem in summary.steps_failed.items()}


def _copy_inputs(analysis: Path, document: AnalysisRecord, folder: Path) -> None:
    """Put mask and noise models, which the analysis has for itself, where its repetition finds them."""
    for name in ("mask.png", "noise.json"):
        if is_there(analysis / name):
            (folder / name).write_bytes(checked_bytes(analysis / name))
    recorded = document.plain().get("mask_sha256")
    if recorded is not None and (not (folder / "mask.png").is_file() or sha256_of(folder / "mask.png") != recorded):
        raise FileFormatError(
            f"mask.png of analysis {document.id} does not match its checksum.",
            code="checksum_mismatch",
            remedy="Restore the file from a backup, or measure again.",
            file=f"analyses/{document.id}/mask.png",
        )


# The repetition of an analysis as a job.


def start_repetition(service: Service, test_id: str, analysis_id: str) -> Job:
    """Begin to measure an analysis again; the job's result is the comparison, and nothing else is kept.

    Raises
    ------
    NotFoundError
        There is no such test or analysis.
    QueueFullError
        Too many computations wait.
    """
    service.tests.analyses.path(test_id, analysis_id)

    def run(job: Job) -> dict[str, object]:
        folder = service.exports.new_folder()
        at = {"n": 0, "k": 0, "of": 1}

        def on_step(n: int, k: int, of: int) -> None:
            job.check()
            service.require_room()
            at.update(n=n, k=k, of=of)

        def progress(phase: str, found: int, of: int) -> None:
            share = min(found / of, 1.0) if of > 0 else 0.0
            job.progress(f"step {at['n']}: {phase}", round(1000 * (at["k"] + share)), 1000 * at["of"])

        def measure(task: StepTask) -> object:
            return run_task(service.executor, job, measure_step, task, progress=progress)

        try:
            return repeat(service.tests, test_id, analysis_id, folder, measure, on_step=on_step).document()
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    subject = {"test_id": test_id, "analysis_id": analysis_id}
    return service.jobs.submit("repetition", "the repetition of an analysis", subject, [Phase("compute", run)])
