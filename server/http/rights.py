"""Rights of a request: the hosts and pages that it may come from, its person, and the person's role.

The front process and the web process decide by this module alike; it imports no web framework.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from stereorig.server.http.access import KeyFile, Person, Role, StoredKey
from stereorig.server.http.sessions import Session, SessionFile

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
COOKIE = "stereorig_session"
LOCAL = Person("local", "admin")
STOP = "/api/v1/stage:stop"
ABORT = "/api/v1/stage:abort"

SiteRefusal = Literal["foreign_host", "foreign_origin", "foreign_site"]

_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
# stopping must never fail for a right that is lacking; every client may log in, and end their own sessions
_FOR_EVERYBODY = re.compile(rf"{re.escape(STOP)}|/api/v1/session|/api/v1/sessions(?:/[^/]*)?")
#: a scheme if it is an origin; a name or an address, and a port: no text that two readers may read differently
_HOST = re.compile(r"(?:([a-z][a-z0-9+.-]*)://)?(\[[0-9a-f:.%]+\]|[a-z0-9._-]+)(?::([0-9]{1,5}))?", re.IGNORECASE)
_PORTS = {"http": 80, "https": 443}


def by_name(headers: Sequence[tuple[bytes, bytes]]) -> dict[bytes, str]:
    """Return a request's headers by their names in small letters; of several alike the last one."""
    return {name.lower(): value.decode("latin-1") for name, value in headers}


def host_name(value: str) -> str | None:
    """Return the host of a Host header or an origin, without port; None if it is not one."""
    found = _HOST.fullmatch(value)
    return None if found is None else found[2].strip("[]").lower()


def same_origin(origin: str, host: str, scheme: str) -> bool:
    """Return True if an origin is the service's own: its scheme, name and port are the request's.

    An https origin fits a request by http: it came through a proxy that speaks https.
    """
    theirs, own = _HOST.fullmatch(origin), _HOST.fullmatch(host)
    if theirs is None or own is None or theirs[1] is None or own[1] is not None:
        return False
    usual = _PORTS.get(theirs[1].lower())
    if usual is None or theirs[2].lower() != own[2].lower():
        return False
    if usual == 80 and (scheme == "https" or (own[3] is None and scheme != "http")):
        return False
    return int(theirs[3] or usual) == int(own[3] or usual)


def refused_site(headers: Mapping[bytes, str], method: str, scheme: str, allowed: frozenset[str]) -> SiteRefusal | None:
    """Return why a request that comes by a foreign name or from a foreign page is refused; None for all others.

    Parameters
    ----------
    headers
        By names in small letters.
    method
        Its method; of a WebSocket GET.
    scheme
        ``http`` or ``https``, as the client asked; empty if that is not known.
    allowed
        Names under which the service may be addressed, and origins (``https://board.example:3000``) of other pages.
    """
    host, origin = headers.get(b"host"), headers.get(b"origin")
    if host is None or host_name(host) not in allowed:
        return "foreign_host"
    if origin is not None and origin not in allowed and not same_origin(origin, host, scheme):
        return "foreign_origin"
    # an image, script, frame or fetch without CORS has no Origin; this, which a page cannot set, reveals it
    if origin is not None or headers.get(b"sec-fetch-site") not in ("cross-site", "same-site"):
        return None
    followed = headers.get(b"sec-fetch-mode") == "navigate" and headers.get(b"sec-fetch-dest") == "document"
    return None if followed and method in ("GET", "HEAD") else "foreign_site"


def role_for(method: str, path: str) -> Role:
    """Return the lowest role that may do this."""
    if method in _SAFE or _FOR_EVERYBODY.fullmatch(path):
        return "viewer"
    return "admin" if method == "DELETE" else "operator"


