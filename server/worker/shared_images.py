"""Images in memory that the service shares with its worker; a pipe takes five times as long.

One sender and one reader take turns: the next images overwrite the last ones, which the reader has copied by then.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ALIGNED = 64  # bytes


@dataclass(frozen=True)
class Placed:
    """Places of images in shared memory, for a process of the same user on the same machine.

    Attributes
    ----------
    file, size
        The shared memory's file and its length, bytes.
    images
        First byte, shape and type of each image.
    """

    file: str
    size: int
    images: tuple[tuple[int, tuple[int, ...], str], ...]

    def read(self) -> tuple[NDArray[Any], ...]:
        """Return copies of the images."""
        global _mapped
        if _mapped is None or _mapped[0] != (self.file, self.size):
            with Path(self.file).open("rb") as file:
                _mapped = (self.file, self.size), mmap.mmap(file.fileno(), self.size, prot=mmap.PROT_READ)
        memory = _mapped[1]
        return tuple(np.ndarray(shape, kind, memory, first).copy() for first, shape, kind in self.images)


_mapped: tuple[tuple[str, int], mmap.mmap] | None = None  # kept: mapping it again costs as much as copying


class SharedImages:
    """The sender's side: memory without a name on any disk, gone with its last user."""

    def __init__(self) -> None:
        self._file = os.fdopen(os.memfd_create("stereorig images"), "r+b", buffering=0)
        self._memory: mmap.mmap | None = None

    def put(self, images: Sequence[NDArray[Any]]) -> Placed:
        """Copy images in, over the last ones.

        Raises
        ------
        OSError
            The machine has no memory left for them.
        """
        firsts, size = [], 0
        for image in images:
            firsts.append(size)
            size += -(-image.nbytes // _ALIGNED) * _ALIGNED
        if self._memory is None or len(self._memory) < size:
            os.posix_fallocate(self._file.fileno(), 0, size)  # an error here; later it would be a signal
            self._memory = mmap.mmap(self._file.fileno(), size)
        for image, first in zip(images, firsts, strict=True):
            np.ndarray(image.shape, image.dtype, self._memory, first)[...] = image
        placed = tuple((first, image.shape, image.dtype.str) for image, first in zip(images, firsts, strict=True))
        return Placed(f"/proc/{os.getpid()}/fd/{self._file.fileno()}", len(self._memory), placed)

    def close(self) -> None:
        """Let go of the memory; safe to call twice."""
        self._memory = None
        self._file.close()
