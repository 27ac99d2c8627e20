"""Growth: from points that stand to their neighbours, best first, in waves that keep the kernels busy.

A neighbour's patch, extended to the new point's ray, is its start value. A point that fails is tried again from other
neighbours. Nothing is ever filled in: what does not match stays empty.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.field.fitter import Fitter, PointFits
from core.field.starts import move_matrix, move_w
from core.lens import Bool, Float
from core.progress import CancelToken, Progress, no_progress, raise_if_cancelled
from core.status import PointStatus

_OFFSETS = np.array([(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)])
_ALL_AT_ONCE = 512
_MOST_A_BATCH = 4096  # a cancel is heard within a second even on a slow machine
_FAR_PX = 3.0
_ATTEMPTS = 4


def fit_in_batches(
    fitter: Fitter,
    points: PointFits,
    index: NDArray[np.intp],
    xy_px: Float,
    w: Float,
    G: Float | None,
    *,
    far_px: float,
    cancel: CancelToken | None = None,
) -> NDArray[np.bool_]:
    """Fit the points ``index`` from starts and write down what came; returns which stand.

    A fit that ends further than ``far_px`` from its start has left the basin it was started in.
    """
    good = np.zeros(len(index), bool)
    for start in range(0, len(index), _MOST_A_BATCH):
        raise_if_cancelled(cancel)
        part = slice(start, start + _MOST_A_BATCH)
        xy = xy_px[index[part]]
        part_G = None if G is None else G[part]
        fits = fitter.fit(xy, w[part], part_G)
        fits.refuse(fits.ok & fitter.far_from_start(xy, fits, w[part], part_G, far_px), PointStatus.NOT_CONVERGED)
        points.put(index[part], fits)
        good[part] = fits.ok
    return good


def grow(
    fitter: Fitter,
    points: PointFits,
    *,
    shape: tuple[int, int],
    xy_px: Float,
    rays: Float,
    usable: Bool,
    stage: str = "grow",
    progress: Progress = no_progress,
    cancel: CancelToken | None = None,
) -> int:
    """Grow from the points that stand over all usable ones; returns how many were added.

    Parameters
    ----------
    fitter
        The matcher.
    points
        n = rows x columns points; changed in place.
    shape
        Rows and columns of the grid.
    xy_px, rays
        (n, 2) px, (n, 3) normalised.
    usable
        (n,) which points may be measured.
    stage, progress, cancel
        Reports and stop.
    """
    rows, cols = shape
    total = int(usable.sum())
    tried = np.zeros((rows * cols, len(_OFFSETS)), bool)
    attempts = np.zeros(rows * cols, np.int8)
    added = 0
    r, c = np.divmod(np.arange(rows * cols), cols)
    neighbours = np.full((rows * cols, len(_OFFSETS)), -1, np.intp)
    for k, (dr, dc) in enumerate(_OFFSETS):
        inside = (r + dr >= 0) & (r + dr < rows) & (c + dc >= 0) & (c + dc < cols)
        neighbours[inside, k] = ((r + dr) * cols + c + dc)[inside]

    while True:
        raise_if_cancelled(cancel)
        quality = points.quality
        progress(stage, int((quality > 0).sum()), total)
        todo = np.flatnonzero(usable & (quality <= 0.0) & (attempts < _ATTEMPTS))
        if len(todo) == 0:
            break
        parent_quality = np.where(_may_be_parent(quality), quality, -1.0)
        near = neighbours[todo]
        score = np.where((near >= 0) & ~tried[todo], parent_quality[near], -1.0)
        choice = np.argmax(score, axis=1)
        best = score[np.arange(len(todo)), choice]
        reachable = best > 0.0
        if not reachable.any():
            break
        todo, choice, best = todo[reachable], choice[reachable], best[reachable]
        if len(todo) > _ALL_AT_ONCE:
            leading = best >= np.quantile(best, 0.5)
            todo, choice = todo[leading], choice[leading]
        parent = neighbours[todo, choice]
        tried[todo, choice] = True
        attempts[todo] += 1
        offset = rays[todo, :2] - rays[parent, :2]
        w = move_w(points.w[parent], offset)
        G = move_matrix(points.G[parent], offset) if fitter.comparisons == 3 else None
        added += int(fit_in_batches(fitter, points, todo, xy_px, w, G, far_px=_FAR_PX, cancel=cancel).sum())
    return added


def _may_be_parent(quality: Float) -> Bool:
    """Points far below the field's own correlation do not hand their values on."""
    standing = quality[quality > 0.0]
    if len(standing) == 0:
        return np.zeros(len(quality), bool)
    middle = float(np.median(standing))
    scatter = 1.4826 * float(np.median(np.abs(standing - middle)))
    return np.asarray(quality >= middle - max(0.15, 8.0 * scatter))
