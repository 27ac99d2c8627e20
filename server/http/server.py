"""The HTTP server: uvicorn, with our limits on connections, and with an end in which the stage comes first."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI

from server.http.connections import ConnectionLimits, Connections
from server.http.systemd import Notifier
from server.workflows.service import Service

_log = logging.getLogger("stereorig.serving")
_GRACE_S = 3
_SWEEP_TICKS = 10  # of 0.1 s
_MAX_MESSAGE = 4096  # bytes: clients of a WebSocket listen, and have nothing to say


class OrderlyServer(uvicorn.Server):
    """Serves a service's app until it is asked to end.

    Parameters
    ----------
    app, service
        What it serves, and the service behind it.
    limits
        What a connection may take; by default those of the rig file.
    notifier
        Tells systemd.
    announce
        Called when clients are served.
    tls
        Certificate and key.
    """

    def __init__(
        self,
        app: FastAPI,
        service: Service,
        *,
        limits: ConnectionLimits | None = None,
        notifier: Notifier | None = None,
        announce: Callable[[], None] | None = None,
        tls: tuple[Path, Path] | None = None,
    ) -> None:
        self._service = service
        self._notifier = notifier or Notifier({})
        self._announce = announce
        self._keeper = Connections(
            limits or ConnectionLimits(max_open=service.config.service.connections),
            lambda why: service.metrics.connections_refused.labels(why).inc(),
        )
        self._ticks = 0
        self._probe: asyncio.Future[bool] | None = None
        super().__init__(
            uvicorn.Config(
                app,
                http=self._keeper.protocol(),
                ws="wsproto",
                ws_max_size=_MAX_MESSAGE,
                log_config=None,  # its lines go where all go
                access_log=False,
                server_header=False,
                timeout_keep_alive=self._keeper.limits.idle_s,
                timeout_graceful_shutdown=_GRACE_S,
                lifespan="on",
                ssl_certfile=None if tls is None else tls[0],
                ssl_keyfile=None if tls is None else tls[1],
            )
        )

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """End in order on SIGINT and SIGTERM."""
        if threading.current_thread() is not threading.main_thread():
            yield  # signals are not its business there
            return
        # uvicorn raises a signal again after its shutdown, which would end the process before it is tidy
        earlier = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in earlier.items():
                signal.signal(number, handler)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Stop the stage first of all, then let the server end."""
        self._service.begin_end()
        self._notifier.stopping()
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve, and say so."""
        await super().startup(sockets=sockets)
        if self.started:
            if self._announce is not None:
                self._announce()
            self._notifier.ready(f"serves the {self._service.config.rig.name}")

    async def on_tick(self, counter: int) -> bool:
        """Look after connections and watchdog; called ten times a second."""
        self._ticks += 1
        if self._ticks % _SWEEP_TICKS == 0:
            self._keeper.sweep(self.server_state.connections)
        if self._notifier.is_due() and (self._probe is None or self._probe.done()):
            # by the way that a stop takes: where that is stuck, a restart is what helps
            loop = asyncio.get_running_loop()
            self._probe = loop.run_in_executor(self._service.stop_thread, self._service.is_alive)
            self._probe.add_done_callback(self._probed)
        return await super().on_tick(counter)

    def _probed(self, probe: asyncio.Future[bool]) -> None:
        if not probe.cancelled() and probe.exception() is None and probe.result():
            self._notifier.alive()
        else:
            _log.error("a part of the service has ended; the watchdog is not notified")

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End: the stage, then streams, then requests, then the rest (the app's lifespan closes the service)."""
        self._service.begin_end()  # a server in a thread receives no signal
        self._service.stop_streams()  # or it would wait for them
        await super().shutdown(sockets=sockets)
