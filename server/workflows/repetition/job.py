"""The repetition of an analysis as a job."""

from __future__ import annotations

import shutil

from stereorig.server.compute.functions import measure_step
from stereorig.server.compute.tasks import StepTask
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.repetition.repeat import repeat
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import run_task


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
