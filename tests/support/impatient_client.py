"""A client that reads streams for a moment only, and stays with a job for seconds: they might never end."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

_STREAM_S = 0.03  # a reader of a live view or of events leaves after so long
_HELD_S = 3.0  # who stays with a job, a burst of days it may be, lets go of it after so long


class Impatient:
    """An ASGI application that leaves another one early, as an impatient client would."""

    def __init__(self, app: Any) -> None:
        self._app = app

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        gone = asyncio.Event()
        if scope["type"] == "http" and scope["path"].endswith(("/events", "/stream.mjpg")):
            await self._read_for_a_moment(scope, _until(gone, receive), send, gone)
        elif scope["type"] == "http" and b"attached" in scope["query_string"]:
            asyncio.get_running_loop().call_later(_HELD_S, gone.set)
            await self._app(scope, _until(gone, receive), send)  # which answers once it has stopped the job
        else:
            await self._app(scope, receive, send)

    async def _read_for_a_moment(self, scope: Any, hears: Any, send: Any, gone: asyncio.Event) -> None:
        answered = asyncio.Event()
        ended = False

        async def on_send(message: Any) -> None:
            nonlocal ended
            if ended:
                return  # it is not received any more
            ended = message["type"] == "http.response.body" and not message.get("more_body", False)
            await send(message)
            answered.set()

        work = asyncio.ensure_future(self._app(scope, hears, on_send))
        try:
            answer = asyncio.ensure_future(answered.wait())
            await asyncio.wait({work, answer}, return_when=asyncio.FIRST_COMPLETED)
            answer.cancel()
            done, _ = await asyncio.wait({work}, timeout=_STREAM_S)
            if not done:
                gone.set()
                # it may have sent its last message, and not have returned yet
                over, ended = ended, True
                if not over:
                    await send({"type": "http.response.body", "body": b"", "more_body": False})
                done, _ = await asyncio.wait({work}, timeout=5.0)
                assert done, "a stream goes on without its reader"
            with contextlib.suppress(asyncio.CancelledError):
                await work
        finally:
            work.cancel()


def _until(gone: asyncio.Event, receive: Any) -> Any:
    """What an application receives from a client: its body, and once it has gone, that."""
    begun = False

    async def hears() -> Any:
        nonlocal begun
        if begun:
            await gone.wait()
            return {"type": "http.disconnect"}
        message = await receive()
        begun = not message.get("more_body", False)
        return message

    return hears
