"""Number of open streams: each holds a connection for hours, so each kind has its limit."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from stereorig.server.base.errors import QueueFullError

StreamKind = Literal["live_view", "events"]
_WORDS: dict[StreamKind, str] = {"live_view": "live views", "events": "event streams"}


class Streams:
    """Counts streams.

    Parameters
    ----------
    live_view, events
        Maximum number of open streams of each kind.
    """

    def __init__(self, *, live_view: int, events: int) -> None:
        self._limits: dict[StreamKind, int] = {"live_view": live_view, "events": events}
        self._open: dict[StreamKind, int] = {"live_view": 0, "events": 0}
        self._lock = threading.Lock()

    def counts(self) -> dict[StreamKind, int]:
        """Return the number of open streams."""
        with self._lock:
            return dict(self._open)

    def check(self, kind: StreamKind) -> None:
        """Raise an error before an answer begins.

        Raises
        ------
        QueueFullError
            ``too_many_streams``.
        """
        with self._lock:
            limit, open_now = self._limits[kind], self._open[kind]
        if open_now >= limit:
            raise QueueFullError(
                f"{limit} {_WORDS[kind]} are open already.",
                code="too_many_streams",
                remedy="Close one, or wait and try again.",
            )

    @contextmanager
    def counted(self, kind: StreamKind) -> Iterator[None]:
        """Count one for as long as the block lasts."""
        with self._lock:
            self._open[kind] += 1
        try:
            yield
        finally:
            with self._lock:
                self._open[kind] -= 1
