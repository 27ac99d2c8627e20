"""At the door: Host, Origin and site, and bodies of two lengths."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stereorig.server.api.protocol.problems import problem_response
from stereorig.server.http.rights import LOOPBACK_NAMES, by_name, refused_site

POLICY_VIOLATION = 1008


async def refuse_socket(response: Response, scope: Scope, send: Send) -> None:
    """Answer a WebSocket's opening with a response instead, before it is accepted."""
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": POLICY_VIOLATION})
        return

    async def renamed(message: Message) -> None:
        await send({**message, "type": f"websocket.{message['type']}"})

    async def nothing() -> Message:
        return {"type": "http.disconnect"}

    await response({**scope, "type": "http", "method": "GET"}, nothing, renamed)


class Guard:
    """Refuse requests that come by a foreign name or from a foreign page, and bodies of two lengths.

    A page of another site can reach a service on loopback through the user's browser; its Origin, its Sec-Fetch-Site
    (or, after DNS rebinding, the Host) gives it away.
    """

    def __init__(self, app: ASGIApp, allowed: frozenset[str] = LOOPBACK_NAMES) -> None:
        self._app = app
        self._allowed = allowed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check, then pass on."""
        if scope["type"] == "websocket":
            refusal = self._refuse(by_name(scope["headers"]), "GET", {"ws": "http"}.get(scope["scheme"], "https"))
            if refusal is not None:
                await refuse_socket(refusal, scope, send)
            else:
                await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = by_name(scope["headers"])
        refusal = self._refuse(headers, scope["method"], scope["scheme"])
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        if b"transfer-encoding" in headers and b"content-length" in headers:
            # two lengths: a proxy in front may believe the second, and see another request than we do
            response = problem_response(
                400,
                "malformed_request",
                "A body has one length, and this one is given two.",
                "Send Content-Length or Transfer-Encoding.",
                headers={"Connection": "close"},
            )
            await response(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _refuse(self, headers: Mapping[bytes, str], method: str, scheme: str) -> Response | None:
        """Return the answer to a request that comes by a foreign name or from a foreign page; None for all others."""
        code = refused_site(headers, method, scheme, self._allowed)
        printed = "Use the address that the service printed when it started."
        if code == "foreign_host":
            return problem_response(403, "foreign_host", "Requests with this Host are not served.", printed)
        if code == "foreign_origin":
            return problem_response(403, "foreign_origin", "Requests with this Origin are not served.", printed)
        if code == "foreign_site":
            return problem_response(
                403,
                "foreign_site",
                "A page of another site asked for this.",
                "Open it in a tab of its own, or add that site's origin to `allowed_hosts` and fetch with CORS.",
            )
        return None
