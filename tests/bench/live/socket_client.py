"""The least that a client of the live values' WebSocket does, and how its opening was answered."""

from __future__ import annotations

import json
import socket
from typing import Any

from wsproto import ConnectionType, WSConnection
from wsproto.events import AcceptConnection, CloseConnection, Ping, RejectConnection, Request, TextMessage


class ValueSocket:
    """A WebSocket on loopback.

    Parameters
    ----------
    port, target
        Of the service, and path.
    **headers
        Further ones, with ``_`` for ``-``.
    """

    def __init__(self, port: int, target: str, **headers: str) -> None:
        self._link = socket.create_connection(("127.0.0.1", port), timeout=60.0)
        self._protocol = WSConnection(ConnectionType.CLIENT)
        self._events: list[Any] = []
        self.status = 0
        extra = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
        self._link.sendall(self._protocol.send(Request(host=f"127.0.0.1:{port}", target=target, extra_headers=extra)))
        while not self.status:
            self._read()
            for event in self._protocol.events():
                if isinstance(event, AcceptConnection):
                    self.status = 101
                elif isinstance(event, RejectConnection):
                    self.status = event.status_code
                else:
                    self._events.append(event)

    def _read(self) -> None:
        self._protocol.receive_data(self._link.recv(65536) or None)

    def message(self, seconds: float = 60.0) -> dict[str, Any] | None:
        """Return the next message; None at the end, or when none came in time."""
        text = ""
        self._link.settimeout(max(seconds, 0.01))
        while True:
            self._events += self._protocol.events()
            while self._events:
                event = self._events.pop(0)
                if isinstance(event, TextMessage):
                    text += event.data
                    if event.message_finished:
                        found: dict[str, Any] = json.loads(text)
                        return found
                if isinstance(event, Ping):  # unanswered, the server ends the connection after a while
                    self._link.sendall(self._protocol.send(event.response()))
                if isinstance(event, CloseConnection):
                    return None
            try:
                self._read()
            except TimeoutError:
                return None

    def close(self) -> None:
        """End it, without a word."""
        self._link.close()
