"""Requests that have one effect however often they come: the Idempotency-Key and the result that it identifies.

The ids that a request with a key made are kept in the catalogue, and in the made document: a lost catalogue learns
it again from the folders.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from stereorig.core.errors import StateError, StorageError
from stereorig.server.base.models import Ids
from stereorig.server.store.catalog import Catalog

_log = logging.getLogger("stereorig.service")


@dataclass(frozen=True)
class RequestMark:
    """An Idempotency-Key with its request; stored with the entry that the request made.

    Parameters
    ----------
    scope
        Kind of entry to make: the same key means something else elsewhere.
    key
        As the client sent it; None without one.
    body_sha256
        Hash of the request's content.
    """

    scope: str
    key: str | None
    body_sha256: str

    def document(self) -> dict[str, object]:
        """Return the part for the document of the new entry; empty without a key."""
        if self.key is None:
            return {}
        return {"request": {"scope": self.scope, "key": self.key, "body_sha256": self.body_sha256}}

    def made(self, ids: Ids) -> tuple[str, str, str, Ids] | None:
        """Return the row of the catalogue with the ids that the request made; None without a key."""
        return None if self.key is None else (self.scope, self.key, self.body_sha256, ids)


class OneEffect:
    """Runs the request of a key once."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._guard = threading.Lock()
        self._locks: dict[tuple[str, str], tuple[threading.Lock, list[int]]] = {}
        # made, but the catalogue could not take it: good until the next start, which finds it in the folders
        self._unwritten: dict[tuple[str, str], tuple[str, Ids]] = {}

    @property
    def all_written(self) -> bool:
        """True if the catalogue has every key."""
        return not self._unwritten

    def once(self, mark: RequestMark, make: Callable[[], Ids]) -> tuple[Ids, bool]:
        """Run ``make`` once per key; return the made ids and True if they were made before.

        ``make`` returns the ids of the new entry, from which the answer is built again.

        Raises
        ------
        StateError
            ``idempotency_key_reused`` if the key came with another body before.
        """
        if mark.key is None:
            return make(), False
        scoped_key = mark.scope, mark.key
        with self._turn(scoped_key):
            earlier = self._unwritten.get(scoped_key) or self._catalog.request(*scoped_key)
            if earlier is not None:
                if earlier[0] != mark.body_sha256:
                    raise StateError(
                        "This Idempotency-Key was used with another body.",
                        code="idempotency_key_reused",
                        remedy="Use a new key for a new request.",
                    )
                return earlier[1], True
            made = make()
            self._remember(mark, made)
        return made, False

    def _remember(self, mark: RequestMark, made: Ids) -> None:
        assert mark.key is not None
        try:
            if self._catalog.request(mark.scope, mark.key) is None:  # a job brought it along
                self._catalog.put_request(mark.scope, mark.key, mark.body_sha256, made)
        except StorageError:
            # it is made and durable; an error now would bring the client to ask for a second one
            _log.exception("an Idempotency-Key could not be written; it is kept in memory")
            self._unwritten[mark.scope, mark.key] = mark.body_sha256, made

    @contextlib.contextmanager
    def _turn(self, scoped_key: tuple[str, str]) -> Iterator[None]:
        """One at a time for each key."""
        with self._guard:
            lock, users = self._locks.setdefault(scoped_key, (threading.Lock(), [0]))
            users[0] += 1
        try:
            with lock:
                yield
        finally:
            with self._guard:
                users[0] -= 1
                if users[0] == 0:
                    self._locks.pop(scoped_key, None)
