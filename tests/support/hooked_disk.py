"""The real disk, with something that happens before each of its four calls."""

from __future__ import annotations

from pathlib import Path

from stereorig.server.formats.disk import Disk


class HookedDisk(Disk):
    """Calls `before`, then does as the real one."""

    def before(self, call: str, path: Path, data: bytes = b"") -> None:
        """Do what is to be done before a call, by its name; ``data`` is what it would write."""
        raise NotImplementedError

    def write(self, path: Path, data: bytes) -> None:
        """Write a new file."""
        self.before("write", path, data)
        super().write(path, data)

    def sync(self, path: Path) -> None:
        """Make it durable."""
        self.before("sync", path)
        super().sync(path)

    def replace(self, path: Path, target: Path) -> None:
        """Rename."""
        self.before("replace", path)
        super().replace(path, target)

    def make_folder(self, path: Path) -> None:
        """Make a folder."""
        self.before("make_folder", path)
        super().make_folder(path)
