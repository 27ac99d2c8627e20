"""Reading ahead and writing behind: disk and decoder at work while points are fitted, one item each way.

Both keep the order of the items, hold one item at most besides the one in work, and hand errors over where a plain loop
would have met them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Generic, TypeVar

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
        """Return the next result, or raise what reading it raised; reading the one after it begins."""
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
