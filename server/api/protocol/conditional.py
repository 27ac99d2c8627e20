"""Entity tags: which state of a thing a client has seen, and refusing a change that was meant for another one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from fastapi import Header, Response
from pydantic import BaseModel

from stereorig.core.errors import StateError

IfMatch = Annotated[
    str | None,
    Header(
        max_length=1000,
        description="ETag of the state that is to be changed, as it was read; `*` for any. Another state is refused.",
    ),
]


class PreconditionFailedError(StateError):
    """The thing was changed since it was read."""

    code = "precondition_failed"
    remedy = "Read it again, then send the change with the new ETag."


class PreconditionRequiredError(StateError):
    """A change must say which state it was meant for."""

    code = "precondition_required"
    remedy = "Send If-Match with the ETag that reading it gave, or `If-Match: *` to change any state."


def etag_of(document: Any) -> str:
    """Return the entity tag of a document."""
    if isinstance(document, BaseModel):
        document = document.model_dump(exclude_unset=True)
    text = json.dumps(document, sort_keys=True, ensure_ascii=False, default=str)
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


D = TypeVar("D", bound=Mapping[str, object] | BaseModel)


def tagged(response: Response, document: D) -> D:
    """Return the document, and name its state in the answer's ETag."""
    response.headers["ETag"] = etag_of(document)
    return document


def tags_in(header: str) -> list[str]:
    """Return the tags of If-Match or If-None-Match, weak or not."""
    return [tag.strip().removeprefix("W/") for tag in header.split(",")]


def require_match(header: str | None, etag: str, subject: str, *, required: bool = True) -> None:
    """Refuse a change that was meant for another state.

    Raises
    ------
    PreconditionRequiredError
        ``precondition_required`` if the header is missing and required.
    PreconditionFailedError
        ``precondition_failed``.
    """
    if header is None:
        if required:
            raise PreconditionRequiredError(f"A change of {subject} needs If-Match.")
        return
    if header.strip() != "*" and etag not in tags_in(header):
        raise PreconditionFailedError(f"The state of {subject} is not the one that If-Match names.", etag=etag)
