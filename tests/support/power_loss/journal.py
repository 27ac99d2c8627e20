"""What a service did to its data folder, call by call: names, contents and syncs, in the order in which they happened.

The four calls of :mod:`stereorig.server.formats.disk` are recorded as they return. What goes past that object is heard
by an audit hook of the interpreter: removals are recorded too, and a file that is opened for writing anywhere else is
kept in ``past``, so that a test can say that there is none.
"""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path

from stereorig.server.formats.disk import Disk

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass(frozen=True)
class Link:
    """A new name in a folder."""

    folder: int
    name: str
    inode: int


@dataclass(frozen=True)
class Move:
    """One rename: a name that goes and one that comes, or takes another's place."""

    folder: int
    name: str
    target: int
    target_name: str
    inode: int


@dataclass(frozen=True)
class Unlink:
    """A name that goes; of an empty folder too."""

    folder: int
    name: str
    inode: int


@dataclass(frozen=True)
class Content:
    """All that was written to a file so far."""

    inode: int
    blob: str


@dataclass(frozen=True)
class Sync:
    """A file's content, or a folder's names, made durable."""

    inode: int


Change = Link | Move | Unlink | Content | Sync
ROOT = 0


@dataclass
class Names:
    """Folders and files as they are if everything is kept: inodes by name, contents by inode."""

    folders: dict[int, dict[str, int]] = field(default_factory=lambda: {ROOT: {}})
    blobs: dict[int, str] = field(default_factory=dict)

    def find(self, path: str) -> int | None:
        """Return the inode of a path below the root; None where there is none."""
        inode = ROOT
        for name in filter(None, path.split("/")):
            found = self.folders.get(inode, {}).get(name)
            if found is None:
                return None
            inode = found
        return inode

    def apply(self, change: Change) -> None:
        """Take a change as made; a name whose folder is not there is no one's."""
        match change:
            case Link(folder, name, inode):
                self.folders.setdefault(folder, {})[name] = inode
            case Move(folder, name, target, target_name, inode):
                names = self.folders.setdefault(folder, {})
                if names.get(name) == inode:
                    del names[name]
                self.folders.setdefault(target, {})[target_name] = inode
            case Unlink(folder, name, inode):
                names = self.folders.setdefault(folder, {})
                if names.get(name) == inode:
                    del names[name]
            case Content(inode, blob):
                self.blobs[inode] = blob
            case Sync():
                pass

    def tree(self, is_folder: frozenset[int] | set[int], at: int = ROOT, path: str = "") -> dict[str, str | None]:
        """Return blobs by path; None stands for a folder. A file without content has the blob of no bytes."""
        found: dict[str, str | None] = {}
        for name, inode in self.folders.get(at, {}).items():
            below = f"{path}/{name}" if path else name
            if inode in is_folder:
                found[below] = None
                found |= self.tree(is_folder, inode, below)
            else:
                found[below] = self.blobs.get(inode, EMPTY)
        return found


EMPTY = hashlib.sha256(b"").hexdigest()


