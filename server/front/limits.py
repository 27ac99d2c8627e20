"""Limits of a connection."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of a connection.

    Parameters
    ----------
    max_open
        Connections at once.
    header_s
        Time for a request's headers, from the connection's beginning or the headers' first byte.
    body_bytes_per_s
        Pace below which a body is too slow, over ``body_s``.
    body_s
        Time over which the pace is measured.
    unread_s
        How long a client may take nothing of an answer that waits for it.
    idle_s
        How long a connection without a request stays. Clients take up an idle one for some seconds (httpx for 5, other
        programs for up to 60): if the service ends it in that moment, the request is lost. So it waits longer.
    """

    max_open: int = 1000
    header_s: float = 15.0
    body_bytes_per_s: float = 1000.0
    body_s: float = 20.0
    unread_s: float = 60.0
    idle_s: int = 75
