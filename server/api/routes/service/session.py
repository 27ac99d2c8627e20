"""Logging in from the page: a cookie in place of a key, since pictures and event streams cannot send headers.

A cookie begins no further session: only the key does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Cookie, Path, Query, Request, Response
from pydantic import BaseModel, Field

from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors, problem_response
from stereorig.server.base.errors import NotFoundError
from stereorig.server.http.access import Person, Role
from stereorig.server.http.rights import COOKIE, Callers
from stereorig.server.http.sessions import SESSION_S, Session, SessionFile

router = APIRouter(tags=["access"])
SessionId = Annotated[str, Path(max_length=40, description="Id of a session.")]


class PersonReply(BaseModel):
    """User of a session."""

    name: str = Field(description="Name of the key; `local` if none is required.", examples=["lab-page"])
    role: Role = Field(description="Role, which sets the rights.")


@router.get("/session", summary="User of this session", response_model=PersonReply, responses=errors(401))
def get_session(request: Request) -> object:
    """Return the name and role that the key or the cookie belongs to."""
    person = request.state.person
    if person is None:
        return problem_response(401, "key_missing", "No session is open.", "Send a key, or POST it to log in.")
    return PersonReply(name=person.name, role=person.role)


class SessionReply(BaseModel):
    """A session of the page."""

    id: str = Field(description="Id of the session; the cookie is another word.", examples=["s4f0c2a9b1d3e"])
    name: str = Field(description="Name of its key.", examples=["lab-page"])
    role: Role = Field(description="Role of its key.")
    since: str = Field(description="Begin, UTC.", examples=["2026-11-24T09:12:44Z"])
    until: str = Field(description="End, UTC, if it is not ended before.", examples=["2026-11-24T21:12:44Z"])
    address: str = Field(description="Address that it was begun from.", examples=["192.0.2.7"])
    last_use: str = Field(description="Its last request, UTC, to a minute.", examples=["2026-11-24T10:02:10Z"])


class SessionList(BaseModel):
    """A page of the sessions."""

    sessions: list[SessionReply] = Field(description="Oldest first.")
    next_cursor: str | None = Field(None, description="Leads to the next page; null after the last one.")


class EndedReply(BaseModel):
    """Sessions that were ended."""

    ended: int = Field(ge=0, description="How many sessions were ended.", examples=[2])


def _sessions(request: Request) -> SessionFile:
    callers: Callers = request.app.state.callers
    return callers.sessions


def _own(request: Request) -> Callable[[Session], bool]:
    """Return the test for a session that the caller may see and end: any for an admin, their own for others."""
    person: Person = request.state.person
    key_of = request.app.state.callers.key_of
    return lambda one: (person.role == "admin" or one.name == person.name) and key_of(one) is not None


@router.post(
    "/session", summary="Log in: a cookie for the key in the header", response_model=PersonReply, responses=errors(401)
)
def log_in(request: Request, response: Response) -> object:
    """Return the owner of the key and set a cookie for the page that lasts twelve hours, or until the key is removed.

    On loopback, if no key is asked for and none is sent, no cookie is set: none is needed.
    """
    person, caller = request.state.person, request.state.caller
    if person is None or caller.session is not None:
        return problem_response(401, "key_missing", "No key was sent.", "Send 'Authorization: Bearer KEY'.")
    if caller.key is not None:
        response.set_cookie(
            COOKIE,
            _sessions(request).begin(caller.key, request.client.host if request.client else "unknown"),
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
    sessions = _sessions(request)
    found = None if cookie is None else sessions.of(cookie)
    if found is not None:
        sessions.end(lambda one: one.id == found.id)
    response.delete_cookie(COOKIE)


@router.get("/sessions", summary="Sessions of the page, oldest first", responses=errors(401, 422))
def list_sessions(request: Request, page: PageDep) -> SessionList:
    """Return a page of the caller's own sessions; of all sessions for an admin."""
    sessions, own = _sessions(request), _own(request)
    found = [one for one in sessions.all() if own(one)]
    shown = page.of(found, lambda one: f"{one.since} {one.id}")
    replies = [SessionReply.model_validate({**asdict(one), "last_use": sessions.last_use(one)}) for one in shown]
    return SessionList(sessions=replies, next_cursor=page.next_cursor)


@router.delete(
    "/sessions", summary="End all sessions of a person", response_model=EndedReply, responses=errors(401, 403, 422, 507)
)
def end_sessions(
    request: Request,
    name: Annotated[
        str | None, Query(min_length=1, max_length=64, description="Name of the key; the caller's own if left out.")
    ] = None,
) -> object:
    """End the caller's own sessions, of this browser too; an admin may name another person."""
    person: Person = request.state.person
    if name not in (None, person.name) and person.role != "admin":
        return problem_response(
            403, "role_too_low", f"{person.name} is {person.role}; the sessions of {name} need admin.", "Ask an admin."
        )
    own = _own(request)
    return EndedReply(ended=_sessions(request).end(lambda one: one.name == (name or person.name) and own(one)))


@router.delete("/sessions/{session_id}", summary="End a session", status_code=204, responses=errors(401, 404, 507))
def end_session(request: Request, session_id: SessionId) -> None:
    """End a session: its next request is refused, its open streams end within a second."""
    own = _own(request)
    if _sessions(request).end(lambda one: one.id == session_id and own(one)) == 0:
        raise NotFoundError(f"There is no session {session_id}.", code="session_unknown", remedy="See GET /sessions.")
