"""HTTP by hand, for requests that no decent client would send."""

from __future__ import annotations

import contextlib
import json
import socket
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Answer:
    """An answer as it came; status 0 where the connection ended without one."""

    status: int
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""

    def code(self) -> str | None:
        """Code of a problem; None where it is none."""
        if self.headers.get("content-type") != "application/problem+json":
            return None
        return str(json.loads(self.body)["code"])


def send(port: int, data: bytes, seconds: float = 60.0) -> Answer:
    """Send bytes on a new connection and read all that comes back until the other side ends it."""
    with socket.create_connection(("127.0.0.1", port), timeout=seconds) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(data)
        received = b""
        with contextlib.suppress(ConnectionError):
            received = b"".join(iter(lambda: connection.recv(65536), b""))
    if not received.startswith(b"HTTP/1.1 "):
        return Answer(0)
    head, _, body = received.partition(b"\r\n\r\n")
    first, *rest = head.decode("latin-1").split("\r\n")
    headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in rest)}
    return Answer(int(first.split()[1]), headers, body)


def ask(port: int, method: str, target: str, *lines: str, host: str | None = "127.0.0.1", body: bytes = b"") -> Answer:
    """Send one request whose target and headers go out as they are."""
    head = [f"{method} {target} HTTP/1.1", *([f"Host: {host}"] if host is not None else []), *lines]
    if body or method != "GET":
        head.append(f"Content-Length: {len(body)}")
    return send(port, "\r\n".join([*head, "Connection: close", "", ""]).encode("latin-1") + body)
