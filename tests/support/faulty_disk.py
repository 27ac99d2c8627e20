"""A disk that fails at its n-th call, in each of the ways that disks have."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Literal

from tests.support.hooked_disk import HookedDisk

Way = Literal["full", "write_error", "short_write", "sync_error", "rename_error", "read_only"]
WAYS: tuple[Way, ...] = ("full", "write_error", "short_write", "sync_error", "rename_error", "read_only")
_NUMBERS = {
    "full": errno.ENOSPC,
    "write_error": errno.EIO,
    "short_write": errno.ENOSPC,
    "sync_error": errno.EIO,
    "rename_error": errno.EIO,
    "read_only": errno.EROFS,
}
_CALLS = {
    "full": {"write", "make_folder"},
    "write_error": {"write", "make_folder"},
    "short_write": {"write"},
    "sync_error": {"sync"},
    "rename_error": {"replace"},
    "read_only": {"write", "sync", "replace", "make_folder"},
}


class FaultyDisk(HookedDisk):
    """Fails the n-th of the calls that the way concerns; a full or read-only disk stays so.

    Parameters
    ----------
    way
        What goes wrong.
    n
        Which call, from 1.
    """

    def __init__(self, way: Way, n: int) -> None:
        self.way, self.n = way, n
        self.calls = 0

    @property
    def failed(self) -> bool:
        """Whether it came to it."""
        return self.calls >= self.n

    def _count(self, call: str) -> bool:
        if call not in _CALLS[self.way]:
            return False
        self.calls += 1
        return self.calls >= self.n if self.way in ("full", "read_only") else self.calls == self.n

    def before(self, call: str, path: Path, data: bytes = b"") -> None:
        """Fail, if it is this call's turn."""
        if self._count(call):
            if self.way == "short_write":
                path.write_bytes(data[: len(data) // 2])
            number = _NUMBERS[self.way]
            raise OSError(number, os.strerror(number), str(path))
