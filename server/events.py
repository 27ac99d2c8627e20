"""What happens in the service, as a numbered stream that readers can resume.

Events live in a bounded ring. A slow reader loses the oldest ones and can see that it did (numbers jump); it never
holds up a writer.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Event:
    """One event: number, name (``job``, ``step``, ``result``, ``stage``, ``rig``) and data."""

    number: int
    name: str
    data: dict[str, Any]


class EventHub:
    """Publish from any thread, follow from the event loop."""

    def __init__(self, keep: int = 2000) -> None:
        self._lock = threading.Lock()
        self._ring: deque[Event] = deque(maxlen=keep)
        self._number = 0
        self._waiters: dict[asyncio.Event, asyncio.AbstractEventLoop] = {}
        self._closed = False

    def publish(self, name: str, data: dict[str, Any]) -> None:
        """Add an event and wake the readers."""
        with self._lock:
            self._number += 1
            self._ring.append(Event(self._number, name, data))
            waiters = list(self._waiters.items())
        self._wake(waiters)

    @staticmethod
    def _wake(waiters: list[tuple[asyncio.Event, asyncio.AbstractEventLoop]]) -> None:
        for event, loop in waiters:
            if not loop.is_closed():
                loop.call_soon_threadsafe(event.set)

    @property
    def last_number(self) -> int:
        """Number of the newest event."""
        return self._number

    def after(self, number: int) -> list[Event]:
        """Events still kept that are newer than ``number``."""
        with self._lock:
            return [e for e in self._ring if e.number > number]

    async def follow(self, after: int) -> AsyncIterator[Event]:
        """Yield events newer than ``after``, then new ones as they come, until the hub is closed."""
        woken = asyncio.Event()
        with self._lock:
            self._waiters[woken] = asyncio.get_running_loop()
        try:
            while not self._closed:
                woken.clear()
                for event in self.after(after):
                    after = event.number
                    yield event
                if not self._closed:
                    await woken.wait()
        finally:
            with self._lock:
                self._waiters.pop(woken, None)

    def close(self) -> None:
        """End every stream."""
        with self._lock:
            self._closed = True
            waiters = list(self._waiters.items())
        self._wake(waiters)
