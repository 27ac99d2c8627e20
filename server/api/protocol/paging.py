"""Lists a page at a time: a cursor names the last entry seen, so that new entries in between move nothing."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Sequence
from typing import Annotated, Any

from fastapi import Depends, Query, Request, Response

from stereorig.core.errors import InputError

MAX_LIMIT = 1000
#: a document holds so many steps itself; further ones come page by page
WHOLE = 100
#: and the figures, of some kilobytes, of so many
FIGURES = 50


def cursor_of(key: str) -> str:
    """Return the cursor of the page that begins after the thing with this key."""
    return base64.urlsafe_b64encode(key.encode()).decode().rstrip("=")


class Page:
    """The requested part of a list.

    Parameters
    ----------
    after
        Key of the last thing that was seen; None: from the beginning.
    """

    def __init__(self, request: Request, response: Response, limit: int, after: str | None) -> None:
        self._request, self._response = request, response
        self.limit, self.after = limit, after

    def of(self, things: Sequence[Any], key: Callable[[Any], str], *, newest_first: bool = False) -> list[Any]:
        """Return the page of a list that is in the order of its keys, with the cursor of the next one."""
        rest = [t for t in things if self.after is None or self._is_after(key(t), newest_first)]
        return self.cut(rest, key)

    def cut(self, rest: Sequence[Any], key: Callable[[Any], str]) -> list[Any]:
        """Return the first page of the rest of a list."""
        page = list(rest[: self.limit])
        if len(rest) > len(page):
            cursor = cursor_of(key(page[-1]))
            url = self._request.url.include_query_params(cursor=cursor)
            self._response.headers["Link"] = f'<{url.path}?{url.query}>; rel="next"'
            self._response.headers["X-Next-Cursor"] = cursor
        return page

    @property
    def next_cursor(self) -> str | None:
        """Cursor of the next page; None after the last one."""
        return self._response.headers.get("X-Next-Cursor")

    def _is_after(self, key: str, newest_first: bool) -> bool:
        assert self.after is not None
        return key < self.after if newest_first else key > self.after


def _position(cursor: str | None) -> str | None:
    """Read a cursor.

    Raises
    ------
    InputError
        ``cursor_invalid``.
    """
    if cursor is None:
        return None
    try:
        return base64.b64decode(cursor + "=" * (-len(cursor) % 4), altchars=b"-_", validate=True).decode("ascii")
    except (binascii.Error, ValueError) as error:
        raise InputError(
            "The cursor is none that this service gave.",
            code="cursor_invalid",
            remedy="Send next_cursor as it came, or leave it out to begin at the start.",
        ) from error


Limit = Annotated[int, Query(ge=1, le=MAX_LIMIT, description="Most things in the answer.")]
Cursor = Annotated[
    str | None,
    Query(
        max_length=200,
        description="`next_cursor` of the page before; the list continues after it, whatever was made or deleted "
        "meanwhile.",
    ),
]


def _page(request: Request, response: Response, limit: Limit = MAX_LIMIT, cursor: Cursor = None) -> Page:
    return Page(request, response, limit, _position(cursor))


def _short_page(request: Request, response: Response, limit: Limit = 100, cursor: Cursor = None) -> Page:
    return Page(request, response, limit, _position(cursor))


PageDep = Annotated[Page, Depends(_page)]
ShortPageDep = Annotated[Page, Depends(_short_page)]
