"""Who follows a stream may leave at any time: that is no error of the service."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest
from fastapi import FastAPI
from fastapi.sse import EventSourceResponse

from stereorig.server.api.protocol.delivery import Delivery


async def follow_and_leave(app: Any, events: int) -> list[bytes]:
    """Read so many pieces of an answer, then leave; return what was read."""
    read: list[bytes] = []
    left = asyncio.Event()

    async def receive() -> dict[str, Any]:
        await left.wait()
        return {"type": "http.disconnect"}

    async def send(message: dict[str, Any]) -> None:
        if message.get("body"):
            read.append(message["body"])
        if len(read) >= events:
            left.set()
        await asyncio.sleep(0)

    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "method": "GET",
        "path": "/events",
        "raw_path": b"/events",
        "query_string": b"",
        "headers": [],
        "scheme": "http",
        "server": ("test", 80),
        "client": ("test", 1),
    }
    await app(scope, receive, send)
    return read


def served(fails_at: int | None = None) -> Delivery:
    app = FastAPI()

    @app.get("/events", response_class=EventSourceResponse)
    async def events() -> AsyncIterator[dict[str, int]]:
        for n in range(1000):
            if n == fails_at:
                raise ZeroDivisionError
            yield {"n": n}

    return Delivery(app)


@pytest.mark.parametrize("events", range(1, 30))
def test_a_reader_that_leaves_a_stream_is_no_error(events: int) -> None:
    assert events <= len(asyncio.run(follow_and_leave(served(), events))) < 1000


def test_what_fails_within_a_stream_is_an_error_still() -> None:
    with pytest.raises(Exception) as caught:  # noqa: PT011 - a group, or the error itself
        asyncio.run(follow_and_leave(served(fails_at=5), 2000))
    error = caught.value
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    assert isinstance(error, ZeroDivisionError)
