"""The front: takes every client's connection, halts the stage by itself, and passes all else to the web process."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import resource
import socket
import ssl
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

from stereorig.server.front.client import ClientConnection, Clients
from stereorig.server.front.messages import ConnectionLimits, Halt, HaltFailed, HaltMade, Headers

__all__ = ["ConnectionLimits", "Front", "HaltFailed", "HaltMade"]

_log = logging.getLogger("stereorig.front")

_BACKLOG = 2048
_ACCEPTED_A_TURN = 64
_SWEEP_S = 1.0
# accepting rests so long when it cannot: the loop must not spin
_REST_S = 0.05
# descriptors for all that is no connection of a client
_OTHER_DESCRIPTORS = 32
_NO_DESCRIPTOR = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class Front:
    """An HTTP/1.1 proxy before the web process, which serves the stage's halts by itself.

    Parameters
    ----------
    upstream
        Unix socket of the web process; it may be away for a while.
    limits
        Limits of a connection.
    halt
        Puts a halt on the stage's wire; raises :class:`HaltFailed` if it cannot.
    may_halt
        Whether the headers of a request permit a halt; if they do not, the web process refuses the request.
    refused
        Called with the reason when a connection is ended: ``too_many``, ``slow_headers``, ``slow_body``, ``unread``.
    tls
        Certificate and key, to serve https.
    trusted_proxies
        Addresses of proxies whose ``X-Forwarded-For`` and ``X-Forwarded-Proto`` hold.
    """

    def __init__(
        self,
        *,
        upstream: Path,
        limits: ConnectionLimits,
        halt: Callable[[Halt], Awaitable[HaltMade]],
        may_halt: Callable[[Halt, Headers], bool],
        refused: Callable[[str], None],
        tls: ssl.SSLContext | None = None,
        trusted_proxies: frozenset[str] = frozenset({"127.0.0.1", "::1"}),
    ) -> None:
        self._tls = tls
        self._clients = Clients(
            web=upstream,
            limits=limits,
            max_open=limits.max_open,
            halt=halt,
            may_halt=may_halt,
            refused=refused,
            scheme=b"http" if tls is None else b"https",
            trusted=trusted_proxies,
        )
        self._listener: socket.socket | None = None
        self._loop: asyncio.AbstractEventLoop
        self._sweeping: asyncio.TimerHandle | None = None
        self._spare: int | None = None
        self._complained = -float("inf")
        self._greeted = 0

    async def start(self, listener: socket.socket) -> None:
        """Listen, and serve.

        Parameters
        ----------
        listener
            A bound socket; :meth:`close` closes it.
        """
        self._loop = asyncio.get_running_loop()
        # a client takes two descriptors, and one that only may halt another; so they never run out
        descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        self._clients.max_open = min(self._clients.limits.max_open, max(4, (descriptors - _OTHER_DESCRIPTORS) // 4))
        listener.setblocking(False)
        listener.listen(_BACKLOG)
        self._listener = listener
        self._accept_again()
        self._sweep()

    async def close(self, grace_s: float) -> None:
        """Take no more connections, give requests ``grace_s`` seconds to end, then end them."""
        self._clients.closing = True
        if self._listener is not None:
            self._loop.remove_reader(self._listener)
            self._listener.close()
            self._listener = None
        deadline = self._loop.time() + grace_s
        for connection in list(self._clients.open):
            connection.close_after_answer()
        while (self._clients.open or self._clients.tasks) and self._loop.time() < deadline:
            await asyncio.sleep(0.02)
        for connection in list(self._clients.open):
            connection.end()
        for task in list(self._clients.tasks):
            task.cancel()
        await asyncio.sleep(0)  # they end in the next turn of the loop
        if self._sweeping is not None:
            self._sweeping.cancel()
        if self._spare is not None:
            os.close(self._spare)
            self._spare = None

    def _accept_again(self) -> None:
        if self._listener is not None:
            if self._spare is None:
                with contextlib.suppress(OSError):
                    self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
            self._loop.add_reader(self._listener, self._accept)

    def _accept(self) -> None:
        for _ in range(_ACCEPTED_A_TURN):
            if self._listener is None:
                return
            try:
                accepted, _ = self._listener.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                self._rest(error)
                return
            # handshakes count too, or a flood of them would take every descriptor
            if len(self._clients.open) + self._greeted >= 2 * self._clients.max_open + _ACCEPTED_A_TURN:
                self._clients.refused("too_many")
                accepted.close()
                continue
            self._greeted += 1
            self._clients.run(self._greet(accepted))

    async def _greet(self, accepted: socket.socket) -> None:
        """Begin a connection; one that speaks no TLS is dropped."""
        try:
            accepted.setblocking(False)
            if accepted.family in (socket.AF_INET, socket.AF_INET6):
                accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            await self._loop.connect_accepted_socket(
                lambda: ClientConnection(self._clients),
                accepted,
                ssl=self._tls,
                ssl_handshake_timeout=None if self._tls is None else self._clients.limits.header_s,
            )
        except OSError:  # and all of TLS
            accepted.close()
        finally:
            self._greeted -= 1

    def _rest(self, error: OSError) -> None:
        """Make room if no further connection can be accepted, and accept after a pause."""
        assert self._listener is not None
        now = time.monotonic()
        if now - self._complained >= 1.0:
            self._complained = now
            _log.error("no further connection can be accepted: %s", error.strerror)
        if error.errno in _NO_DESCRIPTOR and not self._clients.make_room() and self._spare is not None:
            os.close(self._spare)  # so that one can be accepted and closed: its client need not wait
            with contextlib.suppress(OSError):
                self._listener.accept()[0].close()
                self._clients.refused("too_many")
            self._spare = None
        self._loop.remove_reader(self._listener)
        self._loop.call_later(_REST_S, self._accept_again)

    def _sweep(self) -> None:
        """End connections that are too slow, and close those that wait too long for a request."""
        self._sweeping = self._loop.call_later(_SWEEP_S, self._sweep)
        now = time.monotonic()
        for connection in list(self._clients.open):
            connection.check(now)
