"""What a file system may hold after power was lost: every state that POSIX leaves open after so many recorded changes.

A file's content counts as written only once the file was synced; until then it may be gone, torn, zeros or all there.
A change of a folder's names (a new name, a rename, a removal) counts only once a folder that it concerns was synced;
until then each may be there or not, independently of the others and in any order. A rename is one change: its old name
goes when its new one comes, as in every file system with a journal.
"""

from __future__ import annotations

import hashlib
import itertools
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from tests.support.power_loss.journal import EMPTY, Change, Content, Link, Move, Names, Sync, Unlink

Entry = Link | Move | Unlink
Tree = Mapping[str, str | None]
_ALL = 64


@dataclass
class PowerLoss:
    """Takes changes one by one; at any time it gives the states in which the disk may be found.

    Parameters
    ----------
    is_folder
        The inodes that are folders.
    blobs
        Contents by their key; torn ones are added.
    """

    is_folder: set[int]
    blobs: dict[str, bytes]
    _base: Names = field(default_factory=Names)
    _open: list[tuple[Entry, bool]] = field(default_factory=list)  # with whether it is durable
    _unsynced: dict[int, str] = field(default_factory=dict)

    def take(self, change: Change) -> None:
        """Let a change happen."""
        match change:
            case Content(inode, blob):
                self._unsynced[inode] = blob
            case Sync(inode):
                if inode in self._unsynced:
                    self._base.blobs[inode] = self._unsynced.pop(inode)
                if inode in self.is_folder:
                    self._settle(inode)
            case _:
                self._open.append((change, False))

    def _settle(self, folder: int) -> None:
        self._open = [(entry, durable or folder in _folders_of(entry)) for entry, durable in self._open]
        gone = {e.inode for e, durable in self._open if durable and isinstance(e, Unlink) and e.inode in self.is_folder}
        # in a folder that is gone for good, nothing is open any more
        self._open = [(e, durable) for e, durable in self._open if durable or not _folders_of(e) <= gone]
        while self._open and self._open[0][1]:
            self._base.apply(self._open.pop(0)[0])

    @property
    def undecided(self) -> int:
        """Number of changes that may be there or not."""
        return sum(not durable for _, durable in self._open) + len(self._unsynced)

    def states(self, rng: random.Random, most: int) -> Iterator[Tree]:
        """Yield states that differ: all of them where there are few, else the extremes and a sample.

        Parameters
        ----------
        rng
            Draws the sample.
        most
            Number of states after which it stops.
        """
        loose = [i for i, (_, durable) in enumerate(self._open) if not durable]
        seen: set[frozenset[tuple[str, str | None]]] = set()
        for kept in _choices(len(loose), rng, 4 * most):
            names = Names({f: dict(n) for f, n in self._base.folders.items()}, dict(self._base.blobs))
            drop = {i for i, keep in zip(loose, kept, strict=True) if not keep}
            for i, (entry, _) in enumerate(self._open):
                if i not in drop:
                    names.apply(entry)
            for contents in self._contents(rng):
                names.blobs |= contents
                tree = names.tree(self.is_folder)
                mark = frozenset(tree.items())
                if mark not in seen:
                    seen.add(mark)
                    yield tree
                    if len(seen) >= most:
                        return

    def _contents(self, rng: random.Random) -> Iterator[dict[int, str]]:
        inodes = list(self._unsynced)
        ways = [
            (EMPTY, self._torn(self._unsynced[i]), self._zeros(self._unsynced[i]), self._unsynced[i]) for i in inodes
        ]
        if len(inodes) <= 2:
            yield from (dict(zip(inodes, way, strict=True)) for way in itertools.product(*ways))
            return
        for index in range(len(ways[0])):
            yield {i: way[index] for i, way in zip(inodes, ways, strict=True)}
        for _ in range(_ALL):
            yield {i: rng.choice(way) for i, way in zip(inodes, ways, strict=True)}

    def _torn(self, blob: str) -> str:
        return self._kept(self.blobs[blob][: len(self.blobs[blob]) // 2])

    def _zeros(self, blob: str) -> str:
        return self._kept(bytes(len(self.blobs[blob])))

    def _kept(self, data: bytes) -> str:
        key = hashlib.sha256(data).hexdigest()
        self.blobs[key] = data
        return key


def _folders_of(entry: Entry) -> set[int]:
    return {entry.folder, entry.target} if isinstance(entry, Move) else {entry.folder}


def _choices(n: int, rng: random.Random, most: int) -> Iterator[Sequence[bool]]:
    """Yield which of n changes are kept: every choice where there are few, else extremes and a sample."""
    if 2**n <= _ALL:
        yield from itertools.product((True, False), repeat=n)
        return
    yield [True] * n
    yield [False] * n
    for i in range(n):
        yield [j != i for j in range(n)]
        yield [j == i for j in range(n)]
        yield [j < i for j in range(n)]
    for _ in range(most):
        share = rng.random()
        yield [rng.random() < share for _ in range(n)]
