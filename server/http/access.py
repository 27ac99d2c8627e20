"""Access rights: keys with a name and a role, stored as hashes in the data folder.

A key is 256 random bits, so a plain SHA-256 of it is of no use to a reader of the file; slow hashes are for passwords.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import json
import os
import re
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from stereorig.core.errors import FileFormatError, InputError
from stereorig.server.formats import disk, files

Role = Literal["viewer", "operator", "admin"]
#: lowest first: each has the rights of the ones before it
ROLES: tuple[Role, ...] = ("viewer", "operator", "admin")

KEYS_FILE = "keys.json"
Entry = TypeVar("Entry")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
_PREFIX = "sr_"


@dataclass(frozen=True)
class Person:
    """A recognised caller.

    Parameters
    ----------
    name
        Name of the key; ``local`` if none is required.
    role
        Role that gives the rights.
    """

    name: str
    role: Role

    def may(self, role: Role) -> bool:
        """Return True if their role is this one or a higher one."""
        return ROLES.index(self.role) >= ROLES.index(role)


@dataclass(frozen=True)
class StoredKey:
    """A key as it is on disk."""

    name: str
    role: Role
    sha256: str
    created_utc: str


class WatchedFile(Generic[Entry]):
    """Entries of a private JSON file that several processes read, read again once the file is another one.

    Parameters
    ----------
    path
        The file.
    entries_in
        Makes the entries of the file's document.
    """

    def __init__(self, path: Path, entries_in: Callable[[Any], tuple[Entry, ...]]) -> None:
        self._path, self._entries_in = path, entries_in
        self._lock = threading.Lock()
        self._mark: tuple[int, int, int] | None = None
        self._entries: tuple[Entry, ...] = ()

    def entries(self) -> tuple[Entry, ...]:
        """Return the file's entries; none if there is no file."""
        with self._lock:
            try:
                mark = files.mark_of(self._path.stat())
                if mark != self._mark:
                    self._entries = self._entries_in(json.loads(self._path.read_bytes()))
                    self._mark = mark
            except FileNotFoundError:
                self._mark, self._entries = None, ()
            return self._entries

    def write(self, document: dict[str, Any]) -> None:
        """Write the file for its owner alone."""
        with files.written_temporary(self._path) as temporary:
            temporary.touch(mode=0o600, exist_ok=False)
            disk.disk.write(temporary, json.dumps(document, indent=1).encode() + b"\n")


class KeyFile:
    """``keys.json`` of a data folder; another process' changes to it hold from the next request on.

    Parameters
    ----------
    data
        The data folder.
    """

    def __init__(self, data: Path) -> None:
        self.path = data / KEYS_FILE
        self._file = WatchedFile(self.path, _keys_in)

    def keys(self) -> tuple[StoredKey, ...]:
        """Return all keys, in the order of their making.

        Raises
        ------
        FileFormatError
            ``keys_unreadable``: then no client is let in.
        """
        try:
            return self._file.entries()
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            reason = error.strerror if isinstance(error, OSError) else error  # the whole of it names the folder
            raise FileFormatError(
                f"{self.path.name} cannot be read: {reason}.",
                code="keys_unreadable",
                remedy="Restore it from a backup, or delete it and make the keys again with 'stereorig keys add'.",
            ) from error

    def first(self, fits: Callable[[StoredKey], bool]) -> StoredKey | None:
        """Return the first key that fits; None if none does."""
        return next((key for key in self.keys() if fits(key)), None)

    def stored(self, key: str) -> StoredKey | None:
        """Return the entry of a key; None for an unknown key."""
        digest = digest_of(key)
        found = None
        for stored in self.keys():  # every one is compared, so that the time taken reveals nothing
            if hmac.compare_digest(stored.sha256, digest):
                found = stored
        return found

    def who(self, key: str) -> Person | None:
        """Return the owner of a key; None for an unknown key."""
        stored = self.stored(key)
        return None if stored is None else Person(stored.name, stored.role)

    def add(self, name: str, role: Role) -> str:
        """Make a key and return it; it cannot be shown again.

        Raises
        ------
        InputError
            ``key_name_taken``, or a name of other characters.
        """
        if _NAME.fullmatch(name) is None:
            raise InputError(
                f"{name!r} is no name for a key.",
                remedy="Use up to 64 letters, digits and any of . _ @ -, beginning with a letter or digit.",
            )
        with self._changing() as keys:
            if any(stored.name == name for stored in keys):
                raise InputError(
                    f"There is a key named {name} already.",
                    code="key_name_taken",
                    remedy="Remove it first, or take another name.",
                )
            key = f"{_PREFIX}{secrets.token_urlsafe(32)}"
            self._write((*keys, StoredKey(name, role, digest_of(key), utc())))
        return key

    def remove(self, name: str) -> None:
        """Take a key away; it ends to work at once.

        Raises
        ------
        InputError
            ``key_unknown``.
        """
        with self._changing() as keys:
            rest = tuple(stored for stored in keys if stored.name != name)
            if len(rest) == len(keys):
                raise InputError(
                    f"There is no key named {name!r}.", code="key_unknown", remedy="See 'stereorig keys list'."
                )
            self._write(rest)

    @contextmanager
    def _changing(self) -> Iterator[tuple[StoredKey, ...]]:
        """Hold the file against other processes that change it."""
        try:
            descriptor = os.open(self.path.parent, os.O_RDONLY)
        except OSError as error:
            raise files.storage_error(error, self.path) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield self.keys()
        finally:
            os.close(descriptor)

    def _write(self, keys: tuple[StoredKey, ...]) -> None:
        self._file.write({"format": 1, "keys": [asdict(stored) for stored in keys]})


def _keys_in(document: Any) -> tuple[StoredKey, ...]:
    keys = tuple(StoredKey(**entry) for entry in document["keys"])
    for key in keys:
        if not all(isinstance(value, str) for value in asdict(key).values()):
            raise TypeError("a key has a value that is no text")
        if key.role not in ROLES:
            raise ValueError(f"the key {key.name} has a role that there is not; use {', '.join(ROLES)}")
    return keys


def digest_of(secret: str) -> str:
    """Return the SHA-256 under which a key or a cookie is stored."""
    return hashlib.sha256(secret.encode()).hexdigest()


def utc() -> str:
    """Return the time of day for people to read."""
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
