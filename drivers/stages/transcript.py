"""A transcript of the traffic on a serial line, for users who report trouble: plain text, one line a write or read.

Each line holds the time (UTC), seconds since the line was opened by a clock that never steps, a direction and the
bytes: ``>`` to the controller, ``!`` to the controller around every queue (a stop), ``<`` from it, ``#`` a remark.

Every line is handed to the operating system at once and after the bytes went out, without a lock: it survives a kill of
the program, and delays no stop. A file that has reached its limit is renamed to ``NAME.1`` in place of the one before,
so that both together never hold more than twice the limit. A disk that fails ends the transcript, not the motion.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from stereorig.core.errors import StageError

#: bytes after which a new file is begun: about a day of polling at rest
LIMIT_BYTES = 20 << 20


class Transcript:
    """Writes one transcript; `note` may be called from any thread.

    Parameters
    ----------
    path
        File to append to.
    title
        Text at the head of each file.
    limit_bytes
        Size at which a new file is begun.
    """

    def __init__(self, path: Path, title: str, *, limit_bytes: int = LIMIT_BYTES) -> None:
        self._path = path
        self._title = title
        self._limit = limit_bytes
        self._start = time.monotonic()
        self._turning = threading.Lock()
        self._broken = False
        self._fd, self._size = -1, 0

    def open(self) -> Self:
        """Begin to write.

        Raises
        ------
        StageError
            ``record_unusable`` when the file cannot be written.
        """
        try:
            self._fd = self._new_file()
            self._size = os.fstat(self._fd).st_size
        except OSError as error:
            raise StageError(
                f"The transcript {self._path} cannot be written ({error.strerror}).",
                code="record_unusable",
                remedy="Name a file in a folder that can be written with --record.",
            ) from error
        return self

    def note(self, mark: str, data: bytes) -> None:
        """Add bytes written or read; never raises."""
        self._write(f"{mark} {data!r}")

    def remark(self, text: str) -> None:
        """Add a remark; never raises."""
        self._write(f"# {text}")

    def close(self) -> None:
        """End the transcript; safe to call twice."""
        self._write("# closed")
        with self._turning:
            fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _line(self, text: str) -> bytes:
        now = datetime.now(UTC).isoformat(timespec="microseconds").removesuffix("+00:00")
        return f"{now}Z {time.monotonic() - self._start:13.6f} {text}\n".encode("ascii", "backslashreplace")

    def _new_file(self) -> int:
        fd = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
        with contextlib.suppress(OSError):
            os.write(fd, self._line(f"# {self._title}"))
        return fd

    def _write(self, text: str) -> None:
        fd = self._fd
        if fd < 0 or self._broken:
            return
        line = self._line(text)
        try:
            os.write(fd, line)
        except OSError:  # a full or broken disk: the motion continues
            self._broken = True
            return
        self._size += len(line)
        if self._size >= self._limit:
            self._turn()

    def _turn(self) -> None:
        if not self._turning.acquire(blocking=False):
            return  # another thread is at it
        try:
            if self._fd < 0 or self._size < self._limit:
                return
            try:
                self._path.replace(self._path.with_name(self._path.name + ".1"))
                fresh = self._new_file()
            except OSError:
                self._broken = True
                return
            # the descriptor stays: another thread may be about to write to it
            os.dup2(fresh, self._fd, inheritable=False)
            os.close(fresh)
            self._size = 0
        finally:
            self._turning.release()
