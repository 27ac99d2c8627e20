"""The catalogue: an index of the data folder and the table of jobs, in SQLite.

One thread writes for all others. WAL and ``synchronous=FULL``: a job that was acknowledged is on disk. The index of
calibrations, tests, steps and analyses can be lost at any time; it is rebuilt from the folders.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import queue
import sqlite3
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any, Self, TypeVar

from stereorig.core.errors import StorageError
from stereorig.server.base.models import Ids
from stereorig.server.documents.jobs import JobRecord
from stereorig.server.formats.manifest import kept
from stereorig.server.store.durable import Reserve

T = TypeVar("T")
#: kind, parent, id, document
Entry = tuple[str, str, str, Mapping[str, object]]
_log = logging.getLogger("stereorig.store")
_PATIENCE_S = 30.0
# on a full disk the stage must still move, and each move is on disk before it is acknowledged: the log of SQLite is
# begun again after so many pages, for which it has disk, and the file has disk for some hundred further jobs
_LOG_PAGES = 100
_LOG_BYTES = 512 * 2**10
_AHEAD_BYTES = 256 * 2**10
_SCHEMA = """
CREATE TABLE IF NOT EXISTS jobs (
    id TEXT PRIMARY KEY, state TEXT NOT NULL, document TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS requests (
    scope TEXT NOT NULL, key TEXT NOT NULL, body_sha256 TEXT NOT NULL, made TEXT NOT NULL, PRIMARY KEY (scope, key)
);
CREATE TABLE IF NOT EXISTS entries (
    kind TEXT NOT NULL, parent TEXT NOT NULL, id TEXT NOT NULL, document TEXT NOT NULL, PRIMARY KEY (kind, parent, id)
);
CREATE TABLE IF NOT EXISTS counters (name TEXT PRIMARY KEY, value INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS manifests (home TEXT PRIMARY KEY, number INTEGER NOT NULL, sha256 TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS jobs_by_state ON jobs (state);
"""


class Catalog:
    """``catalog.sqlite`` with its one writer thread.

    A file that SQLite cannot read is quarantined (``catalog.corrupt-<n>.sqlite``) and replaced by an empty one;
    ``was_reset`` is then True.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._work: queue.SimpleQueue[tuple[Callable[[sqlite3.Connection], Any], Future[Any]] | None] = (
            queue.SimpleQueue()
        )
        self.was_reset = False
        #: something that was to be written was not: the index may lack it
        self.write_failed = False
        #: called with a test's id before its steps or analyses are listed, so that the index is right about them
        self.before_parts: Callable[[str], None] | None = None
        #: numbers and checksums of the newest manifests, by their folders: they go with the next transaction
        self.unsettled: dict[str, tuple[int, str]] = {}
        self._sound = False
        self._opened: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, name="catalog", daemon=True)

    def open(self, *, sound: bool = False) -> Self:
        """Open the file and start the writer.

        Parameters
        ----------
        sound
            The file is known to be the one that was closed, bit for bit, and need not be checked.

        Raises
        ------
        StorageError
            If it can be neither opened nor replaced.
        """
        self._sound = sound
        self._thread.start()
        self._opened.result()
        rows = self.transact(lambda c: c.execute("SELECT home, number, sha256 FROM manifests").fetchall())
        kept.anchors.update({self.path.parent / home: (number, sha256) for home, number, sha256 in rows})
        return self

    def _open(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self.path, isolation_level=None)
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            connection.execute("PRAGMA synchronous=FULL")
            connection.execute(f"PRAGMA wal_autocheckpoint={_LOG_PAGES}")
            if not self._sound and connection.execute("PRAGMA quick_check").fetchone()[0] != "ok":
                raise sqlite3.DatabaseError("quick_check failed")
            connection.executescript(_SCHEMA)
        except sqlite3.Error:
            connection.close()
            raise
        return connection

    def _open_or_reset(self) -> sqlite3.Connection:
        try:
            return self._open()
        except sqlite3.DatabaseError:
            number = len(list(self.path.parent.glob("catalog.corrupt-*.sqlite"))) + 1
            self.path.rename(self.path.with_name(f"catalog.corrupt-{number}.sqlite"))
            for suffix in ("-wal", "-shm"):
                self.path.with_name(self.path.name + suffix).unlink(missing_ok=True)
            self.was_reset = True
            return self._open()

    def _run(self) -> None:
        try:
            connection = self._open_or_reset()
        except (sqlite3.Error, OSError) as error:
            self._opened.set_exception(StorageError(f"The catalogue cannot be opened: {error}."))
            return
        files, reserve = self._reserves()
        self._opened.set_result(None)
        while (item := self._work.get()) is not None:
            function, future = item
            try:
                connection.execute("BEGIN IMMEDIATE")
                try:
                    result = function(connection)
                    newest = dict(self.unsettled)
                    rows = [(home, *manifest) for home, manifest in newest.items()]
                    connection.executemany("INSERT OR REPLACE INTO manifests VALUES (?, ?, ?)", rows)
                    connection.execute("COMMIT")
                    for home in [one for one, manifest in newest.items() if self.unsettled.get(one) == manifest]:
                        del self.unsettled[home]
                except BaseException:
                    # a full disk ends a transaction by itself, or leaves it open at its commit
                    if connection.in_transaction:
                        connection.execute("ROLLBACK")
                    raise
            except sqlite3.Error as error:
                self.write_failed = True
                full = "full" in str(error)
                future.set_exception(
                    StorageError(f"The catalogue was not written: {error}.", code="storage_full" if full else None)
                )
            except BaseException as error:  # noqa: BLE001 - passed to the caller, who waits for it
                future.set_exception(error)
            else:
                future.set_result(result)
                if reserve is not None:
                    reserve.renew()
        connection.close()
        for file in files:  # not before: a process that closes a file gives up every lock that it has on it
            os.close(file)

    def _reserves(self) -> tuple[list[int], Reserve | None]:
        """Hold disk ahead of the file's end and of its log's; return the open files, and the reserve to be renewed."""
        files: list[int] = []
        try:
            for path in (self.path.with_name(f"{self.path.name}-wal"), self.path):
                files.append(os.open(path, os.O_WRONLY | os.O_CLOEXEC))
            Reserve(files[0], _LOG_BYTES)
            return files, Reserve(files[1], _AHEAD_BYTES)
        except OSError as error:
            _log.warning("the catalogue has no disk in reserve: %s", error.strerror)
            return files, None

    def transact(self, function: Callable[[sqlite3.Connection], T]) -> T:
        """Run ``function`` in a transaction on the writer thread, and wait for its commit."""
        future: Future[T] = Future()
        self._work.put((function, future))
        # a disk that is busy for so long still commits; giving up would leave the outcome unknown
        while not wait([future], timeout=_PATIENCE_S).done and self.alive:
            _log.warning("The catalogue has not committed for %.0f s: the disk is slow.", _PATIENCE_S)
        if not future.done():
            raise StorageError("The catalogue is closed.")
        return future.result()

    @property
    def alive(self) -> bool:
        """Return True if the writer runs."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Finish the queue and close."""
        if self.unsettled and self.alive:
            with contextlib.suppress(StorageError):  # the manifests are newer than the record, which is no damage
                self.transact(lambda _: None)
        self._work.put(None)
        self._thread.join(timeout=30.0)

    def put_job(self, job: JobRecord, request: tuple[str, str, str, Ids] | None = None) -> None:
        """Insert or update a job; with the request (scope, key, body_sha256, made) that asked for it, both or none."""
        text = json.dumps(job.kept().plain())

        def write(c: sqlite3.Connection) -> None:
            c.execute("INSERT OR REPLACE INTO jobs (id, state, document) VALUES (?, ?, ?)", (job.id, job.state, text))
            if request is not None:
                scope, key, digest, made = request
                c.execute("INSERT OR REPLACE INTO requests VALUES (?, ?, ?, ?)", (scope, key, digest, json.dumps(made)))

        self.transact(write)

    def jobs(
        self,
        *,
        states: tuple[str, ...] | None = None,
        limit: int | None = None,
        before: str | None = None,
        most: int | None = None,
    ) -> list[JobRecord]:
        """Return jobs, newest first.

        Parameters
        ----------
        states
            Only those in one of these.
        limit
            So many at most.
        before
            Only those whose id is smaller.
        most
            So many entries of each list in their results at most, see :meth:`JobRecord.bounded`.
        """

        def read(c: sqlite3.Connection) -> list[tuple[str]]:
            terms: list[str] = []
            values: list[str] = []
            if states is not None:
                terms.append(f"state IN ({','.join('?' * len(states))})")
                values += states
            if before is not None:
                terms.append("id < ?")
                values.append(before)
            where = f"WHERE {' AND '.join(terms)}" if terms else ""
            query = f"SELECT document FROM jobs {where} ORDER BY id DESC LIMIT ?"
            return c.execute(query, (*values, limit or -1)).fetchall()

        return [_job_in(row[0], most) for row in self.transact(read)]

    def job(self, job_id: str) -> JobRecord | None:
        """Return one job's document."""
        row = self.transact(lambda c: c.execute("SELECT document FROM jobs WHERE id = ?", (job_id,)).fetchone())
        return None if row is None else JobRecord.model_validate_json(row[0])

    def put_entry(self, kind: str, parent: str, entry_id: str, document: Mapping[str, object]) -> None:
        """Insert or update an index entry (``calibration``, ``test``, ``step``, ``analysis``)."""
        self.put_entries(kind, parent, {entry_id: document})

    def put_entries(self, kind: str, parent: str, documents: Mapping[str, Mapping[str, object]]) -> None:
        """Insert or update index entries of a kind by their ids, in one transaction."""
        rows = [(kind, parent, entry_id, json.dumps(document)) for entry_id, document in documents.items()]
        self.transact(lambda c: c.executemany("INSERT OR REPLACE INTO entries VALUES (?, ?, ?, ?)", rows))

    def entries(
        self, kind: str, parent: str = "", *, after: str | None = None, limit: int | None = None
    ) -> list[dict[str, object]]:
        """Return the index entries of a kind, in order of their ids; ``after``: only those with a larger id."""
        self._complete(parent)
        query = "SELECT document FROM entries WHERE kind = ? AND parent = ? AND id > ? ORDER BY id LIMIT ?"
        rows = self.transact(lambda c: c.execute(query, (kind, parent, after or "", limit or -1)).fetchall())
        return [json.loads(row[0]) for row in rows]

    def entry(self, kind: str, parent: str, entry_id: str) -> dict[str, object] | None:
        """Return one index entry; None if there is none."""
        self._complete(parent)
        query = "SELECT document FROM entries WHERE kind = ? AND parent = ? AND id = ?"
        row = self.transact(lambda c: c.execute(query, (kind, parent, entry_id)).fetchone())
        return None if row is None else dict(json.loads(row[0]))

    def count_entries(self, kind: str, parent: str = "") -> int:
        """Return the number of index entries of a kind."""
        self._complete(parent)
        query = "SELECT COUNT(*) FROM entries WHERE kind = ? AND parent = ?"
        return int(self.transact(lambda c: c.execute(query, (kind, parent)).fetchone()[0]))

    def last_entry(self, kind: str, parent: str = "") -> dict[str, object] | None:
        """Return the index entry with the largest id; None if there is none."""
        self._complete(parent)
        query = "SELECT document FROM entries WHERE kind = ? AND parent = ? ORDER BY id DESC LIMIT 1"
        row = self.transact(lambda c: c.execute(query, (kind, parent)).fetchone())
        return None if row is None else dict(json.loads(row[0]))

    def entry_ids(self, kind: str) -> set[str]:
        """Return the ids of the index entries of a kind that has no parents."""
        return self.transact(lambda c: {row[0] for row in c.execute("SELECT id FROM entries WHERE kind = ?", (kind,))})

    def _complete(self, parent: str) -> None:
        if parent and self.before_parts is not None:
            self.before_parts(parent)

    def remove_entry(self, kind: str, parent: str, entry_id: str) -> None:
        """Remove something from the index; with a test, its steps and analyses."""

        def write(c: sqlite3.Connection) -> None:
            c.execute("DELETE FROM entries WHERE kind = ? AND parent = ? AND id = ?", (kind, parent, entry_id))
            if kind == "test":
                c.execute("DELETE FROM entries WHERE parent = ?", (entry_id,))

        self.transact(write)

    def replace_tests(self, calibrations: list[Entry], tests: list[Entry], *, gone: set[str]) -> list[str]:
        """Make the index hold exactly these calibrations; replace or add these tests, and keep the others.

        ``gone``: tests that it holds no longer. Returns the differences found.
        """

        def write(c: sqlite3.Connection) -> list[str]:
            differences = [f"test {test_id} has no folder" for test_id in gone]
            for test_id in gone:
                c.execute("DELETE FROM entries WHERE kind = 'test' AND id = ?", (test_id,))
                c.execute("DELETE FROM entries WHERE parent = ?", (test_id,))
            differences += _replace(c, "kind = 'calibration'", (), calibrations)
            had = {row[0] for row in c.execute("SELECT id FROM entries WHERE kind = 'test'")}
            differences += [
                f"test {test_id} was not in the catalogue" for _, _, test_id, _ in tests if test_id not in had
            ]
            c.executemany("INSERT OR REPLACE INTO entries VALUES (?, ?, ?, ?)", _rows(tests))
            return sorted(differences)

        return self.transact(write)

    def replace_test(self, test_id: str, entries: list[Entry]) -> list[str]:
        """Make the index hold exactly ``entries`` of a test; return the differences found."""
        where = "(kind = 'test' AND id = ?) OR parent = ?"
        return self.transact(lambda c: sorted(_replace(c, where, (test_id, test_id), entries)))

    def put_request(self, scope: str, key: str, body_sha256: str, made: Ids) -> None:
        """Record the result of a request with an Idempotency-Key."""
        text = json.dumps(made)
        self.transact(
            lambda c: c.execute("INSERT OR REPLACE INTO requests VALUES (?, ?, ?, ?)", (scope, key, body_sha256, text))
        )

    def request(self, scope: str, key: str) -> tuple[str, Ids] | None:
        """Return (body_sha256, made) of an earlier request."""
        row = self.transact(
            lambda c: c.execute(
                "SELECT body_sha256, made FROM requests WHERE scope = ? AND key = ?", (scope, key)
            ).fetchone()
        )
        return None if row is None else (row[0], json.loads(row[1]))

    def newest_job(self) -> str | None:
        """Return the largest id of a job."""
        found = self.transact(lambda c: c.execute("SELECT MAX(id) FROM jobs").fetchone()[0])
        return None if found is None else str(found)

    def restore(self, jobs: list[JobRecord], requests: list[tuple[str, str, str, Ids]]) -> None:
        """Take over jobs and requests (scope, key, body_sha256, made) that were found elsewhere."""
        job_rows = [(job.id, job.state, json.dumps(job.kept().plain())) for job in jobs]
        request_rows = [(scope, key, digest, json.dumps(made)) for scope, key, digest, made in requests]

        def write(c: sqlite3.Connection) -> None:
            c.executemany("INSERT OR IGNORE INTO jobs (id, state, document) VALUES (?, ?, ?)", job_rows)
            c.executemany("INSERT OR IGNORE INTO requests VALUES (?, ?, ?, ?)", request_rows)

        if job_rows or request_rows:
            self.transact(write)

    def count_up(self, name: str, minimum: int = 0) -> int:
        """Return a number that is larger than every one returned before under this name, and not below ``minimum``."""

        def write(c: sqlite3.Connection) -> int:
            row = c.execute("SELECT value FROM counters WHERE name = ?", (name,)).fetchone()
            value = max(minimum, 0 if row is None else int(row[0]) + 1)
            c.execute("INSERT OR REPLACE INTO counters VALUES (?, ?)", (name, value))
            return value

        return self.transact(write)


def _rows(entries: list[Entry]) -> list[tuple[str, str, str, str]]:
    return [(kind, parent, entry_id, json.dumps(document)) for kind, parent, entry_id, document in entries]


def _replace(c: sqlite3.Connection, where: str, values: tuple[str, ...], entries: list[Entry]) -> list[str]:
    """Make the entries that fulfil a condition exactly these; return the differences."""
    rows = _rows(entries)
    wanted = {row[:3] for row in rows}
    had = set(c.execute(f"SELECT kind, parent, id FROM entries WHERE {where}", values).fetchall())
    differences = [f"{k} {p + '/' if p else ''}{i} was not in the catalogue" for k, p, i in wanted - had]
    differences += [f"{k} {p + '/' if p else ''}{i} has no folder" for k, p, i in had - wanted]
    c.execute(f"DELETE FROM entries WHERE {where}", values)
    c.executemany("INSERT OR REPLACE INTO entries VALUES (?, ?, ?, ?)", rows)
    return differences


@functools.lru_cache(maxsize=128)
def _job_in(text: str, most: int | None) -> JobRecord:
    """Return a job's document as it is listed; those that ended stay as they are, and fill most of a list."""
    found = JobRecord.model_validate_json(text)
    return found if most is None else found.bounded(most)
