"""Growth of a large field in two passes: over a coarse part of its points, then all others from the nearest of those.

Growth goes wave by wave, each from the values of the one before, so that it cannot be shared out. Points a subset's
width apart are few; from them all others start at once, each by itself. Points that do not match from there are left to
growth over all.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.field.growth.grow import Attempts, fit_in_batches, grow, min_parent_zncc
from stereorig.core.field.growth.state import SAMPLE_FAR_PX, FieldInputs, GrowthState
from stereorig.core.field.points.starts import move_matrix, move_w
from stereorig.core.progress import raise_if_cancelled

Index = NDArray[np.intp]

_REACH_SUBSETS = 1.5
_PARENTS = 4  # the nearest ones; the first that no cut separates counts


def is_large(inputs: FieldInputs) -> bool:
    """Return True if a field is measured in two passes: it has many points, several of them across a subset."""
    return _every(inputs) > 1 and int(inputs.usable.sum()) >= inputs.options.coarse_from


def grow_coarse_first(inputs: FieldInputs, state: GrowthState) -> None:
    """Grow from the seeds over a coarse part of the points, then measure the others from those."""
    points, every = state.points, _every(inputs)
    rows, cols = inputs.grid.shape
    lattice = np.arange(rows * cols).reshape(rows, cols)[every // 2 :: every, every // 2 :: every]
    coarse = lattice.ravel()
    inputs.progress("grow", 0, int(inputs.usable.sum()))
    _from_nearest(inputs, state, coarse)
    part = points.take(coarse)
    grow(
        state.fitter,
        part,
        attempts=_coarse_attempts(inputs, lattice),
        xy_px=inputs.xy_px[coarse],
        rays=inputs.rays[coarse],
        usable=inputs.usable[coarse],
        cancel=inputs.cancel,
    )
    points.put(coarse, part)
    raise_if_cancelled(inputs.cancel)
    _from_nearest(inputs, state, np.arange(len(inputs.xy_px)))


def _every(inputs: FieldInputs) -> int:
    return int(inputs.options.subset_px // inputs.grid.spacing_px)


def _coarse_attempts(inputs: FieldInputs, lattice: Index) -> Attempts:
    """Return the attempts on a coarse part of the grid; points with a cut between them are no neighbours."""
    attempts = Attempts.on((lattice.shape[0], lattice.shape[1]))
    if inputs.visibility is not None:
        at = lattice.ravel()
        for k in range(attempts.neighbours.shape[1]):
            own = np.flatnonzero(attempts.neighbours[:, k] >= 0)
            other = at[attempts.neighbours[own, k]]
            cut = inputs.visibility.are_separated(inputs.xy_px[at[own]], inputs.xy_px[other])
            attempts.neighbours[own[cut], k] = -1
    return attempts


def _from_nearest(inputs: FieldInputs, state: GrowthState, index: Index) -> None:
    """Fit the points ``index`` that are not valid, each from the nearest valid one in reach."""
    points, xy = state.points, inputs.xy_px
    quality = points.quality
    if not (quality > 0.0).any():
        return
    sources = np.flatnonzero((quality > 0.0) & (quality >= min_parent_zncc(quality)))
    todo = index[inputs.usable[index] & ~points.ok[index]]
    todo, parent = _parents(inputs, sources, todo)
    offset = inputs.rays[todo, :2] - inputs.rays[parent, :2]
    w = move_w(points.w[parent], offset)
    G = move_matrix(points.G[parent], offset) if state.fitter.comparisons == 3 else None
    valid, total = int(points.ok.sum()), int(inputs.usable.sum())
    fit_in_batches(
        state.fitter,
        points,
        todo,
        xy,
        w,
        G,
        far_px=SAMPLE_FAR_PX,
        report=lambda done: inputs.progress("grow", min(valid + done, total), total),
        cancel=inputs.cancel,
    )


def _parents(inputs: FieldInputs, sources: Index, todo: Index) -> tuple[Index, Index]:
    """Return the points that have one of ``sources`` in reach, and the nearest one that no cut separates from each."""
    xy = inputs.xy_px
    reach = _REACH_SUBSETS * inputs.options.subset_px
    count = min(_PARENTS if inputs.visibility is not None else 1, len(sources))
    found_at = cKDTree(xy[sources]).query(xy[todo], k=[*range(1, count + 1)], distance_upper_bound=reach)
    distance, near = (np.asarray(a) for a in found_at)
    parent = np.full(len(todo), -1, np.intp)
    for k in range(count):
        open_ = np.flatnonzero((parent < 0) & np.isfinite(distance[:, k]))
        candidate = sources[near[open_, k]]
        if inputs.visibility is not None:
            seen = ~inputs.visibility.are_separated(xy[todo[open_]], xy[candidate])
            open_, candidate = open_[seen], candidate[seen]
        parent[open_] = candidate
    found = parent >= 0
    return todo[found], parent[found]
