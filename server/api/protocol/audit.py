"""A number for each request, headers that browsers heed, and a line for each request that changes something.

A line of the audit log has the person, the address, the request, its time and its status.
"""

from __future__ import annotations

import logging
import re
import secrets
import time

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stereorig.server.base.logs import about
from stereorig.server.base.metrics import Metrics
from stereorig.server.store.audit_log import AuditLog

_log = logging.getLogger("stereorig.http")

_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
# the client went before it was answered; no such status is ever sent
_LEFT = 499
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})

_STREAMS = ("text/event-stream", "multipart/x-mixed-replace")
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})

#: the page needs nothing from elsewhere, and no other site may put it into a frame
SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
}


class Recorder:
    """Numbers requests (``X-Request-Id``), adds the security headers, writes the audit log, counts and times."""

    def __init__(self, app: ASGIApp, log: AuditLog, metrics: Metrics) -> None:
        self._app = app
        self._log = log
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, and note how it ended."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        given = dict(scope["headers"]).get(b"x-request-id", b"").decode("latin-1")
        number = given if _ID.fullmatch(given) else secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = number
        status = _LEFT  # until another one is set
        began, ended = time.monotonic(), None

        async def noted(message: Message) -> None:
            nonlocal status, ended
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-Id"] = number
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                if headers.get("content-type", "").startswith(_STREAMS):
                    ended = time.monotonic()  # the length of a view is no measure of speed
            await send(message)

        try:
            with about(request_id=number):
                await self._app(scope, receive, noted)
        except Exception:
            status = 500 if status == _LEFT else status
            raise
        finally:
            took_s = (ended or time.monotonic()) - began
            self._record(scope, status, took_s, number)
            if scope["method"] not in _SAFE and not scope["state"].get("unrecorded"):
                person = scope["state"].get("person")
                self._log.write(
                    who=None if person is None else person.name,
                    role=None if person is None else person.role,
                    address=(scope.get("client") or (None, 0))[0],
                    method=scope["method"],
                    path=scope["path"],
                    status=status,
                    request_id=number,
                )

    def _record(self, scope: Scope, status: int, took_s: float, number: str) -> None:
        """Count and time a request, and write its line into the log."""
        # an unknown method is no label: each would be kept for ever
        method = scope["method"] if scope["method"] in _METHODS else "other"
        route = _route(scope)
        self._metrics.requests.labels(method, route, str(status)).inc()
        self._metrics.request_s.labels(method, route).observe(took_s)
        level = logging.WARNING if status >= 500 and status not in (503, 507) else logging.INFO
        if _log.isEnabledFor(level):
            with about(request_id=number):
                person = scope["state"].get("person")
                entries = {
                    "method": scope["method"],
                    "path": scope["path"],
                    "status": status,
                    "duration_ms": round(took_s * 1e3, 3),
                    "who": None if person is None else person.name,
                    "address": (scope.get("client") or (None, 0))[0],
                }
                _log.log(level, "%s %s %d", scope["method"], scope["path"], status, extra=entries)


def _route(scope: Scope) -> str:
    """Return the path's template; ``none`` if no operation matches."""
    template: str | None = getattr(scope.get("route"), "path", None)
    if template is None:
        return "none"
    template = re.sub(r":\w+\}", "}", template)  # without the parameters' converters
    prefix = "/api/v1"
    return template if template.startswith(prefix) or not scope["path"].startswith(prefix) else prefix + template
