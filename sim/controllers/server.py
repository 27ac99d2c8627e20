"""Serve a simulated controller on a loopback TCP port or a pty, so that real drivers open it as a serial URL.

Loopback only: the simulated controller moves nothing real, but it is for clients on this machine alone.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
import tty
from collections.abc import Iterator
from types import TracebackType
from typing import Literal, Self

from stereorig.sim.controllers.wire import WireController

_LONGEST_LINE = 4096


class ControllerServer:
    """Runs in one thread until closed; use it as a context manager.

    Parameters
    ----------
    controller
        The controller that answers.
    transport
        ``socket`` (any number of clients) or ``pty``.
    port
        TCP port, 0 for any free one.
    """

    def __init__(
        self, controller: WireController, transport: Literal["socket", "pty"] = "socket", *, port: int = 0
    ) -> None:
        self.controller = controller
        self.url = ""
        self._transport = transport
        self._port = port
        self._selector = selectors.DefaultSelector()
        self._buffers: dict[int, bytearray] = {}
        self._sockets: dict[int, socket.socket] = {}
        self._listener: socket.socket | None = None
        self._pty: tuple[int, int] | None = None
        self._wake_read = self._wake_write = -1
        self._hung_up = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulated controller", daemon=True)

    def start(self) -> Self:
        """Open the line and answer on it, at `url`; OSError if the port cannot be had."""
        if self._transport == "socket":
            self._listener = socket.create_server(("127.0.0.1", self._port))
            self._selector.register(self._listener, selectors.EVENT_READ)
            self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        else:
            near, far = os.openpty()
            tty.setraw(far)
            # the far end stays open here: else reading fails whenever no client has it open
            self._pty = (near, far)
            self._buffers[near] = bytearray()
            self._selector.register(near, selectors.EVENT_READ)
            self.url = os.ttyname(far)
        self._wake_read, self._wake_write = os.pipe()
        self._selector.register(self._wake_read, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __enter__(self) -> Self:
        return self if self._thread.is_alive() else self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and release the port; safe to call twice."""
        if self._thread.is_alive():
            os.write(self._wake_write, b"x")
            self._thread.join()

    def hang_up(self) -> None:
        """Drop every TCP client, as when the cable is pulled out of a terminal server; return when they are dropped."""
        self._hung_up.clear()
        os.write(self._wake_write, b"h")
        self._hung_up.wait(10.0)

    def _run(self) -> None:
        try:
            while self._serve():
                pass
        finally:
            self._drop_clients()
            self._selector.close()
            if self._listener is not None:
                self._listener.close()
            if self._pty is not None:
                os.close(self._pty[0])
                os.close(self._pty[1])
            os.close(self._wake_read)
            os.close(self._wake_write)

    def _serve(self) -> bool:
        for key, _ in self._selector.select():
            if key.fd == self._wake_read:
                order = os.read(self._wake_read, 1)
                if order == b"x":
                    return False
                self._drop_clients()
                self._hung_up.set()
                break
            if self._listener is not None and key.fd == self._listener.fileno():
                self._accept(self._listener)
            else:
                self._read(key.fd)
        return True

    def _accept(self, listener: socket.socket) -> None:
        client, _ = listener.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sockets[client.fileno()] = client
        self._buffers[client.fileno()] = bytearray()
        self._selector.register(client, selectors.EVENT_READ)

    def _read(self, fd: int) -> None:
        try:
            data = os.read(fd, 4096)
        except OSError:
            data = b""
        if not data:
            self._drop(fd)
            return
        buffer = self._buffers[fd]
        buffer += data
        for line in self._lines(buffer):
            reply = self.controller.take_line(line)
            if reply:
                self._send(fd, reply)
        if len(buffer) > _LONGEST_LINE:
            buffer.clear()

    def _lines(self, buffer: bytearray) -> Iterator[bytes]:
        """Cut whole command lines off the front of a buffer."""
        end = self.controller.terminator
        while (at := buffer.find(end)) >= 0:
            line = bytes(buffer[:at])
            del buffer[: at + len(end)]
            yield line

    def _send(self, fd: int, data: bytes) -> None:
        # a client that has left is dropped at the next read
        with contextlib.suppress(OSError):
            os.write(fd, data)

    def _drop(self, fd: int) -> None:
        client = self._sockets.pop(fd, None)
        if client is None:
            return
        self._selector.unregister(client)
        del self._buffers[fd]
        client.close()

    def _drop_clients(self) -> None:
        for fd in list(self._sockets):
            self._drop(fd)
