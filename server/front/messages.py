"""Messages as they pass the front: which request halts the stage, which headers pass, the front's own answers."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Literal
from urllib.parse import unquote

import h11

from stereorig.core.errors import DeviceError

Headers = Sequence[tuple[bytes, bytes]]
Halt = Literal["stop", "abort"]

#: headers that the front adds for the web process, and that no client may send
_OWN = b"stereorig-"
_FOR, _PROTO = b"x-forwarded-for", b"x-forwarded-proto"
# of one connection, and not of the message
_OF_A_CONNECTION = frozenset({b"connection", b"keep-alive", b"proxy-connection", b"te", b"trailer", b"upgrade"})
_HALTS: dict[str, Halt] = {"/api/v1/stage:stop": "stop", "/api/v1/stage:abort": "abort"}


@dataclass(frozen=True)
class HaltMade:
    """A halt that is on the stage's wire.

    Parameters
    ----------
    number
        Number of the halt, by which the web process recognises it.
    elapsed_ms
        Time from the request to the bytes on the wire.
    """

    number: int
    elapsed_ms: float


class HaltFailed(DeviceError):
    """The halt could not be put on the stage's wire."""

    code = "stop_failed"
    remedy = "Use the emergency stop of the controller, then look at the state of the stage."


@dataclass(frozen=True)
class Answer:
    """An answer that is whole."""

    head: h11.Response
    body: bytes


@dataclass(frozen=True)
class Head:
    """The head of a client's request: ``path`` as the web process reads it, names of ``headers`` in lower case."""

    method: bytes
    target: bytes
    path: str
    version: bytes
    headers: list[tuple[bytes, bytes]]

    @classmethod
    def of(cls, request: h11.Request) -> Head:
        """Return the head of a request."""
        headers = [(name.lower(), value) for name, value in request.headers.raw_items()]
        path = unquote(request.target.partition(b"?")[0].decode("ascii"))
        return cls(request.method, request.target, path, request.http_version, headers)

    def value(self, name: bytes) -> bytes | None:
        """Return the last value of a header."""
        return next((value for key, value in reversed(self.headers) if key == name), None)

    @property
    def halt(self) -> Halt | None:
        """Return the halt that is asked for; None for any other request."""
        return _HALTS.get(self.path) if self.method == b"POST" else None

    @property
    def body_length(self) -> int | None:
        """Return how many bytes its body has; None if it does not say."""
        if self.value(b"transfer-encoding") is not None:
            return None
        return int(self.value(b"content-length") or 0)

    @property
    def opens_websocket(self) -> bool:
        """Return True if a WebSocket is opened; a request with a body opens none."""
        if (self.value(b"upgrade") or b"").lower() != b"websocket" or self.body_length != 0:
            return False
        return b"upgrade" in {token.strip() for token in (self.value(b"connection") or b"").lower().split(b",")}

    def for_web(
        self, *, peer: str, scheme: bytes, trusted: Collection[str], halted: HaltMade | None = None
    ) -> h11.Request:
        """Return the request to send to the web process.

        Parameters
        ----------
        peer, scheme
            Address of the client's side of the connection, and ``http`` or ``https``.
        trusted
            Addresses of proxies that may name another address and scheme.
        halted
            The halt that was made for this request.
        """
        dropped = {*_OF_A_CONNECTION, _FOR, _PROTO}
        if self.version < b"1.1":
            dropped.add(b"expect")  # such a client could not read the answer to it
        headers = [(name, value) for name, value in self.headers if name not in dropped and not name.startswith(_OWN)]
        if self.opens_websocket:
            headers += [(b"connection", b"Upgrade"), (b"upgrade", b"websocket")]
        if self.value(b"host") is None:
            headers.append((b"host", b""))  # HTTP/1.0; the web process refuses it as any foreign host
        named = self.value(_PROTO) if peer in trusted else None
        headers += [(_FOR, self._client(peer, trusted)), (_PROTO, named or scheme)]
        if halted is not None:
            headers.append((b"stereorig-halted", f"{halted.number};{halted.elapsed_ms}".encode()))
        return h11.Request(method=self.method, target=self.target, headers=headers)

    def _client(self, peer: str, trusted: Collection[str]) -> bytes:
        """Return the nearest address that is no trusted proxy's."""
        values = b",".join(value for name, value in self.headers if name == _FOR)
        hosts = [host for host in (part.strip() for part in values.split(b",")) if host]
        if peer not in trusted or not hosts:
            return peer.encode()
        return next((host for host in reversed(hosts) if host.decode("latin-1") not in trusted), hosts[0])


def for_client(response: h11.Response) -> h11.Response:
    """Return the head of an answer to send to the client; ``Connection: close`` stays."""
    sent = [(name.lower(), value) for name, value in response.headers.raw_items()]
    headers = [(name, value) for name, value in sent if name not in _OF_A_CONNECTION]
    if (b"connection", b"close") in sent:
        headers.append((b"connection", b"close"))
    return h11.Response(status_code=response.status_code, headers=headers, reason=response.reason)


def problem_answer(status: int, code: str, detail: str, remedy: str, *, wait_s: int | None = None) -> Answer:
    """Return a problem (RFC 9457) as the web process would write it; the connection ends with it."""
    document = {"type": f"/problems/{code}", "title": HTTPStatus(status).phrase, "status": status, "detail": detail}
    headers = [(b"connection", b"close")] + ([] if wait_s is None else [(b"retry-after", b"%d" % wait_s)])
    return _json(status, b"application/problem+json", {**document, "code": code, "remedy": remedy}, headers)


def stopped(made: HaltMade) -> Answer:
    """Return the answer to a halt for which the web process has none in time."""
    document = {"stopped": True, "elapsed_ms": made.elapsed_ms, "cancelled_job": None}
    return _json(200, b"application/json", document, [(b"cache-control", b"no-store")])


def _json(status: int, media_type: bytes, document: object, headers: Headers) -> Answer:
    body = json.dumps(document).encode()
    own = [
        (b"content-type", media_type),
        (b"content-length", b"%d" % len(body)),
        (b"x-content-type-options", b"nosniff"),
    ]
    reason = HTTPStatus(status).phrase.encode()
    return Answer(h11.Response(status_code=status, headers=[*own, *headers], reason=reason), body)


MALFORMED = problem_answer(400, "malformed_request", "Invalid HTTP request received.", "Send HTTP/1.1 (RFC 9112).")
TWO_LENGTHS = problem_answer(
    400,
    "malformed_request",
    "A body has one length, and this one is given two.",
    "Send Content-Length or Transfer-Encoding.",
)
CROWDED = problem_answer(
    503,
    "too_many_connections",
    "There are too many connections.",
    "Close some, or wait for the time in Retry-After.",
    wait_s=5,
)
AWAY = problem_answer(
    503,
    "web_process_away",
    "The web process is being restarted.",
    "Send the request again after the time in Retry-After.",
    wait_s=2,
)


# Limits of a connection.


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
