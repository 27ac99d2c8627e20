"""The audit log of a data folder, as JSON lines in a file that has disk reserved ahead of its end.

A full disk refuses captures, and just then an administrator must learn who did it: the next lines go into blocks that
the file holds already.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import threading
from pathlib import Path

from stereorig.server.store.durable import Reserve
from stereorig.server.store.folder import now_utc

_log = logging.getLogger("stereorig.audit")

AUDIT_FILE = "audit.log"
_FILE_BYTES = 10 * 2**20
_FILES = 10
#: a thousand lines
_RESERVE_BYTES = 256 * 2**10


class AuditLog:
    """Appends to ``audit.log``; older ones are kept as ``audit.log.1`` and so on.

    A line that the disk does not take is counted; the next one that it takes has the count as ``lines_lost_before``.
    """

    def __init__(self, data: Path) -> None:
        self._path = data / AUDIT_FILE
        self._lock = threading.Lock()
        self._open_file: tuple[int, Reserve] | None = None
        self._lost = 0

    def open(self) -> None:
        """Open the file and reserve disk for its next lines."""
        with self._lock, contextlib.suppress(OSError):  # the first line tries again, and reports it
            self._opened()

    def write(self, **entries: object) -> None:
        """Write one line; never raises for the disk."""
        with self._lock:
            if self._lost:
                entries["lines_lost_before"] = self._lost
            text = json.dumps({"utc": now_utc(), **entries}, ensure_ascii=False)
            try:
                self._append(f"{text}\n".encode(errors="backslashreplace"))
            except OSError as error:
                self._lost += 1
                if self._lost == 1:
                    _log.warning("a line of %s is lost: %s; further ones are counted", AUDIT_FILE, error.strerror)
                return
            if self._lost:
                _log.warning("%s takes lines again; %d were lost", AUDIT_FILE, self._lost)
                self._lost = 0

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            if self._open_file is not None:
                os.close(self._open_file[0])
                self._open_file = None

    def _opened(self) -> tuple[int, Reserve]:
        if self._open_file is None:
            self._open_file = _opened(self._path)
        return self._open_file

    def _append(self, line: bytes) -> None:
        file, reserve = self._opened()
        size = os.fstat(file).st_size
        if size and size + len(line) > _FILE_BYTES:
            file, reserve = self._rotated(file, size, reserve)
            size = os.fstat(file).st_size
        if os.write(file, line) < len(line):
            os.ftruncate(file, size)  # half a line would spoil the next one
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        reserve.renew()

    def _rotated(self, file: int, size: int, reserve: Reserve) -> tuple[int, Reserve]:
        """Begin a new file; on a full disk the old one is continued in its reserve."""
        following = self._path.with_name(f".{AUDIT_FILE}.part")
        try:
            new = _opened(following)
        except OSError:
            return file, reserve
        try:
            if not new[1].left_bytes and reserve.left_bytes:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.ftruncate(file, size)  # gives its reserve back
            for k in range(_FILES - 1, 0, -1):
                with contextlib.suppress(FileNotFoundError):
                    self._older(k).replace(self._older(k + 1))
            self._path.replace(self._older(1))
            following.replace(self._path)
        except OSError:
            os.close(new[0])
            following.unlink(missing_ok=True)
            return file, reserve
        os.close(file)
        self._open_file = new
        return new

    def _older(self, number: int) -> Path:
        return self._path.with_name(f"{AUDIT_FILE}.{number}")


def _opened(path: Path) -> tuple[int, Reserve]:
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o666)
    return file, Reserve(file, _RESERVE_BYTES)
