"""Waiting for the worker on behalf of a job."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import Any

from core.errors import Cancelled
from server.jobs.job import Job
from server.worker.executor import Progress, TaskExecutor, TaskFuture

_STOPPING_S = 3.0  # the worker ends a task within a second, by force if need be


def run_task(
    executor: TaskExecutor, job: Job, function: Callable[..., Any], *args: Any, progress: Progress | None = None
) -> Any:
    """Run ``function(*args)`` outside; progress goes to the job, the job's cancellation to the task."""
    return result_of(executor.submit(function, *args), job, progress)


def result_of(future: TaskFuture, job: Job, progress: Progress | None = None) -> Any:
    """Wait for a task that was begun for a job; progress goes to the job, the job's cancellation to the task."""
    future.on_progress = progress or job.progress
    with job.waiting(future.request_stop):
        while True:
            if job.cancelled:  # also where it was just before the future was known
                future.request_stop()
            try:
                return future.result(timeout=0.05)
            except TimeoutError:
                if future.done():
                    raise
            except CancelledError:
                raise Cancelled(f"The {job.record.kind} was cancelled.") from None


def run_side_by_side(
    executor: TaskExecutor,
    job: Job,
    function: Callable[..., Any],
    tasks: Iterator[tuple[int, Callable[[], Any]]],
    ended: Callable[[int, Future[Any]], None],
    progress: Callable[[int, str, float], None],
) -> None:
    """Run tasks that do not need one another, as many at once as the executor takes.

    Parameters
    ----------
    tasks
        Each task's number, and what makes its argument.
    ended
        Called with the number and the future of each that has ended; what it raises ends them all.
    progress
        Called with a task's number, its stage and the share of it that is done.
    """
    running: dict[TaskFuture, int] = {}

    def stop() -> None:
        for future in list(running):
            future.request_stop()

    def shown(number: int) -> Progress:
        return lambda phase, done, of: progress(number, phase, min(done / of, 1.0) if of > 0 else 0.0)

    with job.waiting(stop):
        try:
            more = True
            while more or running:
                job.check()
                while more and len(running) < executor.width:
                    number, make = next(tasks, (None, None))
                    if number is None or make is None:
                        more = False
                        break
                    future = executor.submit(function, make())
                    future.on_progress = shown(number)
                    running[future] = number
                finished, _ = wait(list(running), timeout=0.05, return_when=FIRST_COMPLETED)
                for one in finished:
                    if job.cancelled:
                        break
                    ended(running.pop(one), one)  # type: ignore[call-overload]  # wait() forgets what it was given
        finally:
            stop()
            wait(list(running), timeout=_STOPPING_S)  # what a job leaves running would write after its end
