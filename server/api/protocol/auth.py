"""Authentication and rights: bearer keys for scripts, a cookie for the page, limits on the rate.

On loopback no key is required unless the rig file demands one; a key that is sent is checked all the same.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import OrderedDict
from dataclasses import dataclass, field

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stereorig.core.errors import StereorigError
from stereorig.server.api.protocol.guard import POLICY_VIOLATION, refuse_socket
from stereorig.server.api.protocol.problems import problem_response
from stereorig.server.http.rights import ABORT, COOKIE, LOCAL, STOP, Caller, Callers, by_name, role_for
from stereorig.server.http.shutout import ShutOut

#: readable without a key, and while an address is shut out: whether the service runs, and the page, which holds nothing
_OPEN = frozenset({"/", "/docs", "/healthz", "/readyz", "/api/v1/healthz", "/api/v1/readyz"})
# the page's own files and public parts of the program's source; without them no operator could log in
_PAGES = ("/static/", "/docs/", "/problems")
_SESSION = "/api/v1/session"
_HALTS = frozenset({STOP, ABORT})
_STREAMS = (b"text/event-stream", b"multipart/x-mixed-replace")
_MAX_CLIENTS = 10_000
_LOOK_S = 0.4


class RateLimit:
    """So many calls a second from each client, with a reserve for bursts.

    Parameters
    ----------
    per_s
        Lasting rate of calls.
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
    callers
        The keys and sessions there are.
    required
        True if a key is asked for.
    requests_per_s
        Lasting rate of one client; ten times as many at once.
    shut_out
        Addresses that are shut out.
    """

    callers: Callers
    required: bool
    requests_per_s: float = 500.0
    shut_out: ShutOut = field(default_factory=ShutOut)


@dataclass(eq=False)
class _Stream:
    """An open stream: its task, and the caller whose right it is."""

    task: asyncio.Task[object]
    caller: Caller
    ended: bool = False


class Door:
    """Lets requests through with their person in ``scope["state"]``, or answers with the reason."""

    def __init__(self, app: ASGIApp, rules: AccessRules) -> None:
        self._app = app
        self._rules = rules
        self._calls = RateLimit(rules.requests_per_s, 10.0 * rules.requests_per_s)
        self._streams: set[_Stream] = set()
        self._looking: asyncio.Task[None] | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check, then pass on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._refuse(scope)
        if refusal is not None and scope["type"] == "websocket":
            await refuse_socket(refusal, scope, send)
        elif refusal is not None:
            await refusal(scope, receive, send)
        else:
            await self._while_permitted(scope, receive, send)

    async def _while_permitted(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, and end its stream once the caller's key or session is gone."""
        caller: Caller = scope["state"]["caller"]
        task = asyncio.current_task()
        if caller.key is None or task is None:
            await self._app(scope, receive, send)
            return
        stream = _Stream(task, caller)

        async def noted(message: Message) -> None:
            if _begins_a_stream(message):
                self._streams.add(stream)
                if self._looking is None or self._looking.done():
                    self._looking = asyncio.create_task(self._look())
            await send(message)

        try:
            await self._app(scope, receive, noted)
        except asyncio.CancelledError:
            if not stream.ended:
                raise
            task.uncancel()
            socket = scope["type"] == "websocket"
            last = {"type": "websocket.close", "code": POLICY_VIOLATION} if socket else {"type": "http.response.body"}
            await send(last)
        finally:
            self._streams.discard(stream)

    async def _look(self) -> None:
        """End the streams of callers whose key or session is gone, until no stream is open."""
        while self._streams:
            await asyncio.sleep(_LOOK_S)
            for stream in list(self._streams):
                try:
                    held = self._rules.callers.hold(stream.caller)
                except StereorigError:
                    held = False
                if not held and not stream.ended:
                    stream.ended = True
                    stream.task.cancel()

    def _refuse(self, scope: Scope) -> Response | None:
        # a WebSocket begins as a reading, and only hands out
        path, method = scope["path"], scope.get("method", "GET")
        client = (scope.get("client") or ("unknown", 0))[0]
        state = scope.setdefault("state", {})
        state["caller"], state["person"] = Caller(), None
        is_open = path in _OPEN or path.startswith(_PAGES)
        shut_s = 0.0 if path in _HALTS else self._rules.shut_out.left_s(client)
        if shut_s > 0.0 and not is_open:
            state["unrecorded"] = True  # one line at the begin and one at the end are in the audit log
            return _shut_out(shut_s)
        wait = 0.0 if path == STOP else self._calls.wait_s(client)
        if wait > 0.0:
            return _too_many(wait)
        try:
            caller = Caller() if shut_s > 0.0 else self._rules.callers.of(by_name(scope["headers"]))
        except StereorigError as error:
            return problem_response(503, error.code, error.cause, error.remedy)
        if caller.wrong in ("key_wrong", "cookie_unknown"):
            self._rules.shut_out.wrong(client, caller.presented if caller.wrong == "cookie_unknown" else "")
        if caller.wrong == "key_wrong":
            return _unknown("key_wrong", "No user has this key.")
        if caller.wrong == "session_ended" and not is_open and (method, path) != ("DELETE", _SESSION):
            return _session_ended()
        if caller.person is None and self._rules.required and not is_open and path != _SESSION:
            return _unknown("key_missing", "This service asks for a key.")
        person = caller.person or (LOCAL if not self._rules.required else None)
        if person is not None and not person.may(role_for(method, path)):
            needed = role_for(method, path)
            return problem_response(
                403,
                "role_too_low",
                f"{person.name} is {person.role}; {method} {path} needs {needed}.",
                f"Use a key of the role {needed}.",
            )
        state["caller"], state["person"] = caller, person
        return None


def _begins_a_stream(message: Message) -> bool:
    if message["type"] == "http.response.start":
        kinds = [value for name, value in message.get("headers", ()) if name.lower() == b"content-type"]
        return any(kind.startswith(_STREAMS) for kind in kinds)
    return bool(message["type"] == "websocket.accept")


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


def _shut_out(left_s: float) -> Response:
    return problem_response(
        429,
        "shut_out",
        "Too many wrong keys or words came from this address.",
        "Wait for the time in Retry-After, then use a right key; the stage can be stopped all the same.",
        headers={"Retry-After": str(math.ceil(left_s))},
    )


def _session_ended() -> Response:
    # the browser forgets the cookie, so that its next request is one without a session
    gone = f"{COOKIE}=; Max-Age=0; Path=/; HttpOnly; SameSite=strict"
    return problem_response(
        401,
        "session_ended",
        "This session has ended: its key was removed or changed.",
        "Log in again with a key.",
        headers={"WWW-Authenticate": "Bearer", "Set-Cookie": gone},
    )
