"""Sessions of the page: a cookie in place of a key, kept in a file that the front process reads too.

A session means the key that it was begun with: once that key is removed, changed or made again, the session has ended.
The file holds hashes of the cookies. It is removed when the service starts, so that a restart ends every session; a
restart of the web process alone does not.
"""

from __future__ import annotations

import hmac
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from stereorig.server.http.access import Role, StoredKey, WatchedFile, digest_of, utc

SESSIONS_FILE = "sessions.json"
SESSION_S = 12 * 3600.0
_MOST = 1000
_MOST_OF_A_KEY = 100
_USED_STEP_S = 60.0


@dataclass(frozen=True)
class Session:
    """A session as the file holds it.

    Parameters
    ----------
    id
        Public name of the session.
    sha256, key_sha256
        Hashes of the cookie and of the key that it was begun with.
    name, role
        As the key had them.
    since, until
        Begin and end, in UTC.
    ends_s
        Its end by the machine's monotonic clock, which all processes share.
    address
        Address from which it was begun.
    used
        Time of a recent request, in UTC: the last one before the file was written.
    """

    id: str
    sha256: str
    key_sha256: str
    name: str
    role: Role
    since: str
    until: str
    ends_s: float
    address: str
    used: str

    def has(self, key: StoredKey) -> bool:
        """Return True if the session was begun with this key, unchanged since."""
        return (self.key_sha256, self.name, self.role) == (key.sha256, key.name, key.role)


class SessionFile:
    """``sessions.json`` of a data folder.

    Parameters
    ----------
    data
        The data folder.
    """

    def __init__(self, data: Path) -> None:
        self._file = WatchedFile(data / SESSIONS_FILE, _sessions_in)
        self._changing = threading.Lock()
        #: ended by this process: holds even if the disk is full
        self._ended: set[str] = set()
        self._used: dict[str, tuple[float, str]] = {}

    def all(self) -> tuple[Session, ...]:
        """Return the sessions that have time left, oldest first; none if the file cannot be read."""
        now = time.monotonic()
        try:
            return tuple(one for one in self._file.entries() if one.ends_s > now and one.id not in self._ended)
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return ()

    def of(self, token: str) -> Session | None:
        """Return the session of a cookie; None if there is none, or it has ended."""
        digest, found = digest_of(token), None
        for session in self.all():  # every one is compared, so that the time taken reveals nothing
            if hmac.compare_digest(session.sha256, digest):
                found = session
        if found is not None:
            now = time.monotonic()
            if now - self._used.get(found.id, (-_USED_STEP_S, ""))[0] >= _USED_STEP_S:
                self._used[found.id] = now, utc()
        return found

    def last_use(self, session: Session) -> str:
        """Return the time of the session's last request, to the minute."""
        return self._used.get(session.id, (0.0, session.used))[1]

    def begin(self, key: StoredKey, address: str) -> str:
        """Begin a session of a key and return the cookie's value.

        Raises
        ------
        StorageError
            If the file cannot be written.
        """
        token, now = secrets.token_urlsafe(32), datetime.now(UTC).replace(microsecond=0)
        new = Session(
            f"s{secrets.token_hex(6)}",
            digest_of(token),
            key.sha256,
            key.name,
            key.role,
            _text(now),
            _text(now + timedelta(seconds=SESSION_S)),
            time.monotonic() + SESSION_S,
            address,
            _text(now),
        )
        with self._changing:
            own = [one.id for one in self.all() if one.name == key.name]
            surplus = set(own[: max(0, len(own) + 1 - _MOST_OF_A_KEY)])
            self._keep((*(one for one in self.all() if one.id not in surplus), new)[-_MOST:])
        return token

    def end(self, which: Callable[[Session], bool]) -> int:
        """End the sessions that ``which`` picks and return how many; they have ended even if writing fails.

        Raises
        ------
        StorageError
            If the file cannot be written.
        """
        with self._changing:
            ended = {one.id for one in self.all() if which(one)}
            if ended:
                self._ended |= ended
                self._keep(self.all())
            return len(ended)

    def _keep(self, sessions: tuple[Session, ...]) -> None:
        kept = [asdict(replace(one, used=self.last_use(one))) for one in sessions]
        self._file.write({"format": 1, "sessions": kept})
        ids = {one.id for one in sessions}
        self._used = {name: used for name, used in list(self._used.items()) if name in ids}


def forget_sessions(data: Path) -> None:
    """End every session of a data folder: call it when the service starts."""
    (data / SESSIONS_FILE).unlink(missing_ok=True)


def _sessions_in(document: Any) -> tuple[Session, ...]:
    return tuple(Session(**entry) for entry in document["sessions"])


def _text(moment: datetime) -> str:
    return moment.isoformat().replace("+00:00", "Z")
