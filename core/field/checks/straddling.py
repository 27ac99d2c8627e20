"""Subsets that lie on two faces: found by the halves of the subset, which then disagree.

A patch that straddles a step or a ridge averages both faces, and its residuals need not show it. Where the shape bends
or jumps between points a subset apart, more than the field does elsewhere, the points about are measured again with
halves of their subset. On one face every half finds what the whole does, but for its noise.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.field.points.fitter import Fitter, PointFits
from core.field.points.starts import depth_per_px
from core.matching.arguments import VisiblePixels
from core.matching.fit import fit_shape
from core.progress import CancelToken, raise_if_cancelled
from core.robust import MAD_TO_SIGMA, spread_indices
from core.status import PointStatus

_FLOOR_PX = 0.1
_SIGMAS = 8.0
_PAIRS = 4000  # for the scatter of the pairs of one offset
_MIN_PAIRS = 12
_HALF_SIGMAS = 5.0  # of the difference of half and whole, that varies about as much as the half itself
_AT_ONCE = 2048


def reject_straddling(
    fitter: Fitter,
    points: PointFits,
    *,
    shape: tuple[int, int],
    xy_px: Float,
    rays: Float,
    spacing_px: float,
    cancel: CancelToken | None = None,
) -> int:
    """Reject the points of a shape, NEIGHBOUR_MISMATCH, whose subset lies on two faces; return their number.

    Parameters
    ----------
    fitter, points
        The matcher of a shape, and n = rows x columns points, changed in place.
    shape
        Rows and columns.
    xy_px, rays
        (n, 2) px of camera 1, and (n, 3) normalised.
    spacing_px
        Distance of neighbouring points.
    cancel
        Stops the work.
    """
    suspect = _beside_edges(fitter, points, shape, rays, spacing_px)
    if fitter.visibility is not None:  # those at drawn cuts are cut already
        suspect &= fitter.visibility.whole
    index = np.flatnonzero(suspect & points.ok)
    rejected = 0
    for start in range(0, len(index), _AT_ONCE):
        raise_if_cancelled(cancel)
        some = index[start : start + _AT_ONCE]
        bad = np.zeros(len(points.status), bool)
        bad[some] = _halves_disagree(fitter, points, some, xy_px)
        points.reject(bad, PointStatus.NEIGHBOUR_MISMATCH)
        rejected += int(bad.sum())
    return rejected


def half_subsets(subset_px: int) -> NDArray[np.uint8]:
    """Return (8, subset, subset) the halves of a subset, four along its sides and four along its diagonals."""
    y, x = np.mgrid[:subset_px, :subset_px] - subset_px // 2
    return np.array([x <= 0, x >= 0, y <= 0, y >= 0, x + y <= 0, x + y >= 0, x - y <= 0, x - y >= 0]).astype(np.uint8)


def _beside_edges(fitter: Fitter, points: PointFits, shape: tuple[int, int], rays: Float, spacing_px: float) -> Bool:
    """Return (n,) True within a subset of where the shape between two points is not that of one smooth surface.

    On a surface that bends evenly the depth between two points changes by the mean of their slopes.
    """
    rows, cols = shape
    ok = points.ok.reshape(shape)
    flagged = np.zeros(shape, np.uint8)
    valid = np.flatnonzero(points.ok)
    if len(valid) < _MIN_PAIRS:
        return flagged.ravel() > 0
    w0 = points.w[:, 0].reshape(shape)
    slope = points.w[:, 1:3].reshape(rows, cols, 2)
    per_px = np.full(shape, np.nan)
    per_px.ravel()[valid] = depth_per_px(fitter.pair, rays[valid], points.w[valid, 0])
    ray = rays[:, :2].reshape(rows, cols, 2)
    subset = fitter.options.subset_px
    for reach in sorted({max(1, round(f * subset / spacing_px)) for f in (0.5, 1.0)}):
        for dr, dc in ((0, reach), (reach, 0), (reach, reach), (reach, -reach)):
            if dr >= rows or abs(dc) >= cols:
                continue
            here = (slice(0, rows - dr), slice(max(-dc, 0), cols - max(dc, 0)))
            there = (slice(dr, rows), slice(max(dc, 0), cols + min(dc, 0)))
            both = ok[here] & ok[there]
            a, b = (tuple(s.ravel()[both.ravel()] for s in (w0[k], per_px[k])) for k in (here, there))
            if len(a[0]) < _MIN_PAIRS:
                continue
            step = (ray[there] - ray[here])[both]
            mean = 0.5 * (slope[there] + slope[here])[both]
            off = (b[0] - a[0] - (mean * step).sum(axis=1)) / a[1]
            some = off[spread_indices(len(off), _PAIRS)] if len(off) > _PAIRS else off
            middle = float(np.median(some))
            sigma = MAD_TO_SIGMA * float(np.median(np.abs(some - middle)))
            bad = np.flatnonzero(np.abs(off - middle) > _FLOOR_PX + _SIGMAS * sigma)
            if len(bad):
                r, c = (k[bad] for k in np.nonzero(both))
                flagged[r + (dr + 1) // 2, c + max(-dc, 0) + dc // 2] = 1
    if not flagged.any():
        return flagged.ravel() > 0
    width = 2 * int(np.ceil(subset / spacing_px)) + 1
    return np.asarray(cv2.dilate(flagged, np.ones((width, width), np.uint8))).ravel() > 0


def _halves_disagree(fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float) -> Bool:
    """Return (m,) True where a half of the subset finds another depth than the whole."""
    halves = half_subsets(fitter.options.subset_px)
    own, variance = points.w[index], points.covariance[index, 0, 0]
    worst = np.zeros(len(index))
    for k in range(len(halves)):
        part = VisiblePixels(halves, np.full(len(index), k, np.int32))
        fits = fit_shape(fitter.pair, fitter.ref1, fitter.ref2, xy_px[index], own, fitter.options, part)
        found = fits.status == PointStatus.OK
        # the whole is the efficient estimate: their difference varies by the difference of the variances
        spread = np.maximum(fits.covariance[:, 0, 0] - variance, 0.5 * fits.covariance[:, 0, 0])
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.abs(fits.w[:, 0] - own[:, 0]) / np.sqrt(spread)
        worst = np.where(found, np.fmax(worst, t), worst)
    return np.asarray(worst > _HALF_SIGMAS)
