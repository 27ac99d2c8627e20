"""At the door: Host and Origin, and the size of bodies."""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.api.problems import problem_response
from server.errors import TooLargeError

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
BODY_LIMIT = 32 * 2**20
UPLOAD_LIMIT = 1024 * 2**20


def host_name(value: str) -> str | None:
    """Return the host of a Host header or an origin, without port; None if it is not one."""
    try:
        return urlsplit(value if "//" in value else f"//{value}").hostname
    except ValueError:
        return None


class Guard:
    """Refuse requests that come by a foreign name or from a foreign page, and bodies without end.

    A page of another site can reach a service on loopback through the user's browser; its Origin (or, after DNS
    rebinding, the Host) gives it away.
    """

    def __init__(self, app: ASGIApp, allowed: frozenset[str] = LOOPBACK_NAMES) -> None:
        self._app = app
        self._allowed = allowed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Check, then pass on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = {k.lower(): v.decode("latin-1") for k, v in scope["headers"]}
        for header, code in ((b"host", "foreign_host"), (b"origin", "foreign_origin")):
            value = headers.get(header)
            if value is None and header == b"origin":
                continue
            if value is None or host_name(value) not in self._allowed:
                response = problem_response(
                    403, code, f"Requests with this {header.decode().title()} are not served.",
                    "Use the address that the service printed when it started.",
                )  # fmt: skip
                await response(scope, receive, send)
                return
        limit = UPLOAD_LIMIT if scope["path"].endswith("/steps:import") else BODY_LIMIT
        length = headers.get(b"content-length", "0")
        if not length.isdigit() or int(length) > limit:
            response = problem_response(413, "body_too_large", f"The body is larger than {limit} bytes.", "Send less.")
            await response(scope, receive, send)
            return
        seen = 0

        async def counted() -> Message:
            nonlocal seen
            message = await receive()
            seen += len(message.get("body", b""))
            if seen > limit:
                raise TooLargeError(f"The body is larger than {limit} bytes.")
            return message

        await self._app(scope, counted, send)
