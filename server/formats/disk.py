"""Every change that our code makes to the disk; tests replace the module's object by one that fails at some call."""

from __future__ import annotations

import os
from pathlib import Path


class Disk:
    """The real one."""

    def write(self, path: Path, data: bytes) -> None:
        """Write a new file."""
        path.write_bytes(data)

    def sync(self, path: Path) -> None:
        """Make a file's content, or a folder's renames and new names, durable."""
        fd = os.open(path, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)

    def replace(self, path: Path, target: Path) -> None:
        """Give a file its real name; replaces a file of that name."""
        path.replace(target)

    def make_folder(self, path: Path) -> None:
        """Make a folder whose parent exists."""
        path.mkdir()


disk = Disk()
