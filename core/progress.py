"""How long computations tell how far they are, and how they are told to stop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from core.errors import Cancelled

Progress = Callable[[str, int, int], None]
"""Called with (stage, done, total); must return quickly."""


class CancelToken(Protocol):
    """Anything that can say that the caller has lost interest."""

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
    """Drop the report: the default where nobody listens."""


def raise_if_cancelled(cancel: CancelToken | None) -> None:
    """Raise :class:`core.errors.Cancelled` if the token says so."""
    if cancel is not None and cancel.cancelled:
        raise Cancelled("the work was cancelled before it was finished.")
