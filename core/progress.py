"""Progress reports and cancellation of long computations."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from stereorig.core.errors import Cancelled

Progress = Callable[[str, int, int], None]
"""Called with (phase, done, total); must return quickly."""


class CancelToken(Protocol):
    """Token that a caller sets to stop the work."""

    @property
    def cancelled(self) -> bool:
        """True once the work should stop."""
        ...


class Cancel:
    """A cancel token that another thread can set."""

    def __init__(self) -> None:
        self._event = threading.Event()

    @property
    def cancelled(self) -> bool:
        """True once :meth:`set` was called."""
        return self._event.is_set()

    def set(self) -> None:
        """Ask the work to stop."""
        self._event.set()


def no_progress(phase: str, done: int, total: int) -> None:
    """Drop the report: the default without a receiver."""


def raise_if_cancelled(cancel: CancelToken | None) -> None:
    """Raise :class:`stereorig.core.errors.Cancelled` if the token is set."""
    if cancel is not None and cancel.cancelled:
        raise Cancelled("the work was cancelled before it was finished.")
