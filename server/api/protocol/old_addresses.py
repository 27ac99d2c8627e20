"""Earlier addresses of operations: they still answer, and say that they are deprecated and by what they are replaced.

An operation that is no plain reading or changing of a thing is ``thing:verb``; earlier versions had ``thing/verb`` for
some. They stand in no description of the API.
"""

from __future__ import annotations

import re

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

#: what an earlier address looked like, and what it is now
OLD_ADDRESSES = {
    r"/jobs/([^/]+)/cancel": r"/jobs/\1:cancel",
    r"/trash/([^/]+)/restore": r"/trash/\1:restore",
    r"/tests/([^/]+)/exported": r"/tests/\1:acknowledge-export",
    r"/stage/(stop|abort|home|enable|disable)": r"/stage:\1",
    r"/stage/axes/([^/]+)/leave-configuration": r"/stage/axes/\1:leave-configuration",
    r"/rig/reconnect": r"/rig:reconnect",
    r"/calibrations/([^/]+)/judgement": r"/calibrations/\1/review",
}
#: since when, as RFC 9745 writes it: 24 November 2026
_SINCE = "@1795478400"
_PATTERNS = [(re.compile(old), new) for old, new in OLD_ADDRESSES.items()]


def address_now(path: str) -> str | None:
    """Return the address that replaces an earlier one; None for an address of today."""
    for pattern, now in _PATTERNS:
        if (match := pattern.fullmatch(path)) is not None:
            return match.expand(now)
    return None


class OldAddresses:
    """Takes a request to the address that replaces the one it was sent to, before anything else looks at it."""

    def __init__(self, app: ASGIApp, prefix: str) -> None:
        self._app = app
        self._prefix = prefix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass it on."""
        path = scope["path"] if scope["type"] == "http" else ""
        inner = address_now(path.removeprefix(self._prefix)) if path.startswith(self._prefix) else None
        if inner is None:
            await self._app(scope, receive, send)
            return
        now = f"{self._prefix}{inner}"

        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Deprecation"] = _SINCE
                headers.append("Link", f'<{now}>; rel="successor-version"')
            await send(message)

        await self._app({**scope, "path": now, "raw_path": now.encode()}, receive, marked)
