"""Groups of points of a grid that are connected through neighbours, none across a cut."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stereorig.core.arrays import Bool
from stereorig.core.field.region.visibility import Visibility

Indices = NDArray[np.intp]


def neighbour_pairs(ok: Bool, shape: tuple[int, int], visibility: Visibility | None) -> tuple[Indices, Indices]:
    """Return the indices (m,), (m,) of the pairs of neighbouring points of which both are ``ok`` and see each other."""
    rows, cols = shape
    index = np.arange(rows * cols).reshape(shape)
    first, second = [], []
    for dr, dc in ((0, 1), (1, -1), (1, 0), (1, 1)):
        here = index[: rows - dr, max(-dc, 0) : cols - max(dc, 0)].ravel()
        there = here + dr * cols + dc
        together = ok[here] & ok[there]
        if visibility is not None:
            together &= ~visibility.separated_at(dr, dc)[here]
        first.append(here[together])
        second.append(there[together])
    return np.concatenate(first), np.concatenate(second)


def connected(n: int, first: Indices, second: Indices) -> NDArray[np.int32]:
    """Label (n,) the groups of points that pairs connect; a point in no pair is a group of its own."""
    graph = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(n, n))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int32)
