"""Waiting for the worker on behalf of a job."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import Any, Self

from stereorig.core.errors import Cancelled
from stereorig.server.jobs.job import Job
from stereorig.server.worker.executor import Progress, TaskExecutor, TaskFuture

_STOPPING_S = 3.0  # the worker ends a task within a second, by force if need be


def run_task(
    executor: TaskExecutor, job: Job, function: Callable[..., Any], *args: Any, progress: Progress | None = None
) -> Any:
    """Run ``function(*args)`` outside; progress goes to the job, the job's cancellation to the task."""
    report_away(executor, job)
    return result_of(executor.submit(function, *args), job, progress, executor)


def report_away(executor: TaskExecutor, job: Job) -> None:
    """Have a job show that its executor is away, if it is."""
    if away := executor.away:
        job.await_part(f"waiting: {away}")


def result_of(
    future: TaskFuture, job: Job, progress: Progress | None = None, executor: TaskExecutor | None = None
) -> Any:
    """Wait for a task that was begun for a job; progress goes to the job, the job's cancellation to the task.

    With an ``executor`` the job shows while that is away.
    """
    future.on_progress = progress or job.progress
    with job.waiting(future.request_stop):
        while not future.done():
            if job.cancelled:  # also where it was just before the future was known
                future.request_stop()
            wait([future], timeout=0.05)
            if executor is not None:
                report_away(executor, job)
        try:
            return future.result()
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
        Each task's number, and a function that makes its argument.
    ended
        Called with the number and the future of each that has ended; an exception from it ends them all.
    progress
        Called with a task's number, its stage and the share of it that is done.
    """
    with SideBySide(executor, job, progress) as side:
        more = True
        while more or side.running:
            while more and side.has_room:
                number, make = next(tasks, (None, None))
                if number is None or make is None:
                    more = False
                    break
                side.submit(number, function, make())
            for number, future in side.ended():
                ended(number, future)


class SideBySide:
    """Tasks of a job that run at once, as many as the executor takes; leaving the ``with`` block ends them.

    Parameters
    ----------
    progress
        Called with a task's number, its stage and the share of it that is done.
    """

    def __init__(self, executor: TaskExecutor, job: Job, progress: Callable[[int, str, float], None]) -> None:
        self._executor, self._job, self._progress = executor, job, progress
        self.running: dict[TaskFuture, int] = {}
        self._waiting = contextlib.ExitStack()

    @property
    def has_room(self) -> bool:
        """True while another task could begin at once."""
        return len(self.running) < self._executor.width

    def submit(self, number: int, function: Callable[..., Any], *args: Any) -> TaskFuture:
        """Begin a task."""
        self._job.check()
        future = self._executor.submit(function, *args)
        future.on_progress = lambda phase, done, of: self._progress(
            number, phase, min(done / of, 1.0) if of > 0 else 0.0
        )
        self.running[future] = number
        return future

    def ended(self) -> Iterator[tuple[int, TaskFuture]]:
        """Wait a moment, and yield number and future of each task that has ended.

        Raises
        ------
        Cancelled
            The job is to stop.
        """
        self._job.check()
        report_away(self._executor, self._job)
        finished, _ = wait(list(self.running), timeout=0.05, return_when=FIRST_COMPLETED)
        for one in finished:
            self._job.check()
            future: TaskFuture = one  # type: ignore[assignment]  # wait() drops the futures' type
            yield self.running.pop(future), future

    def _stop(self) -> None:
        for future in list(self.running):
            future.request_stop()

    def __enter__(self) -> Self:
        self._waiting.enter_context(self._job.waiting(self._stop))
        report_away(self._executor, self._job)
        return self

    def __exit__(self, *_: object) -> None:
        with self._waiting:
            self._stop()
            wait(list(self.running), timeout=_STOPPING_S)  # a task that still runs would write after the job's end