class Journal(Disk):
    """The real disk, with a journal of what became of the names below a folder.

    Parameters
    ----------
    root
        The folder above the data folder; what lies there at the beginning counts as durable.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.changes: list[Change] = []
        self.names = Names()
        self.is_folder: set[int] = {ROOT}
        self.blobs: dict[str, bytes] = {EMPTY: b""}
        self.past: set[str] = set()
        self._next = ROOT + 1
        self._lock = threading.RLock()
        self._inside = threading.local()
        self._active = True
        for path in sorted(self.root.rglob("*")):
            self._made(path, durable=True)
        sys.addaudithook(self._heard)

    def stop(self) -> None:
        """Hear no more; an audit hook cannot be taken out."""
        self._active = False

    def _relative(self, path: str | os.PathLike[str]) -> str | None:
        text = os.path.abspath(os.fspath(path))  # noqa: PTH100 - a plain text operation, it must ask the disk nothing
        return text[len(str(self.root)) + 1 :] if f"{text}/".startswith(f"{self.root}/") else None

    def _made(self, path: Path, *, durable: bool = False) -> None:
        relative = self._relative(path)
        assert relative is not None
        parent = self.names.find(os.path.dirname(relative))  # noqa: PTH120 - text
        assert parent is not None, relative
        inode, self._next = self._next, self._next + 1
        if path.is_dir():
            self.is_folder.add(inode)
        changes: list[Change] = [Link(parent, os.path.basename(relative), inode)]  # noqa: PTH119 - text
        if inode not in self.is_folder:
            changes.append(Content(inode, self._blob(path)))
        if durable:
            changes += [Sync(inode), Sync(parent)]
        self._note(*changes)

    def _note(self, *changes: Change) -> None:
        for change in changes:
            self.names.apply(change)
            self.changes.append(change)

    def _blob(self, path: Path) -> str:
        data = path.read_bytes()
        key = hashlib.sha256(data).hexdigest()
        self.blobs[key] = data
        return key

    # the four calls --------------------------------------------------------------------------------------------

    def write(self, path: Path, data: bytes) -> None:
        """Write a new file, and note name and content."""
        with self._lock, _Inside(self._inside):
            super().write(path, data)
            if self._relative(path) is not None:
                self._made(path)

    def sync(self, path: Path) -> None:
        """Sync, and note it; a file that was written without the object is noted as it is now."""
        with self._lock, _Inside(self._inside):
            super().sync(path)
            relative = self._relative(path)
            if relative is None:
                return
            inode = self.names.find(relative)
            if inode is None:
                self._made(path)
                inode = self.names.find(relative)
            elif inode not in self.is_folder and self.names.blobs.get(inode) != (now := self._blob(path)):
                self._note(Content(inode, now))
            assert inode is not None
            self._note(Sync(inode))

    def replace(self, path: Path, target: Path) -> None:
        """Rename, and note it."""
        with self._lock, _Inside(self._inside):
            super().replace(path, target)
            self._moved(str(path), str(target))

    def make_folder(self, path: Path) -> None:
        """Make a folder, and note it."""
        with self._lock, _Inside(self._inside):
            super().make_folder(path)
            if self._relative(path) is not None:
                self._made(path)

    def _moved(self, path: str, target: str) -> None:
        source, there = self._relative(path), self._relative(target)
        if source is None or there is None:
            return
        folder, target_folder = self.names.find(os.path.dirname(source)), self.names.find(os.path.dirname(there))  # noqa: PTH120
        inode = self.names.find(source)
        assert folder is not None, source
        assert target_folder is not None, there
        assert inode is not None, source
        self._note(Move(folder, os.path.basename(source), target_folder, os.path.basename(there), inode))  # noqa: PTH119

    # what goes past them ---------------------------------------------------------------------------------------

    def _heard(self, event: str, args: tuple[object, ...]) -> None:
        if not self._active or getattr(self._inside, "now", False):
            return
        if event == "open" and isinstance(args[0], str) and isinstance(args[2], int) and args[2] & _WRITING:
            relative = self._relative(args[0])
            if relative is not None:
                self.past.add(relative)
        elif event in ("os.remove", "os.rmdir", "os.mkdir", "os.rename"):
            with self._lock, _Inside(self._inside):
                self._heard_of_name(event, args)

    def _heard_of_name(self, event: str, args: tuple[object, ...]) -> None:
        folder_fd = args[-1] if event != "os.rename" else -1
        path = os.fspath(args[0])  # type: ignore[call-overload] - what the interpreter hands over
        if isinstance(folder_fd, int) and folder_fd >= 0:
            path = f"{os.readlink(f'/proc/self/fd/{folder_fd}')}/{path}"  # noqa: PTH115 - no link, a descriptor
        relative = self._relative(path)
        if relative is None:
            return
        inode = self.names.find(relative)
        if event == "os.rename":
            if inode is not None:
                self._moved(path, os.fspath(args[1]))  # type: ignore[call-overload]
        elif event == "os.mkdir":
            if inode is None and (parent := self.names.find(os.path.dirname(relative))) is not None:  # noqa: PTH120
                self._new_folder(parent, os.path.basename(relative))  # noqa: PTH119
        elif inode is not None:
            parent = self.names.find(os.path.dirname(relative))  # noqa: PTH120
            assert parent is not None
            self._note(Unlink(parent, os.path.basename(relative), inode))  # noqa: PTH119

    def _new_folder(self, parent: int, name: str) -> None:
        inode, self._next = self._next, self._next + 1
        self.is_folder.add(inode)
        self._note(Link(parent, name, inode))


class _Inside:
    """Within it, the hook does not hear this thread."""

    def __init__(self, flag: threading.local) -> None:
        self._flag = flag

    def __enter__(self) -> None:
        self._before = getattr(self._flag, "now", False)
        self._flag.now = True

    def __exit__(self, *_: object) -> None:
        self._flag.now = self._before
