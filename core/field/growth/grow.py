"""Growth: from valid points to their neighbours, best first, in waves large enough for the kernels.

A neighbour's patch, extended to the new point's ray, is its start value. A point that fails is tried again from other
neighbours. No value is interpolated: a point that does not match stays empty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.fitter import FitsPoints, PointFits
from stereorig.core.field.points.starts import move_matrix, move_w
from stereorig.core.field.region.visibility import Visibility
from stereorig.core.progress import CancelToken, Progress, no_progress, raise_if_cancelled
from stereorig.core.robust import MAD_TO_SIGMA, median
from stereorig.core.status import PointStatus

_OFFSETS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)])  # k and k ^ 2 are opposite
MAX_BATCH = 4096
"""Points fitted between two looks at the cancel token: a cancel takes effect within a second even on a slow machine."""
_ALL_AT_ONCE = 512
_FAR_PX = 3.0
_COUNT_AGAIN = 1.05
ATTEMPTS = 4
"""Starts of a point at most, each from another neighbour."""


def fit_in_batches(
    fitter: FitsPoints,
    points: PointFits,
    index: NDArray[np.intp],
    xy_px: Float,
    w: Float,
    G: Float | None,
    *,
    far_px: float,
    report: Callable[[int], None] | None = None,
    cancel: CancelToken | None = None,
) -> Bool:
    """Fit the points ``index`` from starts and store the results; return (m,) True for the valid ones.

    A fit that ends further than ``far_px`` from its start has left the basin it was started in. ``report`` is called
    with the number of points fitted so far.
    """
    good = np.zeros(len(index), bool)
    for first in range(0, len(index), MAX_BATCH):
        raise_if_cancelled(cancel)
        part = slice(first, first + MAX_BATCH)
        xy, start_w, start_G = xy_px[index[part]], w[part], None if G is None else G[part]
        fits = fitter.fit(xy, start_w, start_G)
        fits.reject(fits.ok & fitter.far_from_start(xy, fits, start_w, start_G, far_px), PointStatus.NOT_CONVERGED)
        points.put(index[part], fits)
        good[part] = fits.ok
        if report is not None:
            report(min(first + MAX_BATCH, len(index)))
    return good


@dataclass(eq=False)
class Attempts:
    """Starts already tried on a grid of n points, so that none is repeated.

    Attributes
    ----------
    neighbours
        (n, 8) index of each point's neighbours, -1 outside the grid and for neighbours across a cut.
    tried
        (n, 8) True for those from which the point was started before.
    left
        (n,) number of starts left.
    """

    neighbours: NDArray[np.int32]
    tried: Bool
    left: NDArray[np.int8]

    @staticmethod
    def on(shape: tuple[int, int], visibility: Visibility | None = None) -> Attempts:
        """Return the attempts of a grid of (rows, cols) before any start."""
        n = shape[0] * shape[1]
        index_of = np.full((shape[0] + 2, shape[1] + 2), -1, np.int32)
        index_of[1:-1, 1:-1] = np.arange(n, dtype=np.int32).reshape(shape)
        rows, cols = slice(1, -1), slice(1, -1)
        neighbours = np.stack(
            [np.roll(index_of, (-dr, -dc), (0, 1))[rows, cols].ravel() for dr, dc in _OFFSETS], axis=1
        )
        if visibility is not None:
            for k, (dr, dc) in enumerate(_OFFSETS):
                neighbours[visibility.separated_at(int(dr), int(dc)), k] = -1
        return Attempts(neighbours, np.zeros(neighbours.shape, bool), np.full(n, ATTEMPTS, np.int8))

    def renew(self, which: Bool) -> None:
        """Forget the starts of the points ``which`` (n,), since new seeds are near them."""
        self.tried[which] = False
        self.left[which] = ATTEMPTS


def grow(
    fitter: FitsPoints,
    points: PointFits,
    *,
    attempts: Attempts,
    xy_px: Float,
    rays: Float,
    usable: Bool,
    phase: str = "grow",
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> int:
    """Grow from the valid points over all usable ones.

    Parameters
    ----------
    fitter
        The matcher.
    points
        n points of a grid; changed in place.
    attempts
        Starts already tried; changed in place.
    xy_px, rays
        (n, 2) px, (n, 3) normalised.
    usable
        (n,) True where a point may be measured.
    phase, progress, cancel
        Name of the phase in progress reports, their receiver, and the means to stop.

    Returns
    -------
    int
        Number of points added.

    Notes
    -----
    A wave covers the front only: open points that may have a valid neighbour. So the work grows with the number of
    points, not with points times waves.
    """
    total = int(usable.sum())
    quality = points.quality
    valid, counted, added = int((quality > 0.0).sum()), 0, 0
    min_quality, front = 0.0, np.zeros(len(quality), bool)
    while valid > 0:
        raise_if_cancelled(cancel)
        progress(phase, valid, total)
        if valid > _COUNT_AGAIN * counted:  # the field's statistics change with its size
            min_quality, counted = min_parent_zncc(quality), valid
            front = usable & (quality <= 0.0) & (attempts.left > 0)
        todo = np.flatnonzero(front)
        near = attempts.neighbours[todo]
        score = np.where((near >= 0) & ~attempts.tried[todo], quality[near], -1.0)
        score[score < min_quality] = -1.0
        choice = np.argmax(score, axis=1)
        best = np.take_along_axis(score, choice[:, None], axis=1)[:, 0]
        reachable = best > 0.0
        front[todo[~reachable]] = False  # until a neighbour becomes valid
        if not reachable.any():
            if valid == counted:
                break
            counted = 0
            continue
        todo, choice, best = todo[reachable], choice[reachable], best[reachable]
        if len(todo) > _ALL_AT_ONCE:
            leading = best >= np.quantile(best, 0.5)
            todo, choice = todo[leading], choice[leading]
        parent = attempts.neighbours[todo, choice]
        attempts.tried[todo, choice] = True
        attempts.left[todo] -= 1
        offset = rays[todo, :2] - rays[parent, :2]
        parent_w, parent_G = points.w[parent], points.G[parent]
        if fitter.terms > 3:
            # second-order terms reach further, their noise too: every other attempt goes without
            flat = attempts.left[todo] % 2 == 0
            parent_w[flat, 3:], parent_G[flat, :, 3:] = 0.0, 0.0
        w = move_w(parent_w, offset)
        G = move_matrix(parent_G, offset) if fitter.comparisons == 3 else None
        good = fit_in_batches(fitter, points, todo, xy_px, w, G, far_px=_FAR_PX, cancel=cancel)
        front[todo[good | (attempts.left[todo] <= 0)]] = False
        new = todo[good]
        quality[new] = points.zncc[new].min(axis=1)
        beside, side = attempts.neighbours[new], np.arange(len(_OFFSETS)) ^ 2  # seen from the neighbour
        inside = beside >= 0
        beside, side = beside[inside], np.broadcast_to(side, inside.shape)[inside]
        attempts.tried[beside, side] = False  # a point that was valid there before, and was rejected, had other values
        front[beside[usable[beside] & (quality[beside] <= 0.0) & (attempts.left[beside] > 0)]] = True
        added += len(new)
        valid += len(new)
    return added


def min_parent_zncc(quality: Float) -> float:
    """Smallest correlation of a point whose values start a neighbour: not far below the field's own."""
    valid = quality[quality > 0.0]
    middle = median(valid)
    sigma = MAD_TO_SIGMA * median(np.abs(valid - middle))
    return middle - max(0.15, 8.0 * sigma)
