"""One reading for all who ask at the same time: a serial line answers one question after another."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class SharedReading(Generic[T]):
    """Shares readings between callers; none gets a reading that began before its call.

    Parameters
    ----------
    read
        Takes one reading; every waiting caller gets its error.
    """

    def __init__(self, read: Callable[[], T]) -> None:
        self._read = read
        self._changed = threading.Condition()
        self._reading = False
        self._begun = 0
        self._ended = 0
        self._last: tuple[T, None] | tuple[None, BaseException] | None = None

    def __call__(self) -> T:
        """Return a reading that began after this call did."""
        with self._changed:
            wanted = self._begun + 1
            while self._reading and self._ended < wanted:
                self._changed.wait()
            mine = self._ended < wanted
            if mine:
                self._reading = True
                self._begun += 1
        if mine:
            self._take()
        with self._changed:
            assert self._last is not None
            value, error = self._last
        if error is not None:
            raise error
        return value  # type: ignore[return-value]  # without an error there is a value

    def _take(self) -> None:
        taken: tuple[T, None] | tuple[None, BaseException]
        try:
            taken = self._read(), None
        except BaseException as error:  # noqa: BLE001 - every caller gets it
            taken = None, error
        with self._changed:
            self._last = taken
            self._ended = self._begun
            self._reading = False
            self._changed.notify_all()
