"""A front in a thread, before a web process that is uvicorn in another thread, or a script."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import uvicorn
from fastapi import FastAPI

from stereorig.server.front.front import ConnectionLimits, Front, HaltFailed, HaltMade


@dataclass
class Fronted:
    """A front that serves: its port, the halts that it made and the connections that it refused."""

    port: int = 0
    halts: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    permits: bool = True
    fails: bool = False
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.new_event_loop)

    async def halt(self, action: Literal["stop", "abort"]) -> HaltMade:
        """Count a halt."""
        if self.fails:
            raise HaltFailed("The controller does not answer.")
        self.halts.append(action)
        return HaltMade(len(self.halts), 1.5)

    def may_halt(self, action: str, headers: Sequence[tuple[bytes, bytes]]) -> bool:
        """Permit a halt as the test wants."""
        return self.permits and bool(action) and any(name == b"host" for name, _ in headers)


@contextlib.contextmanager
def fronted(
    web: Path, limits: ConnectionLimits, *, tls: ssl.SSLContext | None = None, send_buffer: int | None = None
) -> Iterator[Fronted]:
    """Serve on a free port of loopback, with ``web`` as the web process' socket."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if send_buffer is not None:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer)
    listener.bind(("127.0.0.1", 0))
    found = Fronted(int(listener.getsockname()[1]))
    front = Front(
        upstream=web, limits=limits, halt=found.halt, may_halt=found.may_halt, refused=found.refused.append, tls=tls
    )
    loop = found.loop
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    asyncio.run_coroutine_threadsafe(front.start(listener), loop).result(30.0)
    try:
        yield found
    finally:
        asyncio.run_coroutine_threadsafe(front.close(1.0), loop).result(30.0)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10.0)
        loop.close()


@contextlib.contextmanager
def web_process(app: FastAPI, path: Path) -> Iterator[None]:
    """Serve an app on a unix socket, as the web process does."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(path))
    listener.listen(2048)
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        ws="wsproto",
        proxy_headers=True,
        forwarded_allow_ips="*",
        timeout_keep_alive=3600,
        timeout_graceful_shutdown=2,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.should_exit = True
        thread.join(20.0)
        listener.close()
