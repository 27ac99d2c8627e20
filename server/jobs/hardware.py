"""Who holds the hardware, and the one thread that talks to it.

Hardware is never queued: a second caller is told who has it. Stopping needs neither the hold nor the thread.
"""

from __future__ import annotations

import contextvars
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from core.errors import StateError
from server.base.errors import BusyError

T = TypeVar("T")


class HardwareGate:
    """Exclusive hold on cameras and stage, and their owner thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._acting = threading.RLock()  # what is done to a holder from outside comes before the next one's hold
        self._holder: dict[str, Any] | None = None
        self._shut = False
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="hardware")

    @property
    def holder(self) -> dict[str, Any] | None:
        """Who holds the hardware: ``what``, ``since_s`` and, for a job, ``job_id``."""
        with self._lock:
            if self._holder is None:
                return None
            shown = dict(self._holder)
        shown["since_s"] = round(time.monotonic() - shown.pop("since"), 3)
        return shown

    def claim(self, what: str, **details: Any) -> object:
        """Take the hold, or raise :class:`BusyError` with the holder; returns the token for :meth:`release`."""
        with self._acting, self._lock:
            if self._shut:
                raise StateError("The service is shutting down.", code="shutting_down", remedy="Start it again.")
            if self._holder is None:
                self._holder = {"what": what, **details, "since": time.monotonic()}
                return self._holder
        holder = self.holder
        if holder is None:  # released in between
            return self.claim(what, **details)
        raise BusyError(holder)

    def while_held_by(self, job_id: str, function: Callable[[], None]) -> bool:
        """Call ``function`` if a job has the hold, and return whether; nobody else gets the hold before it is done."""
        with self._acting:
            with self._lock:
                if self._holder is None or self._holder.get("job_id") != job_id:
                    return False
            function()
            return True

    def shut(self) -> None:
        """Let nobody take the hold from now on; who has it keeps it."""
        with self._lock:
            self._shut = True

    def release(self, token: object) -> None:
        """Give the hold back; harmless if it is another's by now."""
        with self._lock:
            if self._holder is token:
                self._holder = None

    @contextmanager
    def hold(self, what: str, **details: Any) -> Iterator[None]:
        """Hold for a short operation."""
        token = self.claim(what, **details)
        try:
            yield
        finally:
            self.release(token)

    def start(self, function: Callable[[], None]) -> None:
        """Run ``function`` on the owner thread, without waiting."""
        self._thread.submit(contextvars.copy_context().run, function)

    def call(self, function: Callable[[], T]) -> T:
        """Run ``function`` on the owner thread and wait."""
        return self._thread.submit(contextvars.copy_context().run, function).result()

    def close(self) -> None:
        """Let the owner thread end after what it is doing."""
        self._thread.shutdown(wait=True, cancel_futures=True)
