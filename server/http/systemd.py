"""Notifications of a service to systemd: ready, alive, ending (sd_notify's datagrams)."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping


class Notifier:
    """Reports the state to systemd; silent without it.

    Parameters
    ----------
    environment
        Variables among which ``NOTIFY_SOCKET``, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` are read.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        found = os.environ if environment is None else environment
        path = found.get("NOTIFY_SOCKET", "")
        # a name that begins with @ is abstract: it is in no folder
        self._address = f"\0{path[1:]}" if path.startswith("@") else path
        self._every_s = _watchdog_s(found) / 2.0
        self._due = time.monotonic()

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            channel.setblocking(False)  # a silent reader must not block the service
            channel.sendto("\n".join(lines).encode(), self._address)

    def ready(self, status: str) -> None:
        """Say that clients are served now."""
        self._send("READY=1", f"STATUS={status}")

    def stopping(self) -> None:
        """Say that the end has begun."""
        self._send("STOPPING=1", "STATUS=ending")

    def alive(self) -> None:
        """Say that the watchdog need not bark yet."""
        self._send("WATCHDOG=1")

    def is_due(self) -> bool:
        """Return True if it is time for :meth:`alive` again; twice in each of the watchdog's periods."""
        now = time.monotonic()
        if self._every_s <= 0.0 or not self._address or now < self._due:
            return False
        self._due = now + self._every_s
        return True


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """Return the watchdog's period, s; 0 if there is none, or it is another process'."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    try:
        return max(int(environment.get("WATCHDOG_USEC", "0")) / 1e6, 0.0)
    except ValueError:
        return 0.0
