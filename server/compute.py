"""Waiting for the worker on behalf of a job."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError
from typing import Any

from core.errors import Cancelled
from server.jobs import Job
from server.worker import ComputeWorker, Progress


def run_task(
    worker: ComputeWorker, job: Job, function: Callable[..., Any], *args: Any, progress: Progress | None = None
) -> Any:
    """Run ``function(*args)`` in the worker; progress goes to the job, the job's cancellation to the worker."""
    future = worker.submit(function, *args)
    future.on_progress = progress or job.progress
    while True:
        try:
            return future.result(timeout=0.05)
        except TimeoutError:
            if future.done():
                raise
            if job.cancelled:
                future.request_stop()
        except CancelledError:
            raise Cancelled(f"The {job.kind} was cancelled.") from None
