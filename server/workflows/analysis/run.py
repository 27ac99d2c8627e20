"""An analysis at work: one task a step in the worker, each step's file announced once it can be read.

A run keeps no state but the folder's: it begins from the start, continues an interrupted run, or follows a test, and
measures each step from the same steps before it in any case.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from typing import Any

from stereorig.core.errors import Cancelled, MeasurementError, StereorigError, StorageError
from stereorig.server.base.json_values import without_nan
from stereorig.server.base.problem import problem_of
from stereorig.server.compute.functions import measure_step
from stereorig.server.compute.tasks import StepTask
from stereorig.server.documents.tests import AnalysisRecord, Finished, StepOutcome
from stereorig.server.formats.results.summary import SequenceSummary
from stereorig.server.formats.version import software_version
from stereorig.server.jobs.job import Job, Waiting
from stereorig.server.results.warnings.analysis import analysis_warnings
from stereorig.server.store.folder import now_utc
from stereorig.server.store.indexing.entries import analysis_entry
from stereorig.server.store.tests.steps import StepFiles
from stereorig.server.worker.dask_cluster import ClusterError
from stereorig.server.worker.executor import WorkerDiedError
from stereorig.server.workflows.analysis.block import Outcome
from stereorig.server.workflows.analysis.blocks import Blocks
from stereorig.server.workflows.analysis.side_by_side import goes_in_blocks, is_certain, measure_in_blocks
from stereorig.server.workflows.analysis.tasks import is_independent, task_of
from stereorig.server.workflows.camera_identity import check_same_cameras
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import report_away, run_side_by_side, run_task


class StepsFailedError(MeasurementError):
    """Steps could not be measured, and none was but the reference."""

    code = "steps_failed"
    remedy = "Read each step's problem in the summary."


class AnalysisRun:
    """The compute phase of one job; called again when the job that follows a test is woken.

    Parameters
    ----------
    test_id
        The test; the analysis is in the job's subject.
    """

    def __init__(self, service: Service, test_id: str) -> None:
        self._service = service
        self._test_id = test_id
        self._loaded: AnalysisRecord | None = None
        self._summaries: dict[int, StepOutcome] = {}  # of the steps that are finished
        self._plain: dict[int, tuple[StepOutcome, dict[str, object]]] = {}
        self._failed: dict[int, StereorigError] = {}  # in this run
        self._done: dict[int, StepFiles] = {}  # steps that the next one is measured from, in order, the last one last
        self._references: dict[int, None] = {}  # of the steps measured so far, in the order of their first use
        self._next = 0  # index of that step

    def __call__(self, job: Job) -> dict[str, object]:
        """Measure the steps that are not measured yet: a step that fails ends neither the others nor the analysis.

        Raises
        ------
        StereorigError
            The reference's error; or, with its code, the first other step's error if all of them failed.
        Waiting
            It follows a test and has measured all that there is.
        """
        if self._loaded is None:
            self._load(job)
        while True:
            report_away(self._service.executor, job)
            self._measure(job)
            if job.work.follows is None:
                break
            finishing = job.finishing.is_set()  # read first: steps committed before it are measured
            if self._take_new_steps():
                continue
            if finishing:
                break
            count = len(self._document.steps)
            job.progress("waiting for the next step", 1000 * count, 1000 * count)
            raise Waiting
        steps = self._document.steps
        job.progress("done", 1000 * len(steps), 1000 * len(steps))
        return self._result(job)

    @property
    def _document(self) -> AnalysisRecord:
        assert self._loaded is not None, "loaded when the job begins"
        return self._loaded

    def _load(self, job: Job) -> None:
        """Take over the results of an earlier run; a result without summary, or damaged, is measured again."""
        tests, analysis_id = self._service.tests, str(job.subject["analysis_id"])
        document = tests.analyses.read(self._test_id, analysis_id)
        known = tests.analyses.step_summaries(self._test_id, analysis_id)
        for n in document.steps:
            with contextlib.suppress(StereorigError):
                tests.analyses.result_file(self._test_id, analysis_id, n)
                if n in known:
                    self._summaries[n] = known[n]
        self._loaded = document
        self._publish(job)

    def _publish(self, job: Job) -> dict[str, object]:
        """Put the finished steps into the job's result, and return it."""
        finished = [self._summaries[n] for n in self._document.steps if n in self._summaries]
        found: dict[str, object] = {
            "analysis_id": self._document.id,
            "test_id": self._test_id,
            "steps_finished": [found.n for found in finished],
            "steps": [self._plain_of(found) for found in finished],
        }
        if self._failed:
            problems = {str(n): problem_of(self._failed[n]).plain() for n in sorted(self._failed)}
            found["steps_failed"] = problems
        job.result = found
        return found

    def _plain_of(self, found: StepOutcome) -> dict[str, object]:
        """Return a step's figures as plain values; kept, since they are published again after every step."""
        known = self._plain.get(found.n)
        if known is None or known[0] is not found:
            self._plain[found.n] = known = found, found.plain()
        return known[1]

    def _measure(self, job: Job) -> None:
        steps = self._document.steps
        if is_independent(self._document):
            self._measure_side_by_side(job)
            return
        if goes_in_blocks(self._service, self._document, steps[self._next :], self._summaries):
            self._measure_in_blocks(job)
            return
        while self._next < len(steps):
            self._measure_next(job)

    def _measure_next(self, job: Job) -> None:
        n = self._document.steps[self._next]
        if n in self._summaries:
            self._go_on_from(n)
        else:
            job.check()
            self._service.require_room()  # while the job's last files can still be written
            self._measure_one(job, self._next, n)
        self._next += 1

    def _go_on_from(self, n: int) -> None:
        """Keep the steps that later ones may be measured from: this step and the references so far."""
        reference = self._plain_of(self._summaries[n]).get("reference_step")
        if reference is not None:
            self._references[int(str(reference))] = None
        kept = {k: step for k, step in self._done.items() if k in self._references}
        self._done = {**kept, n: self._service.tests.steps.read(self._test_id, n)}

    def _measure_one(self, job: Job, index: int, n: int) -> None:
        service, document, steps = self._service, self._document, self._document.steps

        def progress(phase: str, found: int, of: int) -> None:
            # steps are the unit a user thinks in; within a step, the points found so far
            fraction = min(found / of, 1.0) if of > 0 else 0.0
            job.progress(f"step {n}: {phase}", round(1000 * (index + fraction)), 1000 * len(steps))

        started = time.monotonic()
        try:
            self._check_cameras(n)
            following = steps[index + 1] if index + 1 < len(steps) else None
            task = task_of(service.tests, document, n, self._done, following)
            service.tests.analyses.begin_step(self._test_id, document.id, n)
            summary = run_task(service.executor, job, measure_step, task, progress=progress)
        except StereorigError as error:
            self._record_failure(job, n, error)
            return
        self._note(job, n, summary, time.monotonic() - started)

    def _measure_in_blocks(self, job: Job) -> None:
        """Measure steps that follow one another in blocks, several at once."""
        steps = self._document.steps
        while self._next < len(steps) and (self._next == 0 or is_certain(self._summaries.get(steps[self._next]))):
            self._measure_next(job)  # the reference, and the steps that follow it without a gap
        later = [n for n in self._references if n != steps[0]]
        order = steps[self._next :]
        plan = Blocks(
            order,
            previous=next(reversed(self._done)),
            reference=later[-1] if later else steps[0],
            first=steps[0],
            width=self._service.executor.width,
            references=later,
            known={n: self._summaries[n].plain() for n in order if n in self._summaries},
        )

        def prepare(n: int) -> None:
            self._service.require_room()
            self._check_cameras(n)

        def progress(measured: float) -> None:
            done = min(self._next + measured, len(steps))
            job.progress("steps side by side", round(1000 * done), 1000 * len(steps))

        measure_in_blocks(
            self._service, self._document, job, plan, prepare, self._raise_what_ends_all, self._take, progress
        )
        self._next = len(steps)

    def _take(self, job: Job, n: int, outcome: Outcome) -> None:
        """Note a step whose outcome is the same as if all steps were measured one after another."""
        if isinstance(outcome, StereorigError):
            self._summaries.pop(n, None)
            self._record_failure(job, n, outcome)
        else:
            found = {name: value for name, value in outcome.items() if name != "agrees"}
            self._note(job, n, found, float(str(found.get("wall_s") or 0.0)))

    def _measure_side_by_side(self, job: Job) -> None:
        """Measure steps that need no other than the reference, as many at once as there are workers."""
        steps = self._document.steps
        if self._next == 0 and self._document.kind == "displacement":  # the others need it
            if steps[0] not in self._summaries:
                job.check()
                self._measure_one(job, 0, steps[0])
            self._next = 1
        open_steps = [n for n in steps[self._next :] if n not in self._summaries]
        began = time.monotonic()
        parts: dict[int, float] = {}

        def tasks() -> Iterator[tuple[int, Callable[[], StepTask]]]:
            for n in open_steps:
                try:
                    self._check_cameras(n)
                    task = task_of(self._service.tests, self._document, n, {}, None)
                    self._service.tests.analyses.begin_step(self._test_id, self._document.id, n)
                except StereorigError as error:
                    self._record_failure(job, n, error)
                    continue
                yield n, lambda task=task: task  # type: ignore[misc]

        def progress(n: int, phase: str, share: float) -> None:
            parts[n] = share
            done = len(self._summaries) + len(self._failed) + sum(parts.values())
            text = f"step {n}: {phase}" if len(parts) < 2 else f"{len(parts)} steps at once"
            job.progress(text, round(1000 * min(done, len(steps))), 1000 * len(steps))

        def ended(n: int, future: Future[Any]) -> None:
            parts.pop(n, None)
            try:
                summary = future.result()
            except StereorigError as error:
                self._record_failure(job, n, error)
            else:
                self._note(job, n, summary, time.monotonic() - began)

        run_side_by_side(self._service.executor, job, measure_step, tasks(), ended, progress)
        self._next = len(steps)

    def _record_failure(self, job: Job, n: int, error: StereorigError) -> None:
        """Record and publish a step's own failure; raise an error that is not the step's, or that ends the analysis."""
        self._raise_what_ends_all(n, error)
        self._failed[n] = error
        self._publish(job)
        about = {"test_id": self._test_id, "analysis_id": self._document.id, "n": n, "job_id": job.id}
        self._service.hub.publish("step_failed", {**about, "problem": problem_of(error).plain()})

    def _raise_what_ends_all(self, n: int, error: StereorigError) -> None:
        displacement = self._document.kind == "displacement"
        if isinstance(error, Cancelled | StorageError | WorkerDiedError | ClusterError):
            raise error
        if displacement and n == self._document.steps[0]:
            raise error

    def _note(self, job: Job, n: int, summary: Mapping[str, object], seconds: float) -> None:
        """A step is finished: durable first, then announced."""
        service, analysis_id = self._service, self._document.id
        seconds = round(seconds, 3)
        found = without_nan({**summary, "wall_s": seconds, "seconds": seconds})
        service.tests.analyses.put_step_summary(self._test_id, analysis_id, n, found)
        self._summaries[n] = StepOutcome.model_validate(found)
        self._go_on_from(n)
        self._publish(job)
        service.hub.publish("result", {"test_id": self._test_id, "analysis_id": analysis_id, "n": n, "job_id": job.id})

    def _check_cameras(self, n: int) -> None:
        """Refuse a step of other cameras: steps added later were not checked when the analysis was made."""
        if not self._document.follow:
            return
        measured = self._document.inputs.calibration_sha256
        calibration = self._service.tests.calibration_file(self._test_id, measured)
        check_same_cameras(calibration, self._service.tests.steps.read(self._test_id, n).document.cameras, f"Step {n}")

    def _take_new_steps(self) -> bool:
        """Add the steps committed since to the analysis; return True if there are any."""
        tests, steps = self._service.tests, self._document.steps
        known = set(steps)
        new = [n for n in tests.steps.numbers(self._test_id) if n > steps[0] and n not in known]
        if new:
            hashes = {str(n): tests.steps.read(self._test_id, n).document.sha256 for n in new}
            self._loaded = tests.analyses.extend(self._test_id, self._document.id, new, hashes)
        return bool(new)

    def _result(self, job: Job) -> dict[str, object]:
        found = self._publish(job)
        needed = 2 if self._document.kind == "displacement" else 1
        if self._failed and len(self._summaries) < needed:
            first = min(self._failed)
            raise StepsFailedError(
                f"{len(self._failed)} of {len(self._document.steps)} steps failed; step {first}: "
                f"{self._failed[first].cause}",
                code=self._failed[first].code,
                remedy=self._failed[first].remedy,
                steps_failed=sorted(self._failed),
            )
        folder = self._service.tests.analyses.path(self._test_id, self._document.id)
        problems = {str(n): problem_of(error).plain() for n, error in self._failed.items()}
        found["warnings"] = [one.plain() for one in analysis_warnings(folder, failed=problems)]
        return found


