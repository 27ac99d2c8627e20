"""A terminal server after RFC 2217: a TCP port before a serial port, with baud rate and control by telnet options.

pyserial's own `PortManager` does the protocol; the serial port is a pty on which a simulated controller sits.
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from typing import Any

import serial
import serial.rfc2217


class _PtyPort(serial.Serial):
    """A pty has no modem lines; a terminal server is asked for them all the same."""

    cts = dsr = cd = True
    ri = False

    def _update_dtr_state(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    def _update_break_state(self) -> None:
        pass


class _Connection:
    def __init__(self, client: socket.socket) -> None:
        self._client = client

    def write(self, data: bytes) -> None:
        self._client.sendall(data)


class Rfc2217Server:
    """Serves one client at a time on a loopback port; a context manager."""

    def __init__(self, port: str) -> None:
        self._serial = _PtyPort(port, timeout=0)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._client: socket.socket | None = None
        self._ending = threading.Event()
        #: baud rates that clients asked for
        self.baudrates: list[int] = []
        self.url = f"rfc2217://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> Rfc2217Server:
        return self

    def __exit__(self, *_: Any) -> None:
        self._ending.set()
        self._thread.join(5.0)
        self._listener.close()
        self._serial.close()

    def hang_up(self) -> None:
        """Cut the client off, as when the network goes."""
        client = self._client
        if client is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def _run(self) -> None:
        while not self._ending.is_set():
            if not select.select([self._listener], [], [], 0.05)[0]:
                continue
            self._client, _ = self._listener.accept()
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with self._client, contextlib.suppress(OSError):
                self._serve(self._client)

    def _serve(self, client: socket.socket) -> None:
        manager = serial.rfc2217.PortManager(self._serial, _Connection(client))
        while not self._ending.is_set():
            ready = select.select([client, self._serial.fileno()], [], [], 0.05)[0]
            if client in ready:
                data = client.recv(1024)
                if not data:
                    return
                self._serial.write(b"".join(manager.filter(data)))
                if self._serial.baudrate not in self.baudrates[-1:]:
                    self.baudrates.append(self._serial.baudrate)
            if self._serial.fileno() in ready:
                client.sendall(b"".join(manager.escape(self._serial.read(1024))))
