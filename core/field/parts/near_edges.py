"""Points next to an edge: within a subset of a place with a bend or jump of the shape or the motion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.scales import depth_per_px, px_per_ray
from stereorig.core.robust import MAD_TO_SIGMA, median, spread_indices

_FLOOR_PX = 0.05
_SIGMAS = 8.0
_PAIRS = 1000  # for the scatter of the pairs of one offset
_MIN_PAIRS = 12


def near_edges(fitter: Fitter, points: PointFits, shape: tuple[int, int], rays: Float, spacing_px: float) -> Bool:
    """Return (n,) True within a subset of a place whose shape or motion between two points is not that of one surface.

    On a surface that bends evenly the change between two points equals the mean of their slopes.

    Parameters
    ----------
    fitter, points
        The matcher, and n = rows x columns points with their results.
    shape
        Rows and columns.
    rays
        (n, 3) normalised.
    spacing_px
        Distance of neighbouring points.

    Returns
    -------
    Bool
        (n,).
    """
    rows, cols = shape
    flagged = np.zeros(shape, np.uint8)
    valid = np.flatnonzero(points.ok)
    if len(valid) < _MIN_PAIRS:
        return flagged.ravel() > 0
    ray = rays[:, :2].T.reshape(2, rows, cols)
    quantities = [_per_px(values, scale, valid, shape) for values, scale in _quantities(fitter, points, rays, valid)]
    subset = fitter.options.subset_px
    for reach in sorted({max(1, round(f * subset / spacing_px)) for f in (0.5, 1.0)}):
        for dr, dc in ((0, reach), (reach, 0), (reach, reach), (reach, -reach))[: 4 if fitter.comparisons == 1 else 2]:
            if dr >= rows or abs(dc) >= cols:
                continue
            here = (slice(0, rows - dr), slice(max(-dc, 0), cols - max(dc, 0)))
            there = (slice(dr, rows), slice(max(dc, 0), cols + min(dc, 0)))
            x, y = (one[there] - one[here] for one in ray)
            some = spread_indices(x.size, _PAIRS)
            for level, along_x, along_y, per_px in quantities:
                mean_x, mean_y = (0.5 * (slope[there] + slope[here]) for slope in (along_x, along_y))
                off = (level[there] - level[here] - (mean_x * x + mean_y * y)) / per_px[here]
                known = off.ravel()[some]
                known = known[np.isfinite(known)]
                if len(known) < _MIN_PAIRS:
                    continue
                middle = median(known)
                sigma = MAD_TO_SIGMA * median(np.abs(known - middle))
                with np.errstate(invalid="ignore"):
                    r, c = np.nonzero(np.abs(off - middle) > _FLOOR_PX + _SIGMAS * sigma)
                flagged[r + (dr + 1) // 2, c + max(-dc, 0) + dc // 2] = 1
    if not flagged.any():
        return flagged.ravel() > 0
    width = 2 * int(np.ceil(subset / spacing_px)) + 1
    return np.asarray(cv2.dilate(flagged, np.ones((width, width), np.uint8))).ravel() > 0


def _quantities(fitter: Fitter, points: PointFits, rays: Float, valid: NDArray[np.intp]) -> list[tuple[Float, Float]]:
    """Value and slopes (3, m) of each smooth quantity, and its change for a pixel of camera 2's or 1's image (m,)."""
    w = points.w[valid, :3].T.copy()
    per_px = depth_per_px(fitter.pair, rays[valid], w[0])
    if fitter.comparisons == 1:
        return [(w, per_px)]
    G = np.moveaxis(points.G[valid, :, :3], 0, -1).copy()
    depth = G[2, 0]
    one_px = 1.0 / px_per_ray(fitter.pair, rays[valid])[:, 0]
    place = [(G[k] - (G[k, 0] / depth) * G[2]) / depth for k in (0, 1)]
    for k in (0, 1):
        place[k][0] = G[k, 0] / depth
    now = w / depth - (w[0] / depth**2) * G[2]
    now[0] = w[0] / depth
    return [(place[0], one_px), (place[1], one_px), (now, per_px / depth)]


def _per_px(values: Float, scale: Float, valid: NDArray[np.intp], shape: tuple[int, int]) -> Float:
    """(4, r, c) value, its slopes along x and y, and its scale; NaN where a point has none."""
    out = np.full((4, shape[0] * shape[1]), np.nan)
    out[:3, valid], out[3, valid] = values, scale
    return out.reshape(4, *shape)
