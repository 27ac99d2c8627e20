"""Logging in from the page: a cookie in place of a key, since pictures and event streams cannot send headers."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Cookie, Request, Response
from pydantic import BaseModel, Field

from server.api.protocol.auth import COOKIE, SESSION_S, Sessions
from server.api.protocol.problems import errors, problem_response
from server.http.access import Role

router = APIRouter(tags=["access"])


class PersonReply(BaseModel):
    """User of a session."""

    name: str = Field(description="Name of the key; `local` where none is asked for.", examples=["lab-page"])
    role: Role = Field(description="Role, which sets the rights.")


@router.get("/session", summary="User of this session", response_model=PersonReply, responses=errors(401))
def get_session(request: Request) -> object:
    """Return the name and role that the key or the cookie belongs to."""
    person = request.state.person
    if person is None:
        return problem_response(401, "key_missing", "Nobody is logged in.", "Send a key, or POST it to log in.")
    return PersonReply(name=person.name, role=person.role)


@router.post(
    "/session", summary="Log in: a cookie for the key in the header", response_model=PersonReply, responses=errors(401)
)
def log_in(request: Request, response: Response) -> object:
    """Return who the key belongs to and set a cookie for the page that lasts twelve hours."""
    person = request.state.person
    if person is None:
        return problem_response(401, "key_missing", "No key was sent.", "Send 'Authorization: Bearer KEY'.")
    sessions: Sessions = request.app.state.sessions
    response.set_cookie(
        COOKIE,
        sessions.begin(person),
        max_age=int(SESSION_S),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return PersonReply(name=person.name, role=person.role)


@router.delete("/session", summary="Log out", status_code=204)
def log_out(
    request: Request,
    response: Response,
    cookie: Annotated[str | None, Cookie(alias=COOKIE, max_length=200, include_in_schema=False)] = None,
) -> None:
    """End the cookie's session."""
    sessions: Sessions = request.app.state.sessions
    if cookie is not None:
        sessions.end(cookie)
    response.delete_cookie(COOKIE)
