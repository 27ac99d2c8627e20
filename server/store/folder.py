"""The data folder itself: its format, its lock, its ids, its clock."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import shutil
import socket
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Self

from stereorig.core.errors import FileFormatError, StateError, StorageError
from stereorig.server.formats import disk as _disk
from stereorig.server.formats.files import fsync_path, storage_error
from stereorig.server.formats.manifest import kept
from stereorig.server.store.durable import read_json, write_bytes, write_json
from stereorig.server.store.manifests import Manifests, finish_renaming

#: 2: each folder of data has a manifest
FORMAT = 2
#: begin of the name of a folder that something is opened into before it is shown; it ends in ``.part``
STAGING = ".opening-"
_ID = re.compile(r"[a-z][0-9]{6}-[0-9a-f]{6}")


def now_utc() -> str:
    """Wall-clock time for display, ISO 8601 in UTC; order never depends on it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def is_id(text: str, letter: str) -> bool:
    """Return True if ``text`` has the form of an id that this service makes; nothing else ever becomes a path."""
    return text.startswith(letter) and _ID.fullmatch(text) is not None


def check_format(path: Path) -> None:
    """Raise an error for the ``format.json`` of a newer version.

    Raises
    ------
    FileFormatError
        ``data_format_newer``.
    """
    found = read_json(path).get("format")
    if not isinstance(found, int) or isinstance(found, bool) or found > FORMAT:
        raise FileFormatError(
            f"The data folder has format {found}, this version reads up to {FORMAT}.",
            code="data_format_newer",
            remedy="Use the version that wrote it, or a newer one.",
        )