@dataclass(frozen=True)
class Caller:
    """The person that a request names.

    Parameters
    ----------
    person
        The person; None if no key or cookie names one.
    key
        The key that gives them their right.
    session
        Their session, if a cookie names them.
    wrong
        Code of the problem if the key or cookie names no person; ``cookie_unknown`` for a cookie that names no
        session, which is as good as none.
    presented
        The wrong key or cookie.
    """

    person: Person | None = None
    key: StoredKey | None = None
    session: Session | None = None
    wrong: Literal["", "key_wrong", "session_ended", "cookie_unknown"] = ""
    presented: str = ""


class Callers:
    """Finds the person that a request names, in the key file and the session file of a data folder.

    Parameters
    ----------
    data
        The data folder.
    """

    def __init__(self, data: Path) -> None:
        self.keys = KeyFile(data)
        self.sessions = SessionFile(data)

    def of(self, headers: Mapping[bytes, str]) -> Caller:
        """Return the caller by a request's headers (by names in small letters).

        Raises
        ------
        FileFormatError
            ``keys_unreadable``.
        """
        if b"authorization" in headers:
            scheme, _, key = headers[b"authorization"].partition(" ")
            presented = key.strip() if scheme.lower() == "bearer" else ""
            stored = self.keys.stored(presented) if presented else None
            if stored is None:
                return Caller(wrong="key_wrong", presented=presented)
            return Caller(Person(stored.name, stored.role), stored)
        token = _cookie(headers.get(b"cookie", ""))
        if token is None:
            return Caller()
        session = self.sessions.of(token)
        if session is None:
            return Caller(wrong="cookie_unknown", presented=token)
        found = self.key_of(session)
        if found is None:
            return Caller(wrong="session_ended", session=session)
        return Caller(Person(found.name, found.role), found, session)

    def hold(self, caller: Caller) -> bool:
        """Return True if a caller's key, and session if it was by one, are still there; also if no key was asked for.

        Raises
        ------
        FileFormatError
            ``keys_unreadable``.
        """
        if caller.key is None:
            return True
        if caller.session is not None:
            known = {one.id for one in self.sessions.all()}
            return caller.session.id in known and self.key_of(caller.session) is not None
        return self.keys.first(caller.key.__eq__) is not None

    def key_of(self, session: Session) -> StoredKey | None:
        """Return the key of a session; None if it was removed or changed since."""
        return self.keys.first(session.has)


def _cookie(header: str) -> str | None:
    """Return the session's cookie; by hand, since the library's parser takes quadratic time for quoted values."""
    found = None
    for part in header.split(";"):
        name, equals, value = part.partition("=")
        if equals and name.strip() == COOKIE:
            found = value.strip().strip('"')
    return found


class HaltRights:
    """Decides in the front process whether a request may stop or abort, as the web process would.

    Parameters
    ----------
    data
        The data folder.
    hosts
        Names under which the service may be addressed, including the rig file's.
    keys_required
        True if a key is asked for.
    """

    def __init__(self, data: Path, *, hosts: frozenset[str], keys_required: bool) -> None:
        self._callers = Callers(data)
        self._hosts, self._required = hosts, keys_required

    def permits(self, action: str, headers: Sequence[tuple[bytes, bytes]], scheme: str = "") -> bool:
        """Return True if a POST of ``stop`` or ``abort`` with these headers may be carried out; raises nothing.

        ``scheme`` is the one that the client asked by; without it an origin and a host that name no port are refused
        if they may be of two services.
        """
        path = {"stop": STOP, "abort": ABORT}.get(action)
        try:
            named = by_name(headers)
            if named.get(b"x-forwarded-proto") == "https":  # at worst it is a lie that refuses the liar
                scheme = "https"
            if path is None or refused_site(named, "POST", scheme, self._hosts) is not None:
                return False
            caller = self._callers.of(named)
        except Exception:  # noqa: BLE001 - no file may end the front; the web process gives the reason
            return False
        if caller.wrong in ("key_wrong", "session_ended"):
            return False
        person = caller.person or (None if self._required else LOCAL)
        return person is not None and person.may(role_for("POST", path))
