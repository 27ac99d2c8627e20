"""Grids of dots from their blobs: numbered by growing a lattice, so that clutter, gaps and a cut grid are seen as such.

A lattice grows from one dot to its neighbours, each step taken over from the one before, so that perspective and lens
change it slowly. The numbers of its dots are then turned, and sheared where a strong tilt makes a diagonal the shortest
step, until they fill the rectangle described.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.boards.board import BoardTarget

Numbers = NDArray[np.intp]

_NEAR = 0.3  # share of the shorter step, between a neighbour and its prediction
_LEAST_CROSSING = 0.5  # sine of the angle of the first two steps
_LEAST_DOTS = 9
_SEEDS = 12
_LEAST_FILL = 0.9
_EDGE_FILL = 0.4  # least share of filled places in a first or last row or column of the grid
_BASES = tuple(
    np.array(m) for m in ([[1, 0], [0, 1]], [[1, 1], [0, 1]], [[1, -1], [0, 1]], [[1, 0], [1, 1]], [[1, 0], [-1, 1]])
)
_TURN = np.array([[0, 1], [-1, 0]])


@dataclass(frozen=True)
class DotLattice:
    """Blobs numbered by two steps, the second clockwise of the first in the image.

    Attributes
    ----------
    member
        (n,) indices of the blobs.
    number
        (n, 2).
    """

    member: Numbers
    number: Numbers


def grow(centres: Float) -> DotLattice | None:
    """Number the largest lattice among blobs (n, 2)."""
    if len(centres) < _LEAST_DOTS:
        return None
    tree = cKDTree(centres)
    middle = np.median(centres, axis=0)
    order = np.argsort(np.linalg.norm(centres - middle, axis=1))
    best: DotLattice | None = None
    tried = np.zeros(len(centres), dtype=bool)
    seeds = 0
    for seed in order:
        if tried[seed] or seeds >= _SEEDS:
            continue
        seeds += 1
        tried[seed] = True
        lattice = _grow_from(centres, tree, int(seed))
        if lattice is None:
            continue
        tried[lattice.member] = True
        if best is None or len(lattice.member) > len(best.member):
            best = lattice
        if len(best.member) > 0.5 * len(centres):
            break
    return best


def _grow_from(centres: Float, tree: cKDTree, seed: int) -> DotLattice | None:
    steps = _first_steps(centres, tree, seed)
    if steps is None:
        return None
    number: dict[int, tuple[int, int]] = {seed: (0, 0)}
    taken: dict[tuple[int, int], int] = {(0, 0): seed}
    local: dict[int, Float] = {seed: steps}
    queue = deque([seed])
    while queue:
        k = queue.popleft()
        e = local[k]
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            i, j = number[k]
            to = (i + sign, j) if axis == 0 else (i, j + sign)
            if to in taken:
                continue
            distance, found = (v.item() for v in map(np.asarray, tree.query(centres[k] + sign * e[axis])))
            if found in number or distance > _NEAR * min(np.linalg.norm(e[0]), np.linalg.norm(e[1])):
                continue
            number[found], taken[to] = to, found
            mine = e.copy()
            mine[axis] = sign * (centres[found] - centres[k])
            # the other step, from a neighbour of the same row or column that is numbered already
            for s in (1, -1):
                beside = (to[0], to[1] + s) if axis == 0 else (to[0] + s, to[1])
                if beside in taken:
                    mine[1 - axis] = s * (centres[taken[beside]] - centres[found])
                    break
            local[found] = mine
            queue.append(found)
    if len(number) < _LEAST_DOTS:
        return None
    return DotLattice(np.array(list(number), dtype=np.intp), np.array(list(number.values()), dtype=np.intp))


def _first_steps(centres: Float, tree: cKDTree, seed: int) -> Float | None:
    count = min(9, len(centres))
    distance, found = (np.asarray(v) for v in tree.query(centres[seed], k=count))
    if distance[1] <= 0.0:
        return None
    first = centres[found[1]] - centres[seed]
    for k in range(2, count):
        second = centres[found[k]] - centres[seed]
        cross = (first[0] * second[1] - first[1] * second[0]) / (np.linalg.norm(first) * np.linalg.norm(second))
        if distance[k] > 2.5 * distance[1]:
            break
        if abs(cross) > _LEAST_CROSSING:
            return np.stack([first, second if cross > 0.0 else -second])
    return None


@dataclass(frozen=True)
class Arranged:
    """A lattice assigned to the rows and columns of a description, in every right-handed way that fits.

    Attributes
    ----------
    ways
        (columns, rows) indices of the blobs for each way, -1 for a missing blob.
    mirrored
        True if only a mirrored picture of the grid fits.
    counts
        Columns and rows that the lattice itself spans.
    fill
        Share of their places at which there is a dot.
    """

    ways: tuple[Numbers, ...]
    mirrored: bool
    counts: tuple[int, int]
    fill: float


def arrange(lattice: DotLattice, target: BoardTarget) -> Arranged:
    """Assign the dots of a lattice to the rows and columns of a description."""
    asymmetric = target.kind == "circles_asymmetric"
    ways: list[Numbers] = []
    mirrored = False
    counts = (0, 0)
    fullest = -1.0
    for basis in _BASES:
        numbers = lattice.number @ basis
        if asymmetric:  # X = a - b, Y = a + b
            numbers = np.stack([numbers[:, 0] - numbers[:, 1], numbers[:, 0] + numbers[:, 1]], axis=-1)
        for turn in range(4):
            turned = numbers @ np.linalg.matrix_power(_TURN, turn)
            turned, member = _trimmed(turned, lattice.member, asymmetric)
            span = turned.max(axis=0) + 1
            fill = len(member) / (np.prod(span) / (2.0 if asymmetric else 1.0))
            # the rectangle that the dots fill best is the grid's own; of its turns, the longer side along X
            size = (int(np.ceil(span[0] / 2)), int(span[1])) if asymmetric else (int(span[0]), int(span[1]))
            whole = not asymmetric or span[0] % 2 == 0  # its rows hold as many dots each
            if not whole:
                continue
            if fill > fullest + 1e-9 or (fill > fullest - 1e-9 and size[0] > counts[0]):
                fullest, counts = fill, size
            way, other_row = _laid(turned, member, target, asymmetric)
            if way is not None:
                ways.append(way)
            mirrored |= other_row
        if ways:
            break
    return Arranged(tuple(ways), mirrored and not ways, counts, fullest)


def turned_numbers(lattice: DotLattice) -> Iterator[Numbers]:
    """Yield a lattice's numbers (n, 2), from zero, in every right-handed way of counting them."""
    for basis in _BASES:
        for turn in range(4):
            numbers = lattice.number @ basis @ np.linalg.matrix_power(_TURN, turn)
            yield numbers - numbers.min(axis=0)


