"""Addresses that are shut out for a minute, after ten wrong keys, cookies or words within a minute."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import ipaddress
import time
from collections import OrderedDict, deque
from collections.abc import Callable

MOST_WRONG = 10
WITHIN_S = 60.0
SHUT_S = 60.0
_MOST_ADDRESSES = 10_000


def _no_note(**_entries: object) -> None:
    """Do nothing, in place of the audit log."""


class ShutOut:
    """Counts wrong keys, cookies and words by address; belongs to one event loop.

    Parameters
    ----------
    note
        Called at the begin and at the end of each time that an address is shut out: the audit log.
    """

    def __init__(self, note: Callable[..., None] = _no_note) -> None:
        self._note = note
        self._wrong: OrderedDict[str, deque[tuple[float, bytes]]] = OrderedDict()
        self._until: OrderedDict[str, float] = OrderedDict()

    def left_s(self, address: str) -> float:
        """Return how long an address remains shut out; 0 if it is not."""
        place = _place(address)
        until = self._until.get(place)
        if until is None:
            return 0.0
        left = until - time.monotonic()
        if left <= 0.0:
            self._end(place)
        return max(0.0, left)

    def wrong(self, address: str, cookie: str = "") -> None:
        """Count a wrong key or word, or a cookie of no session.

        A cookie counts once: the page sends the one of an ended session with each picture, until its user sees it.
        """
        place, now = _place(address), time.monotonic()
        if place in self._until:
            return
        mark = hashlib.sha256(cookie.encode()).digest() if cookie else b""
        counted = self._wrong.setdefault(place, deque())
        self._wrong.move_to_end(place)
        while counted and now - counted[0][0] > WITHIN_S:
            counted.popleft()
        if mark and any(mark == earlier for _, earlier in counted):
            return
        counted.append((now, mark))
        if len(counted) >= MOST_WRONG:
            self._begin(place, now)
        while len(self._wrong) > _MOST_ADDRESSES:
            self._wrong.popitem(last=False)

    def _begin(self, place: str, now: float) -> None:
        del self._wrong[place]
        self._until[place] = now + SHUT_S
        self._note(event="shut_out", address=place, wrong=MOST_WRONG, seconds=SHUT_S)
        while len(self._until) > _MOST_ADDRESSES:
            self._end(next(iter(self._until)))
        with contextlib.suppress(RuntimeError):  # without a loop the end is noted when the address asks again
            asyncio.get_running_loop().call_later(SHUT_S + 0.01, self.left_s, place)

    def _end(self, place: str) -> None:
        if self._until.pop(place, None) is not None:
            self._note(event="shut_out_ended", address=place)


def _place(address: str) -> str:
    """Return the address to count by: for IPv6 the network in which one client can choose addresses."""
    try:
        found = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return address
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    if found.is_link_local or found.is_loopback:
        return address
    return str(ipaddress.ip_network((int(found) >> 64 << 64, 64)).network_address)
