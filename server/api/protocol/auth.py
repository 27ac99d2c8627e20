"""Authentication and rights: bearer keys for scripts, a cookie for the page, limits on the rate.

On loopback no key is required unless the rig file demands one; what is presented there is checked all the same.
"""

from __future__ import annotations

import math
import secrets
import time
from collections import OrderedDict
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie

from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from core.errors import StereorigError
from server.api.protocol.guard import refuse_socket
from server.api.protocol.problems import problem_response
from server.http.access import KeyFile, Person, Role

COOKIE = "stereorig_session"
SESSION_S = 12 * 3600.0
LOCAL = Person("local", "admin")

#: readable without a key: whether the service runs, and the page, which holds nothing of its own
_OPEN = frozenset({"/", "/docs", "/healthz", "/readyz", "/api/v1/healthz", "/api/v1/readyz", "/api/v1/session"})
# the page's own files and what is public in the program's source; without them no operator could log in
_PAGES = ("/static/", "/docs/", "/problems")
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_STOP = "/api/v1/stage:stop"
# stopping must never fail for a right that is lacking; every client may log in and out
_FOR_EVERYBODY = frozenset({_STOP, "/api/v1/session"})
_HALTS = frozenset({_STOP, "/api/v1/stage:abort"})
_MAX_CLIENTS = 10_000


class Sessions:
    """Sessions of the page's cookies; in memory, so that a restart ends them all."""

    def __init__(self) -> None:
        self._known: OrderedDict[str, tuple[Person, float]] = OrderedDict()

    def begin(self, person: Person) -> str:
        """Return a new cookie's value."""
        token = secrets.token_urlsafe(32)
        self._known[token] = person, time.monotonic() + SESSION_S
        while len(self._known) > _MAX_CLIENTS:
            self._known.popitem(last=False)
        return token

    def who(self, token: str) -> Person | None:
        """Return whose cookie it is; None when it has ended."""
        person, until = self._known.get(token, (None, 0.0))
        if person is not None and time.monotonic() > until:
            self.end(token)
            return None
        return person

    def end(self, token: str) -> None:
        """Let it mean nothing from now on."""
        self._known.pop(token, None)


class RateLimit:
    """So many calls a second from each client, with a reserve for bursts.

    Parameters
    ----------
    per_s
        Rate that may go on for ever.
    burst
        Calls that may come at once.
    """

    def __init__(self, per_s: float, burst: float) -> None:
        self._per_s, self._burst = per_s, burst
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, client: str) -> float:
        """Take one call; return 0, or how long the client must wait."""
        now = time.monotonic()
        left, then = self._left.get(client, (self._burst, now))
        left = min(self._burst, left + (now - then) * self._per_s)
        if left < 1.0:
            return (1.0 - left) / self._per_s
        self._left[client] = left - 1.0, now
        self._left.move_to_end(client)
        while len(self._left) > _MAX_CLIENTS:
            self._left.popitem(last=False)
        return 0.0


@dataclass(frozen=True)
class AccessRules:
    """Rules of access.

    Parameters
    ----------
    keys
        The keys there are.
    required
        True if a key is asked for.
    requests_per_s
        Of one client, for ever; ten times as many at once.
    """

    keys: KeyFile
    required: bool
    requests_per_s: float = 500.0


def role_for(method: str, path: str) -> Role:
    """Return the lowest role that may do this."""
    if method in _SAFE or path in _FOR_EVERYBODY:
        return "viewer"
    return "admin" if method == "DELETE" else "operator"


class Door:
    """Lets requests through with their person in ``scope["state"]``, or answers with the reason."""

    def __init__(self, app: ASGIApp, rules: AccessRules, sessions: Sessions) -> None:
        self._app = app
        self._rules = rules
        self._sessions = sessions
        self._calls = RateLimit(rules.requests_per_s, 10.0 * rules.requests_per_s)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check, then pass on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._refuse(scope)
        if refusal is not None and scope["type"] == "websocket":
            await refuse_socket(refusal, scope, send)
            return
        await (self._app if refusal is None else refusal)(scope, receive, send)

    def _refuse(self, scope: Scope) -> Response | None:
        # a WebSocket begins as a reading, and only hands out
        path, method = scope["path"], scope.get("method", "GET")
        client = (scope.get("client") or ("unknown", 0))[0]
        if scope.get("state", {}).get("crowded") and path not in _HALTS:
            return _crowded()
        # keys have 256 bits and cannot be found by trying, so wrong ones are not counted separately
        wait = 0.0 if path == _STOP else self._calls.wait_s(client)
        if wait > 0.0:
            return _too_many(wait)
        headers = {k.lower(): v.decode("latin-1") for k, v in scope["headers"]}
        try:
            person = self._who(headers)
        except StereorigError as error:
            return problem_response(503, error.code, error.cause, error.remedy)
        if person is None and b"authorization" in headers:
            return _unknown("key_wrong", "No user has this key.")
        if person is None and self._rules.required and path not in _OPEN and not path.startswith(_PAGES):
            return _unknown("key_missing", "This service asks for a key.")
        person = person or (LOCAL if not self._rules.required else None)
        if person is not None and not person.may(role_for(method, path)):
            needed = role_for(method, path)
            return problem_response(
                403,
                "role_too_low",
                f"{person.name} is {person.role}; {method} {path} needs {needed}.",
                f"Use a key of the role {needed}.",
            )
        scope.setdefault("state", {})["person"] = person
        return None

    def _who(self, headers: dict[bytes, str]) -> Person | None:
        scheme, _, key = headers.get(b"authorization", "").partition(" ")
        if scheme.lower() == "bearer" and key.strip():
            return self._rules.keys.who(key.strip())
        if b"authorization" not in headers and b"cookie" in headers:
            try:
                cookie = SimpleCookie(headers[b"cookie"]).get(COOKIE)
            except CookieError:
                return None
            return None if cookie is None else self._sessions.who(cookie.value)
        return None


def _unknown(code: str, cause: str) -> Response:
    remedy = "Send 'Authorization: Bearer KEY' with a key made by 'stereorig keys add'."
    return problem_response(401, code, cause, remedy, headers={"WWW-Authenticate": "Bearer"})


def _too_many(wait_s: float) -> Response:
    wait = {"Retry-After": str(max(1, math.ceil(wait_s)))}
    return problem_response(
        429,
        "too_many_requests",
        "Too many requests from this address.",
        "Wait for the time in Retry-After.",
        headers=wait,
    )


def _crowded() -> Response:
    return problem_response(
        503,
        "too_many_connections",
        "There are too many connections.",
        "Close some, or wait for the time in Retry-After.",
        headers={"Retry-After": "5", "Connection": "close"},
    )
