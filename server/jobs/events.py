"""Events of the service, as a numbered stream that readers can resume.

Events are kept in a bounded ring. A slow reader loses the oldest ones and gets an event ``gap``; it never holds up
a writer. Numbers grow over restarts too, so that a reader that returns after one learns which events it missed.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass

_AT_ONCE = 20


@dataclass(frozen=True)
class Event:
    """One event: number, name (``job``, ``step``, ``result``, ``step_failed``, ``gap`` ...) and data."""

    number: int
    name: str
    data: Mapping[str, object]


class EventHub:
    """Publish from any thread, follow from the event loop.

    Parameters
    ----------
    keep
        How many events a reader may be behind.
    """

    def __init__(self, keep: int = 2000) -> None:
        self._lock = threading.Lock()
        self._ring: deque[Event] = deque(maxlen=keep)
        self._number = 0
        self._waiters: dict[asyncio.Event, asyncio.AbstractEventLoop] = {}
        self._closed = False
        self._listeners: list[Callable[[str, Mapping[str, object]], None]] = []

    def number_from(self, start: int) -> None:
        """Let the events' numbers begin after ``start``; call it before the first event."""
        self._number = start

    def listen(self, listener: Callable[[str, Mapping[str, object]], None]) -> None:
        """Call ``listener`` with name and data of each event, in the publisher's thread: it must be quick."""
        self._listeners.append(listener)

    def publish(self, name: str, data: Mapping[str, object]) -> None:
        """Add an event and wake the readers."""
        with self._lock:
            self._number += 1
            self._ring.append(Event(self._number, name, data))
            waiters = list(self._waiters.items())
        self._wake(waiters)
        for listener in self._listeners:
            listener(name, data)

    @staticmethod
    def _wake(waiters: list[tuple[asyncio.Event, asyncio.AbstractEventLoop]]) -> None:
        for event, loop in waiters:
            if not loop.is_closed():
                loop.call_soon_threadsafe(event.set)

    @property
    def last_number(self) -> int:
        """Number of the newest event."""
        return self._number

    def after(self, number: int, limit: int | None = None) -> list[Event]:
        """Events still kept that are newer than ``number``, oldest first, at most so many."""
        with self._lock:
            kept = len(self._ring)
            # their numbers are consecutive, which gives the index of each
            first = 0 if kept == 0 else max(number + 1 - self._ring[0].number, 0)
            last = kept if limit is None else min(first + limit, kept)
            return [self._ring[index] for index in range(first, last)]

    def gap(self, number: int) -> Event | None:
        """Return the event ``gap`` for a reader that had ``number`` last and lost some since; None if none are lost.

        Its own number is the one from which the reader can continue.
        """
        with self._lock:
            known = self._number - len(self._ring)
            if known <= number <= self._number:
                return None
        return Event(known, "gap", {"after": number, "next": known + 1})

    async def follow(self, after: int) -> AsyncIterator[Event]:
        """Yield events newer than ``after``, then new ones as they come, until the hub is closed.

        Where some are lost to the reader, an event ``gap`` comes first: its state is out of date, to be read again.
        """
        woken = asyncio.Event()
        with self._lock:
            self._waiters[woken] = asyncio.get_running_loop()
        try:
            while not self._closed:
                woken.clear()
                lost = self.gap(after)
                if lost is not None:
                    after = lost.number
                    yield lost
                # few at a time: a reader that is slow must not hold on to all that it has not read
                events = self.after(after, _AT_ONCE)
                for event in events:
                    after = event.number
                    yield event
                if not events and not self._closed:
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
