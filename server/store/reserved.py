"""Disk that a file holds ahead of its end, so that a full disk still takes its next lines."""

from __future__ import annotations

import ctypes
import os

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE of linux/falloc.h: readers see no byte of the reserve


class Reserve:
    """Keeps blocks ahead of the end of an open file; has none where system or file system cannot.

    Parameters
    ----------
    file
        Descriptor that can write.
    ahead_bytes
        Length of the reserve.
    """

    def __init__(self, file: int, ahead_bytes: int) -> None:
        self._file, self._ahead = file, ahead_bytes
        self._end = os.fstat(file).st_size
        self.renew()

    def renew(self) -> None:
        """Make the reserve whole once half of it is used; on a full disk it stays as it is."""
        size = os.fstat(self._file).st_size
        if self._end - size < self._ahead // 2:
            start = max(size, self._end)
            if _allocate(self._file, start, size + self._ahead - start):
                self._end = size + self._ahead

    @property
    def left_bytes(self) -> int:
        """Room that is certain."""
        return max(0, self._end - os.fstat(self._file).st_size)


def _allocate(file: int, start: int, count: int) -> bool:
    allocate = getattr(ctypes.CDLL(None), "fallocate", None)
    if allocate is None:
        return False
    return bool(allocate(file, _KEEP_SIZE, ctypes.c_int64(start), ctypes.c_int64(count)) == 0)
