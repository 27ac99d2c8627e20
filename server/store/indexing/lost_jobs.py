"""Jobs and requests as the folders have them, for a catalogue that was lost, or did not have them yet at a kill.

Everything that a job makes has the job's id and the Idempotency-Key that asked for it. Both are recovered from there:
a client that repeats its request gets the result of the first, with its job as it ended.
"""

from __future__ import annotations

from collections.abc import Mapping

from stereorig.server.base.models import Ids, JobState
from stereorig.server.base.problem import RESTART, JobProblem, problem_of
from stereorig.server.documents.jobs import JobRecord, KeptRequest, Progress
from stereorig.server.documents.made import MadeRecord
from stereorig.server.documents.steps import BurstIndex, StepRecord
from stereorig.server.documents.tests import AnalysisJob, AnalysisRecord, SummaryRecord
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import IdMaker, is_id


class LostJobs:
    """Collects jobs and requests from documents, then adds those that the catalogue lacks."""

    def __init__(self) -> None:
        self._jobs: dict[str, JobRecord] = {}
        self._requests: dict[tuple[str, str], tuple[str, Ids]] = {}
        self._bursts: dict[tuple[str, str], list[tuple[BurstIndex, StepRecord]]] = {}

    def made(self, request: KeptRequest | None, ids: Ids) -> None:
        """Record the request that something was made for."""
        if request is not None:
            self._requests.setdefault((request.scope, request.key), (request.body_sha256, ids))

    def calibration(self, made: MadeRecord) -> None:
        """A calibration, as its store reads it."""
        self._single("calibration", made)

    def noise(self, made: MadeRecord) -> None:
        """A noise measurement, as its store reads it."""
        self._single("noise", made)

    def _single(self, kind: str, made: MadeRecord) -> None:
        plan, problem = made.plan, made.problem
        ids: Ids = {f"{kind}_id": made.id}
        if plan.source == "import":
            self.made(plan.request, ids)
        if plan.job_id is None:
            return
        failed: JobState = "interrupted" if problem is None else problem.job_state
        state: JobState = "succeeded" if made.state == "complete" else failed
        self._job(plan.job_id, kind, ids, state, plan.created_utc, ids if state == "succeeded" else None, problem)
        self.made(plan.request, {**ids, "job_id": plan.job_id})

    def step(self, test_id: str, document: StepRecord) -> None:
        """Take a step; the steps of a burst belong to its job."""
        if document.burst is None:
            self.made(document.request, {"test_id": test_id, "n": document.n})
            return
        self._bursts.setdefault((test_id, document.burst.job_id), []).append((document.burst, document))

    def analysis(self, document: AnalysisRecord, runs: list[AnalysisJob], summary: SummaryRecord | None) -> None:
        """An analysis, with the jobs that worked on it, the last one last."""
        ids: Ids = {"test_id": document.test_id, "analysis_id": document.id}
        for run in runs:
            known = summary if summary is not None and summary.job_id == run.job_id else SummaryRecord()
            found = [step.plain() for step in known.steps]
            result: dict[str, object] = {**ids, "steps_finished": [step.n for step in known.steps], "steps": found}
            if known.steps_failed:
                result["steps_failed"] = {n: problem.plain() for n, problem in known.steps_failed.items()}
            created = run.created_utc or document.created_utc or ""
            self._job(run.job_id, "analysis", ids, known.state, created, result, known.problem)
            self.made(run.request, {**ids, "job_id": run.job_id})

    def _job(
        self,
        job_id: str,
        kind: str,
        subject: Mapping[str, object],
        state: JobState,
        created_utc: str,
        result: Mapping[str, object] | None,
        problem: JobProblem | None,
    ) -> None:
        if not is_id(job_id, "j"):  # a folder from elsewhere may hold anything
            return
        known_problem = None if problem is None else JobProblem.model_validate(problem.plain())
        if state != "succeeded" and known_problem is None:
            known_problem = problem_of(RESTART)
        self._jobs[job_id] = JobRecord(
            id=job_id,
            kind=kind,
            state=state,
            subject=dict(subject),
            progress=Progress(phase="done" if state == "succeeded" else "ended", done=0, total=0, eta_s=None),
            created_utc=created_utc,
            started_utc=None,
            finished_utc=None,
            result=None if result is None else dict(result),
            problem=known_problem,
        )

    def _end_bursts(self) -> None:
        for (test_id, job_id), steps in self._bursts.items():
            burst, first = steps[0]
            subject: Ids = {"test_id": test_id}
            taken = [
                {"index": burst.index, "n": step.n, "quality": step.quality_code, "sha256": step.sha256}
                for burst, step in steps
            ]
            result = {**subject, "count": burst.count, "steps": taken, "failures": []}
            state: JobState = "succeeded" if len(steps) == burst.count else "interrupted"
            self._job(job_id, "burst", subject, state, first.captured_utc or "", result, None)
            self.made(first.request, {**subject, "job_id": job_id})

    def restore(self, catalog: Catalog, ids: IdMaker) -> None:
        """Add the jobs and requests that the catalogue lacks."""
        self._end_bursts()
        for job_id in self._jobs:
            ids.reserve(job_id)
        catalog.restore(
            list(self._jobs.values()),
            [(scope, key, digest, made) for (scope, key), (digest, made) in self._requests.items()],
        )
