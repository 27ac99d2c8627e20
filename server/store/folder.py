"""The data folder itself: its format, its lock, its ids, its clock."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import socket
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from core.errors import FileFormatError, StateError, StorageError
from server.io.files import storage_error
from server.store.durable import read_json, write_bytes, write_json

FORMAT = 1
_ID = re.compile(r"[a-z]\d{6}-[0-9a-f]{6}")


def now_utc() -> str:
    """Wall-clock time for people, ISO 8601 in UTC; order never depends on it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def is_id(text: str, letter: str) -> bool:
    """Whether ``text`` has the form of an id that this service makes; nothing else ever becomes a path."""
    return text.startswith(letter) and _ID.fullmatch(text) is not None


class IdMaker:
    """Ids that sort in the order of their making, whatever the clock does: a counter and six random digits."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: dict[str, int] = {}

    def seen(self, name: str) -> None:
        """Take note of an id that exists."""
        with self._lock:
            self._last[name[0]] = max(self._last.get(name[0], 0), int(name[1:7]))

    def new(self, letter: str) -> str:
        """Return a new id that starts with ``letter``."""
        with self._lock:
            number = self._last.get(letter, 0) + 1
            self._last[letter] = number
        return f"{letter}{number:06d}-{secrets.token_hex(3)}"


class DataFolder:
    """An opened and locked data folder.

    Raises
    ------
    StateError
        ``data_folder_locked`` if another service holds it.
    StorageError
        ``data_folder_unusable`` if files cannot be written, fsynced and renamed there.
    FileFormatError
        ``data_format_newer`` if a newer version wrote it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.ids = IdMaker()
        self._lock_file: IO[str] | None = None
        try:
            for folder in (self.root, self.calibrations, self.tests):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unusable(self.root, error) from error
        self._take_lock()
        try:
            self._probe()
            self._check_format()
            self._remove_temporaries()
        except BaseException:
            self.close()
            raise

    @property
    def calibrations(self) -> Path:
        """Where calibrations live."""
        return self.root / "calibrations"

    @property
    def tests(self) -> Path:
        """Where tests live."""
        return self.root / "tests"

    def _take_lock(self) -> None:
        path = self.root / "service.lock"
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise _unusable(self.root, error) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            holder = file.read().strip() or "another process"
            file.close()
            raise StateError(
                f"The data folder {self.root} is in use by {holder}.",
                code="data_folder_locked",
                remedy="Stop that service, or give this one its own --data folder.",
                holder=holder,
            ) from error
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}")
        file.flush()
        self._lock_file = file

    def _probe(self) -> None:
        probe = self.root / ".probe"
        try:
            write_bytes(probe, b"probe")
            probe.unlink()
        except StorageError as error:
            raise StorageError(
                f"The data folder {self.root} does not keep files: {error.cause}", code="data_folder_unusable"
            ) from error

    def _check_format(self) -> None:
        path = self.root / "format.json"
        if not path.exists():
            write_json(path, {"format": FORMAT, "written_by": "stereorig"})
            return
        found = read_json(path).get("format")
        if not isinstance(found, int) or found > FORMAT:
            raise FileFormatError(
                f"The data folder has format {found}, this version knows up to {FORMAT}.",
                code="data_format_newer",
                remedy="Use the version that wrote it, or a newer one.",
            )

    def _remove_temporaries(self) -> None:
        # what a kill left half written; only names that `written_aside` makes
        for path in self.root.rglob(".*.part"):
            path.unlink(missing_ok=True)

    def close(self) -> None:
        """Give the lock back."""
        if self._lock_file is not None:
            self._lock_file.close()
            self._lock_file = None


def _unusable(root: Path, error: OSError) -> StorageError:
    cause = storage_error(error, root).cause
    return StorageError(
        f"The data folder {root} cannot be used: {cause}",
        code="data_folder_unusable",
        remedy="Give a folder that this user can write to with --data.",
    )