def close(service: Service, job: Job, test_id: str, analysis_id: str, state: str) -> None:
    """Write ``summary.json`` with the figures of the finished steps, for every final state of the job."""
    found, document = Finished.model_validate(job.result or {}), service.tests.analyses.read(test_id, analysis_id)
    summary = SequenceSummary(
        state=state,
        software_version=software_version(),
        created=now_utc(),
        calibration={"sha256": document.inputs.calibration_sha256},
        settings=document.settings,
        seconds=round(sum(step.wall_s or 0.0 for step in found.steps), 3),
        steps=[step.plain() for step in found.steps],
        steps_failed={n: problem.plain() for n, problem in found.steps_failed.items()},
    ).document()
    problem = None if job.record.problem is None else job.record.problem.plain()
    summary |= {"analysis_id": analysis_id, "job_id": job.id, "problem": problem}
    service.tests.analyses.put_summary(test_id, analysis_id, summary)
    if found.steps_failed:
        entry = analysis_entry(document, job.id, [int(n) for n in found.steps_failed])
        service.catalog.put_entry("analysis", test_id, analysis_id, entry)
    if state == "succeeded" and not found.steps_failed:
        service.tests.analyses.drop_starts(test_id, analysis_id)
    else:
        service.tests.analyses.drop_half_written(test_id, analysis_id)  # by a worker that was ended in the middle
