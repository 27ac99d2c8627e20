"""Reading ahead, writing behind and measuring ahead: disk, decoder and fits at work together, one item each way.

All keep the order of the items, hold one item at most in addition to the one in work, and raise errors at the place
where a plain loop would have met them.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, TypeVar

from stereorig.core.field.points.result import Field
from stereorig.core.progress import CancelToken, Progress
from stereorig.server.compute.tasks import StepImages
from stereorig.server.worker.process import TaskChannel

Item = TypeVar("Item")
Result = TypeVar("Result")


class ReadAhead(Generic[Item, Result]):
    """Results of ``read(item)`` in order; while one is in use, the next is being read.

    >>> with ReadAhead(str, [1, 2]) as ahead:
    ...     list(ahead)
    ['1', '2']

    Parameters
    ----------
    read
        Called on a thread of its own.
    items
        Items to read, in the order in which they are taken.
    """

    def __init__(self, read: Callable[[Item], Result], items: Iterable[Item]) -> None:
        self._read = read
        self._items = iter(items)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="stereorig-read")
        self._next = self._submit()

    def __iter__(self) -> ReadAhead[Item, Result]:
        return self

    def __next__(self) -> Result:
        """Return the next result, or raise the error of reading it; begin to read the one after it."""
        if self._next is None:
            raise StopIteration
        try:
            return self._next.result()
        finally:
            self._next = self._submit()

    def _submit(self) -> Future[Result] | None:
        for item in self._items:
            return self._pool.submit(self._read, item)
        return None

    def __enter__(self) -> ReadAhead[Item, Result]:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


class WriteBehind(Generic[Result]):
    """Calls on a thread of its own, one at a time and in order; results come in order from :meth:`finish`.

    Leaving the ``with`` block waits for the call under way. If a call failed, its error is raised: at the next
    :meth:`put`, at :meth:`finish`, or on leaving the block, before any later error.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="stereorig-write")
        self._pending: Future[Result] | None = None
        self._results: list[Result] = []

    def put(self, function: Callable[..., Result], *args: Any) -> None:
        """Start ``function(*args)`` once the call before it has ended well."""
        self._wait()
        self._pending = self._pool.submit(function, *args)

    def finish(self) -> list[Result]:
        """Wait for the last call; return the results of all."""
        self._wait()
        return self._results

    def _wait(self) -> None:
        pending, self._pending = self._pending, None
        if pending is not None:
            self._results.append(pending.result())

    def __enter__(self) -> WriteBehind[Result]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._wait()
        finally:
            self._pool.shutdown(wait=True)


@dataclass(frozen=True)
class MeasuredStep:
    """A measured step and the time that it took, s."""

    field: Field
    seconds: float


Measure = Callable[[Progress, CancelToken], Field]


@dataclass(frozen=True)
class RequestedStep:
    """A task's request: a step of a measurement, and the step that it starts from, or its head; or a head."""

    measurement: str
    step: StepImages
    previous: int | None
    from_head: bool = False
    against: int | None = None


def timed(measure: Measure, progress: Progress, cancel: CancelToken) -> MeasuredStep:
    """Measure a step now."""
    began = time.perf_counter()
    field = measure(progress, cancel)
    return MeasuredStep(field, round(time.perf_counter() - began, 3))


class _Channel:
    """Progress and cancellation of a step that was begun before its task: the task's own, once it is there."""

    def __init__(self) -> None:
        self.task: TaskChannel | None = None
        self.dropped = threading.Event()

    @property
    def cancelled(self) -> bool:
        return self.dropped.is_set() or (self.task is not None and self.task.cancelled)

    def progress(self, phase: str, done: int, total: int) -> None:
        if self.task is not None:
            self.task.progress(phase, done, total)


class MeasureAhead:
    """The next step of a sequence, measured while the last one's file is written.

    A step depends on the one before, not on its file. One step at most is begun before it is asked for; its result or
    error goes to the task that asks for just this step, and is dropped if another step is asked for.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="stereorig-ahead")
        self._begun: tuple[RequestedStep, _Channel, Future[MeasuredStep]] | None = None

    def begin(self, asked: RequestedStep, measure: Measure) -> None:
        """Begin a step; the one before was taken or dropped."""
        channel = _Channel()
        self._begun = asked, channel, self._pool.submit(timed, measure, channel.progress, channel)

    def take(self, asked: RequestedStep, task: TaskChannel) -> MeasuredStep | None:
        """Return the step if it was begun, once it is measured; else None, and nothing else is under way.

        Raises
        ------
        Exception
            The error of its measurement.
        """
        if self._begun is None or self._begun[0] != asked:
            self.drop()
            return None
        _, channel, future = self._begun
        self._begun, channel.task = None, task
        return future.result()

    def drop(self) -> None:
        """Stop the step that was begun, and wait until it has ended."""
        if self._begun is None:
            return
        _, channel, future = self._begun
        self._begun = None
        channel.dropped.set()
        with contextlib.suppress(Exception):  # the step is not wanted any more
            future.result()
