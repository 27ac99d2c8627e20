"""Access rights: keys with a name and a role, stored as hashes in the data folder.

A key is 256 random bits, so a plain SHA-256 of it is of no use to a reader of the file; slow hashes are for passwords.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import os
import re
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from core.errors import FileFormatError, InputError
from server.formats.files import storage_error
from server.store.durable import read_json, write_json
from server.store.folder import now_utc

Role = Literal["viewer", "operator", "admin"]
#: lowest first: each may do what the ones before it may
ROLES: tuple[Role, ...] = ("viewer", "operator", "admin")

KEYS_FILE = "keys.json"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._@-]{0,63}")
_PREFIX = "sr_"


@dataclass(frozen=True)
class Person:
    """Somebody who was recognised.

    Parameters
    ----------
    name
        As the key was named; ``local`` where none is asked for.
    role
        What they may do.
    """

    name: str
    role: Role

    def may(self, role: Role) -> bool:
        """Return True if their role is this one or a higher one."""
        return ROLES.index(self.role) >= ROLES.index(role)


@dataclass(frozen=True)
class StoredKey:
    """A key as it lies on disk."""

    name: str
    role: Role
    sha256: str
    created_utc: str


class KeyFile:
    """``keys.json`` of a data folder; what another process changes in it holds from the next request on.

    Parameters
    ----------
    data
        The data folder.
    """

    def __init__(self, data: Path) -> None:
        self.path = data / KEYS_FILE
        self._lock = threading.Lock()
        self._stamp: tuple[int, int] | None = None
        self._keys: tuple[StoredKey, ...] = ()

    def keys(self) -> tuple[StoredKey, ...]:
        """Return all keys, in the order of their making.

        Raises
        ------
        FileFormatError
            ``keys_unreadable``: then no client is let in.
        """
        with self._lock:
            try:
                stat = self.path.stat()
            except FileNotFoundError:
                self._stamp, self._keys = None, ()
                return ()
            stamp = stat.st_mtime_ns, stat.st_ino
            if stamp != self._stamp:
                self._keys = self._read()
                self._stamp = stamp
            return self._keys

    def _read(self) -> tuple[StoredKey, ...]:
        document = read_json(self.path)
        try:
            keys = tuple(StoredKey(**entry) for entry in document["keys"])
        except (KeyError, TypeError) as error:
            raise FileFormatError(
                f"{self.path.name} cannot be read: {error}.",
                code="keys_unreadable",
                remedy="Restore it from a backup, or delete it and make the keys anew with 'stereorig keys add'.",
            ) from error
        if any(key.role not in ROLES for key in keys):
            raise FileFormatError(
                f"{self.path.name} names a role that there is not.",
                code="keys_unreadable",
                remedy=f"Use {', '.join(ROLES)}.",
            )
        return keys

    def who(self, key: str) -> Person | None:
        """Return whose key this is; None for an unknown key."""
        digest = _hash(key)
        found = None
        for stored in self.keys():  # every one is compared, so that the time taken reveals nothing
            if hmac.compare_digest(stored.sha256, digest):
                found = Person(stored.name, stored.role)
        return found

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
            self._write((*keys, StoredKey(name, role, _hash(key), now_utc())))
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
            raise storage_error(error, self.path) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield self.keys()
        finally:
            os.close(descriptor)

    def _write(self, keys: tuple[StoredKey, ...]) -> None:
        earlier = os.umask(0o077)  # private
        try:
            write_json(self.path, {"format": 1, "keys": [asdict(stored) for stored in keys]})
        finally:
            os.umask(earlier)


def _hash(key: str) -> str:
    return hashlib.sha256(key.encode()).hexdigest()
