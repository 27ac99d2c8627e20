"""Exclusive hold on the hardware, and the one thread that drives it.

Hardware is never queued: a second caller is given the holder. Stopping needs neither the hold nor the thread.
"""

from __future__ import annotations

import contextvars
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from pydantic import Field

from stereorig.core.errors import StateError
from stereorig.server.base.errors import BusyError
from stereorig.server.base.models import Document

T = TypeVar("T")


class Holder(Document):
    """Job or request that holds the hardware; nothing else can use it."""

    purpose: str = Field(description="Purpose of the hold, in words.", examples=["a calibration"])
    job_id: str | None = Field(None, description="Id of the job, if a job holds it.")
    since_s: float = Field(description="Time since it took the hold, s.")


@dataclass(frozen=True, eq=False)
class _Hold:
    purpose: str
    #: ``job_id`` and ``kind`` of a job, ``test_id`` of a capture
    details: dict[str, str]
    since: float


class HardwareHold:
    """Exclusive hold on cameras and stage, and their owner thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._acting = threading.RLock()  # an action on a holder from outside ends before the next hold begins
        self._hold: _Hold | None = None
        self._shut = False
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="hardware")

    @property
    def holder(self) -> Holder | None:
        """Holder of the hardware; None while it is free."""
        with self._lock:
            hold = self._hold
        if hold is None:
            return None
        since_s = round(time.monotonic() - hold.since, 3)
        return Holder.model_validate({"purpose": hold.purpose, **hold.details, "since_s": since_s})

    def claim(self, purpose: str, **details: str) -> object:
        """Take the hold, or raise :class:`BusyError` with the holder; returns the token for :meth:`release`."""
        with self._acting, self._lock:
            if self._shut:
                raise StateError("The service is shutting down.", code="shutting_down", remedy="Start it again.")
            if self._hold is None:
                self._hold = _Hold(purpose, details, time.monotonic())
                return self._hold
        holder = self.holder
        if holder is None:  # released in between
            return self.claim(purpose, **details)
        raise BusyError(holder.plain())

    def while_held_by(self, job_id: str, function: Callable[[], None]) -> bool:
        """Call ``function`` if a job has the hold, and return whether; no other job gets the hold before it is done."""
        with self._acting:
            with self._lock:
                if self._hold is None or self._hold.details.get("job_id") != job_id:
                    return False
            function()
            return True

    def shut(self) -> None:
        """Allow no new hold; the present one stays."""
        with self._lock:
            self._shut = True

    def release(self, token: object) -> None:
        """Give the hold back; harmless if it is another's by now."""
        with self._lock:
            if self._hold is token:
                self._hold = None

    @contextmanager
    def hold(self, purpose: str, **details: str) -> Iterator[None]:
        """Hold for a short operation."""
        token = self.claim(purpose, **details)
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
        """Let the owner thread finish its present call, and end it."""
        self._thread.shutdown(wait=True, cancel_futures=True)
