"""The web process' server: uvicorn on a Unix socket, and its control by the front process."""

from __future__ import annotations

import json
import logging
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI

from stereorig.server.workflows.service import Service

_log = logging.getLogger("stereorig.serving")
_GRACE_S = 3
_MAX_MESSAGE = 4096  # bytes: clients of a WebSocket listen, and have nothing to say
_CONTROL_BYTES = 65536


class WebServer(uvicorn.Server):
    """Serves a service's app until it is asked to end.

    Parameters
    ----------
    app, service
        The app, and the service behind it.
    path
        Unix socket to listen at, for the front process: it names clients in ``X-Forwarded-For``.
    announce
        Called when requests are served.
    """

    def __init__(
        self, app: FastAPI, service: Service, path: Path, *, announce: Callable[[], None] = lambda: None
    ) -> None:
        self._service = service
        self._announce = announce
        super().__init__(
            uvicorn.Config(
                app,
                uds=str(path),
                http="h11",
                ws="wsproto",
                ws_max_size=_MAX_MESSAGE,
                log_config=None,  # its lines go where all go
                access_log=False,
                server_header=False,
                timeout_keep_alive=24 * 3600,  # the front process ends connections that wait too long
                timeout_graceful_shutdown=_GRACE_S,
                lifespan="on",
                proxy_headers=True,
                forwarded_allow_ips="*",  # no other process can reach the socket
            )
        )

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to serve, and announce it."""
        await super().startup(sockets=sockets)
        if self.started:
            self._announce()

    def end(self) -> None:
        """Stop the stage first of all, then let the server end; any thread may call it."""
        self._service.begin_end()
        self.should_exit = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End: the stage, then streams, then requests, then the rest (the app's lifespan closes the service)."""
        self._service.begin_end()
        self._service.stop_streams()  # or it would wait for them
        await super().shutdown(sockets=sockets)


class FrontLink:
    """Control of the web process by the front process, in a thread of its own.

    Parameters
    ----------
    control
        Datagram socket (SOCK_SEQPACKET) to the front process, with JSON in each message.
    """

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._service: Service | None = None
        self._server: WebServer | None = None
        threading.Thread(target=self._obey, name="front", daemon=True).start()

    def serve(self, service: Service, server: WebServer) -> None:
        """Obey for this service and server from now on."""
        self._service, self._server = service, server

    def ready(self, about: dict[str, Any]) -> None:
        """Report that requests are served."""
        self._control.send(json.dumps({"ready": about}).encode())

    def _obey(self) -> None:
        while data := self._control.recv(_CONTROL_BYTES):
            asked = json.loads(data)
            service, server = self._service, self._server
            if asked["do"] == "end":
                if server is None:
                    os._exit(0)  # nothing is open for clients yet; a start can be ended at any instant
                server.end()
            elif asked["do"] == "ping":
                alive = service is None or service.is_alive()
                self._control.send(json.dumps({"of": asked["id"], "alive": alive}).encode())
            elif asked["do"] == "count" and service is not None:
                for why, number in asked["refused"].items():
                    service.metrics.connections_refused.labels(why).inc(number)
