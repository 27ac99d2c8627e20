"""At the door: Host, Origin and site, and the size of bodies."""

from __future__ import annotations

import re
from collections.abc import Mapping

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.protocol.problems import problem_response
from server.base.errors import TooLargeError

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
BODY_LIMIT = 32 * 2**20
UPLOAD_LIMIT = 1024 * 2**20
_POLICY_VIOLATION = 1008


#: a scheme only where it is an origin; a name or an address, and a port: nothing that two readers may read in two ways
_HOST = re.compile(r"(?:[a-z][a-z0-9+.-]*://)?(\[[0-9a-f:.%]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?", re.IGNORECASE)


def host_name(value: str) -> str | None:
    """Return the host of a Host header or an origin, without port; None if it is not one."""
    found = _HOST.fullmatch(value)
    return None if found is None else found[1].strip("[]").lower()


def _reads_from_another_site(method: str, headers: Mapping[bytes, str]) -> bool:
    """Return True where a browser says that a page of another site reads, and that no link was followed.

    An image, script, frame or fetch without CORS bears no Origin; Sec-Fetch-Site, which a page cannot set, tells it.
    Programs that are no browser send none.
    """
    if headers.get(b"sec-fetch-site") != "cross-site" or b"origin" in headers:
        return False
    followed = headers.get(b"sec-fetch-mode") == "navigate" and headers.get(b"sec-fetch-dest") == "document"
    return not (followed and method in {"GET", "HEAD"})


async def refuse_socket(response: Response, scope: Scope, send: Send) -> None:
    """Answer a WebSocket's opening with a response instead, before it is accepted."""
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": _POLICY_VIOLATION})
        return

    async def renamed(message: Message) -> None:
        await send({**message, "type": f"websocket.{message['type']}"})

    async def nothing() -> Message:
        return {"type": "http.disconnect"}

    await response({**scope, "type": "http", "method": "GET"}, nothing, renamed)


class Guard:
    """Refuse requests that come by a foreign name or from a foreign page, and bodies without end.

    A page of another site can reach a service on loopback through the user's browser; its Origin, its Sec-Fetch-Site
    (or, after DNS rebinding, the Host) gives it away.
    """

    def __init__(self, app: ASGIApp, allowed: frozenset[str] = LOOPBACK_NAMES) -> None:
        self._app = app
        self._allowed = allowed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check, then pass on."""
        if scope["type"] == "websocket":
            refusal = self._refuse({k.lower(): v.decode("latin-1") for k, v in scope["headers"]}, "GET")
            if refusal is not None:
                await refuse_socket(refusal, scope, send)
            else:
                await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = {k.lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refusal = self._refuse(headers, scope["method"])
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        if b"transfer-encoding" in headers and b"content-length" in headers:
            # two lengths: a proxy in front may believe the other one, and see another request than we do
            response = problem_response(
                400,
                "malformed_request",
                "A body has one length, and this one is given two.",
                "Send Content-Length or Transfer-Encoding.",
                headers={"Connection": "close"},
            )
            await response(scope, receive, send)
            return
        limit = UPLOAD_LIMIT if scope["path"].endswith(("/steps:import", "/models")) else BODY_LIMIT
        length = headers.get(b"content-length", "0")
        if not length.isdigit() or int(length) > limit:
            response = problem_response(413, "body_too_large", f"The body is larger than {limit} bytes.", "Send less.")
            await response(scope, receive, send)
            return
        await _counted(self._app, limit, scope, receive, send)

    def _refuse(self, headers: Mapping[bytes, str], method: str) -> Response | None:
        """Return the answer to who comes by a foreign name or from a foreign page; None for all others."""
        for header, code in ((b"host", "foreign_host"), (b"origin", "foreign_origin")):
            value = headers.get(header)
            if value is None and header == b"origin":
                continue
            if value is None or host_name(value) not in self._allowed:
                return problem_response(
                    403,
                    code,
                    f"Requests with this {header.decode().title()} are not served.",
                    "Use the address that the service printed when it started.",
                )
        if _reads_from_another_site(method, headers):
            return problem_response(
                403,
                "foreign_site",
                "A page of another site asked for this.",
                "Open it in a tab of its own, or add that site's host to `allowed_hosts` and fetch with CORS.",
            )
        return None


async def _counted(app: ASGIApp, limit: int, scope: Scope, receive: Receive, send: Send) -> None:
    """Pass on, and cut off a body that does not say beforehand how long it is."""
    seen, answered, cut_off = 0, False, False

    async def counted() -> Message:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        if seen > limit:
            raise TooLargeError(f"The body is larger than {limit} bytes.")
        return message

    async def noted(message: Message) -> None:
        nonlocal answered, cut_off
        if cut_off:
            return
        if seen > limit and not answered:
            # whatever the reader of the body made of it
            cut_off = True
            cause = f"The body is larger than {limit} bytes."
            response = problem_response(413, "body_too_large", cause, "Send less.", headers={"Connection": "close"})
            await response(scope, receive, send)
            return
        answered = True
        await send(message)

    await app(scope, counted, noted)