def _trimmed(numbers: Numbers, member: Numbers, asymmetric: bool) -> tuple[Numbers, Numbers]:
    """Remove first and last rows and columns of few dots: other blobs that happen to fit the lattice."""
    while True:
        numbers = numbers - numbers.min(axis=0)
        span = numbers.max(axis=0) + 1
        keep: Bool = np.ones(len(numbers), dtype=bool)
        for axis, other in ((0, 1), (1, 0)):
            full = span[other] / (2.0 if asymmetric else 1.0)
            for end in (0, span[axis] - 1):
                there = numbers[:, axis] == end
                if there.sum() < _EDGE_FILL * full - 0.5:
                    keep &= ~there
        if keep.all() or keep.sum() < _LEAST_DOTS:
            return numbers, member
        numbers, member = numbers[keep], member[keep]


def _laid(numbers: Numbers, member: Numbers, target: BoardTarget, asymmetric: bool) -> tuple[Numbers | None, bool]:
    columns, rows = target.size
    span = numbers.max(axis=0) + 1
    wanted = (2 * columns, rows) if asymmetric else (columns, rows)
    if tuple(int(n) for n in span) != wanted:
        return None, False
    i, j = numbers.T
    if asymmetric:
        if ((i - j) % 2 != 0).all():
            return None, True  # the first row begins where the second should: seen from behind, or in a mirror
        if ((i - j) % 2 != 0).any():
            return None, False
        i = (i - j % 2) // 2
    if len(member) < _LEAST_FILL * columns * rows:
        return None, False
    way = np.full((columns, rows), -1, dtype=np.intp)
    way[i, j] = member
    return way, False


def missing_positions(centres: Float, way: Numbers, target: BoardTarget) -> Float:
    """Return (columns, rows, 2) of the blobs laid out, and where dots are missing the mean of opposite neighbours."""
    xy = np.where((way >= 0)[..., None], centres[np.maximum(way, 0)], np.nan)
    step = 2 if target.kind == "circles_asymmetric" else 1
    for i, j in zip(*np.nonzero(way < 0), strict=True):
        guesses = []
        for di, dj in ((1, 0), (0, step)):
            a, b = (i - di, j - dj), (i + di, j + dj)
            if all(0 <= p[k] < xy.shape[k] for p in (a, b) for k in (0, 1)):
                guesses.append(0.5 * (xy[a] + xy[b]))
        known = [g for g in guesses if np.isfinite(g).all()]
        if known:
            xy[i, j] = np.mean(known, axis=0)
            continue
        for di, dj in ((1, 0), (-1, 0), (0, step), (0, -step)):  # at the border, going on from two dots
            a, b = (i + di, j + dj), (i + 2 * di, j + 2 * dj)
            if all(0 <= p[k] < xy.shape[k] for p in (a, b) for k in (0, 1)) and np.isfinite(xy[a]).all():
                xy[i, j] = 2.0 * xy[a] - xy[b]
                break
    return np.asarray(xy)