class IdMaker:
    """Ids that sort in the order of their making, independent of the clock: a counter and six random digits."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: dict[str, int] = {}

    def reserve(self, name: str) -> None:
        """Reserve an id that exists."""
        with self._lock:
            self._last[name[0]] = max(self._last.get(name[0], 0), int(name[1:7]))

    def new(self, letter: str) -> str:
        """Return a new id that starts with ``letter``."""
        with self._lock:
            number = self._last.get(letter, 0) + 1
            self._last[letter] = number
        return f"{letter}{number:06d}-{secrets.token_hex(3)}"


class DataFolder:
    """A data folder; nothing is read or written there before :meth:`open`.

    Parameters
    ----------
    root
        The folder.
    holder
        Process that another service is asked to stop; by default this one.
    """

    def __init__(self, root: Path, *, holder: int | None = None) -> None:
        self._holder = os.getpid() if holder is None else holder
        self.root = root.absolute()
        self.ids = IdMaker()
        self.manifests = Manifests(self.root)
        self._lock_file: IO[str] | None = None
        self._identity: tuple[int, int] | None = None

    def open(self) -> Self:
        """Make the folder if it is missing, lock and check it.

        Raises
        ------
        StateError
            ``data_folder_locked`` if another service holds it.
        StorageError
            ``data_folder_unusable`` if files cannot be written, fsynced and renamed there.
        FileFormatError
            ``data_format_newer`` if a newer version wrote it.
        """
        try:
            for folder in (self.root, self.calibrations, self.tests):
                _make_with_parents(folder)
        except OSError as error:
            raise _unusable(self.root, error) from error
        self._take_lock()
        kept.forget(self.root)
        kept.owned.add(self.root)
        try:
            self._probe()
            self._check_format()
            self._remove_temporaries()
            self._identity = _identity_of(self.root)
        except BaseException:
            self.close()
            raise
        return self

    @property
    def calibrations(self) -> Path:
        """Folder of the calibrations."""
        return self.root / "calibrations"

    @property
    def tests(self) -> Path:
        """Folder of the tests."""
        return self.root / "tests"

    def require_there(self) -> None:
        """Raise an error if the folder that was opened is not under its name, or cannot be written to.

        Raises
        ------
        StorageError
            ``data_folder_gone``; ``data_folder_read_only``.
        """
        reason, read_only = "another folder has its name", False
        try:
            there = self._identity in (None, _identity_of(self.root))
            read_only = bool(os.statvfs(self.root).f_flag & os.ST_RDONLY)
        except OSError as error:
            there, reason = False, error.strerror or str(error)
        if not there:
            raise StorageError(
                f"The data folder is gone ({reason}).",
                code="data_folder_gone",
                remedy="Mount its disk or move the folder back to its place; the service continues by itself.",
            )
        if read_only:
            raise StorageError(
                "The data folder's disk is read-only.",
                code="data_folder_read_only",
                remedy="Check the disk, and mount it so that it can be written to; the service continues by itself.",
            )

    def require_room(self, reserve_mib: float) -> None:
        """Raise an error for new work while the disk is nearly full: running work must still be able to end well.

        Raises
        ------
        StorageError
            ``storage_full``, with the space that is left; as :meth:`require_there`.
        """
        self.require_there()
        free_mib = self.free_mib()
        if free_mib < reserve_mib or free_mib == 0.0:
            raise StorageError(
                f"Only {free_mib:.0f} MiB are left on the data folder's disk, {reserve_mib:g} MiB are kept free.",
                code="storage_full",
                remedy="Free space on that disk, or lower free_reserve_mib in the rig file.",
                free_mib=free_mib,
            )

    def free_mib(self) -> float:
        """Room on the data folder's disk."""
        return shutil.disk_usage(self.root).free / 2**20

    def _take_lock(self) -> None:
        path = self.root / "service.lock"
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise _unusable(self.root, error) from error
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if not isinstance(error, BlockingIOError):
                file.close()
                raise _unusable(self.root, error) from error
            file.seek(0)
            holder = file.read().strip() or "another process"
            file.close()
            raise StateError(
                f"The data folder {self.root} is in use by {holder}.",
                code="data_folder_locked",
                remedy="Stop that service, or give this one its own --data folder.",
                holder=holder,
            ) from error
        if not _keeps_out(path):
            file.close()
            raise StorageError(
                f"The data folder {self.root} cannot be used: a lock there does not keep others out.",
                code="data_folder_unusable",
                remedy="Give a folder on a local disk with --data.",
            )
        file.truncate(0)
        file.write(f"process {self._holder} on {socket.gethostname()}")
        file.flush()
        self._lock_file = file

    def _probe(self) -> None:
        probe = self.root / ".probe"
        try:
            for content in (b"once", b"twice"):  # a rename must replace an existing file
                write_bytes(probe, content)
                if probe.read_bytes() != content:
                    raise StorageError("A file that was renamed is not there.")
            probe.unlink()
        except StorageError as error:
            raise StorageError(
                f"The data folder {self.root} does not keep files: {error.cause}", code="data_folder_unusable"
            ) from error

    def _check_format(self) -> None:
        path = self.root / "format.json"
        if path.exists():
            check_format(path)
            if read_json(path)["format"] == FORMAT:
                return
        # the number comes first: a program that knows of no manifests would write past them
        write_json(path, {"format": FORMAT, "written_by": "stereorig"})

    def _remove_temporaries(self) -> None:
        # half-written files of a killed program; `indexing.build` removes a test's and the trash's
        for path in self.root.glob(f"{STAGING}*.part"):
            shutil.rmtree(path, ignore_errors=True)
        finish_renaming(self.root, beside={self.tests, self.root / "trash"})

    def close(self) -> None:
        """Release the lock."""
        if self._lock_file is not None:
            kept.forget(self.root)
            self._lock_file.close()
            self._lock_file = None


def is_in_use(root: Path) -> bool:
    """Return True if a service runs on a data folder."""
    path = root / "service.lock"
    return path.exists() and _keeps_out(path)


def _keeps_out(path: Path) -> bool:
    """Return True if others are kept out by a lock that is held."""
    with path.open("rb") as other:
        try:
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False
    return False


def _identity_of(folder: Path) -> tuple[int, int]:
    found = folder.stat()
    return found.st_dev, found.st_ino


def _make_with_parents(folder: Path) -> None:
    """Make a folder durably, with those above it that are not there."""
    for missing in reversed([path for path in (folder, *folder.parents) if not path.exists()]):
        _disk.disk.make_folder(missing)
        fsync_path(missing.parent)


def _unusable(root: Path, error: OSError) -> StorageError:
    cause = storage_error(error, root).cause
    return StorageError(
        f"The data folder {root} cannot be used: {cause}",
        code="data_folder_unusable",
        remedy="Give a folder that this user can write to with --data.",
    )
