"""Places of corners and dots from coarse ones: choice of pixels for each fit, and the conditions on a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.boards.board import BoardTarget
from stereorig.core.boards.kernels import CORNER, DOT, N_CORNER, N_DOT, N_GEOMETRY, fit_points
from stereorig.core.boards.view import neighbour_distances_px, steps_px

_REACH = 0.5  # share of the distance of neighbouring corners: each pixel belongs to one corner only
_MAX_REACH_PX = 60.0  # beyond, a lens bends an edge by more than a parabola
_MAX_MOVE = 0.25  # share of the distance of neighbouring corners, from the coarse corner
_LEAST_CROSSING = 0.15  # sine of the angle of the edges
_FIRST_BLUR_PX = 0.9
_RIM_BLURS, _RIM_PX = 4.0, 1.5  # about a dot's rim
_MISFIT = 3.0  # multiple of the other points' residuals
_MISFIT_SHARE = 0.06  # share of the contrast, that a good point's residuals may have
_LEAST_CONTRAST = 0.25  # share of the other points' contrast
# standard deviation of the ground's slope, as part of the contrast: of any lighting, a px, and about the slope that the
# neighbours' levels show, a distance of neighbours; a single dot separates its place from a slope poorly
_FREE_SLOPE, _KNOWN_SLOPE = 0.01, 0.0015
_PIXEL_VARIANCE = 1.0 / 12.0
_SETTLED_PX = (0.03, 1e-5)  # steps at which the first fit ends, and the second that starts from it


@dataclass(frozen=True)
class Refined:
    """Points fitted in an image.

    Attributes
    ----------
    xy_px, covariance_px2
        (columns, rows, 2) and (columns, rows, 2, 2), NaN where a point cannot be located.
    blur_px
        Median standard deviation of the lens's blur, without the pixel's own area.
    contrast, noise
        Medians of the step at an edge and of the residuals' standard deviation, grey levels.
    ellipse
        (columns, rows, 2, 2) M of each dot, whose rim is at ``|M d| = 1`` for d from its centre, 1/px; None for
        corners.
    """

    xy_px: Float
    covariance_px2: Float
    blur_px: float
    contrast: float
    noise: float
    ellipse: Float | None = None


def refine_corners(grey: Float32, coarse_px: Float, target: BoardTarget) -> Refined:
    """Fit each corner's crossed edges.

    Parameters
    ----------
    grey
        (rows, columns).
    coarse_px
        (columns, rows, 2), NaN where a corner was not seen.
    target
        The board.
    """
    shape = coarse_px.shape[:2]
    pitch = neighbour_distances_px(coarse_px, target)
    along_x, along_y = steps_px(coarse_px, 0), steps_px(coarse_px, 1)
    usable = np.isfinite(pitch) & np.isfinite(along_x).all(axis=-1) & np.isfinite(along_y).all(axis=-1)
    usable &= np.isfinite(coarse_px).all(axis=-1)
    if not usable.any():
        return _nothing(shape)
    first, ex, ey, step = coarse_px[usable], along_x[usable], along_y[usable], pitch[usable]
    light, sign = _levels(grey, first, ex, ey)
    start = np.zeros((len(first), N_CORNER))
    start[:, :2] = first
    start[:, 2], start[:, 3] = np.arctan2(ex[:, 1], ex[:, 0]), np.arctan2(ey[:, 1], ey[:, 0])
    start[:, 4], start[:, 5] = light.mean(axis=1), sign * 0.5 * np.maximum(light[:, 1] - light[:, 0], 1e-3)
    start[:, 6] = _FIRST_BLUR_PX
    geometry = np.zeros((len(first), N_GEOMETRY))
    geometry[:, :4] = np.linalg.inv(np.stack([ex, ey], axis=-1)).reshape(-1, 4)
    geometry[:, 4] = np.minimum(_REACH, _MAX_REACH_PX / step)
    half = int(np.clip(np.ceil(float(np.max(geometry[:, 4] * (np.abs(ex) + np.abs(ey)).max(axis=1)))), 3, 90))
    if target.kind == "charuco":
        geometry[:, 7:9] = _markers(target, ex, ey)
    geometry[:, 10] = _FREE_SLOPE
    fit = np.zeros((len(first), 0))
    places = coarse_px
    for settled_px in _SETTLED_PX:  # the second time about the corner found, so that its pixels are symmetric about it
        geometry[:, 5], geometry[:, 6] = (bends(places, axis)[usable] for axis in (0, 1))
        fit = fit_points(grey, CORNER, start, geometry, half, settled_px=settled_px)
        moved = np.linalg.norm(fit[:, :2] - first, axis=1)
        with np.errstate(invalid="ignore"):
            good = np.isfinite(fit).all(axis=1) & (moved < np.maximum(_MAX_MOVE * step, 1.0))
            good &= np.abs(np.sin(fit[:, 2] - fit[:, 3])) > _LEAST_CROSSING
        start = np.where(good[:, None], fit[:, :N_CORNER], start)
        places = coarse_px.copy()
        places[usable] = start[:, :2]
        level = np.full(shape, np.nan)
        alike = good & _alike(good, fit[:, 5], fit[:, -1])
        level[usable] = np.where(alike, start[:, 4], np.nan)
        start[:, 7:9] = slopes(places, level)[usable]
        level[usable] = np.where(alike, np.abs(start[:, 5]), np.nan)
        geometry[:, 11:13] = slopes(places, level)[usable] / np.abs(start[:, [5]])
        geometry[:, 10] = _KNOWN_SLOPE / step
    good &= _alike(good, fit[:, 5], fit[:, -1])
    return _refined(shape, usable, fit, N_CORNER, good, blur=fit[:, 6], contrast=2.0 * np.abs(fit[:, 5]))


def refine_dots(
    grey: Float32, coarse_px: Float, moments_px2: Float, target: BoardTarget, hollow: Bool | None = None
) -> Refined:
    """Fit each dot's rim, a hollow dot's outer one.

    Parameters
    ----------
    grey
        (rows, columns).
    coarse_px, moments_px2
        (columns, rows, 2) and (columns, rows, 2, 2) of each dot's outline.
    target
        The board.
    hollow
        (columns, rows) True for dots whose middle is not of their own colour.
    """
    shape = coarse_px.shape[:2]
    known = np.isfinite(coarse_px).all(axis=-1).ravel()
    xy0 = np.where(known[:, None], coarse_px.reshape(-1, 2), 0.0)
    pitch = np.where(known, neighbour_distances_px(coarse_px, target).ravel(), np.nan)
    pitch = np.where(np.isfinite(pitch), pitch, np.nanmedian(pitch))
    # a uniform ellipse has second moments of a quarter of its squared axes: M = (4 moments)^(-1/2)
    values, vectors = np.linalg.eigh(4.0 * moments_px2.reshape(-1, 2, 2))
    axes = np.sqrt(np.maximum(values, 0.25))
    matrix = np.einsum("nij,nj,nkj->nik", vectors, 1.0 / axes, vectors)
    ring = np.zeros(len(xy0), dtype=bool) if hollow is None else hollow.ravel()
    start = np.zeros((len(xy0), N_DOT))
    start[:, :2] = xy0
    start[:, 2], start[:, 3], start[:, 4] = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    start[:, 5], inside = _rim_levels(grey, xy0, matrix, ring)
    start[:, 6] = inside - start[:, 5]
    start[:, 7] = _FIRST_BLUR_PX
    geometry = np.zeros((len(xy0), N_GEOMETRY))
    geometry[:, 10] = _FREE_SLOPE
    half = int(np.clip(np.ceil(np.nanmax(axes[:, 1]) + _RIM_BLURS * 2.0 + _RIM_PX + 1.0), 4, 400))
    blur = np.full(len(xy0), _FIRST_BLUR_PX)
    fit = np.zeros((len(xy0), 0))
    for settled_px in _SETTLED_PX:
        band = _RIM_BLURS * blur + _RIM_PX
        # half of the way to the next dot's rim outside; inside, the middle, or half of a ring's width
        geometry[:, 1] = np.minimum(band, np.maximum(0.5 * pitch - axes[:, 1], 1.0))
        geometry[:, 2] = np.where(ring, np.minimum(band, 0.3 * axes[:, 0]), np.minimum(band, axes[:, 0]))
        fit = fit_points(grey, DOT, start, geometry, half, settled_px=settled_px)
        a, b, c = fit[:, 2], fit[:, 3], fit[:, 4]
        with np.errstate(invalid="ignore"):
            good = known & np.isfinite(fit).all(axis=1) & (a * c - b * b > 0.0)
            good &= np.linalg.norm(fit[:, :2] - xy0, axis=1) < 0.5 * axes[:, 1]
        start = np.where(good[:, None], fit[:, :N_DOT], start)
        blur = np.full(len(xy0), float(np.median(np.abs(start[:, 7]))))
        alike = good & _alike(good, fit[:, 6], fit[:, -1])
        level = np.where(alike, start[:, 5], np.nan).reshape(shape)
        places = start[:, :2].reshape(*shape, 2)
        start[:, 8:10] = slopes(places, level).reshape(-1, 2)
        level = np.where(alike, np.abs(start[:, 6]), np.nan).reshape(shape)
        geometry[:, 11:13] = slopes(places, level).reshape(-1, 2) / np.maximum(np.abs(start[:, [6]]), 1e-6)
        geometry[:, 10] = _KNOWN_SLOPE / pitch
    good &= _alike(good, fit[:, 6], fit[:, -1])
    everywhere = np.ones(shape, dtype=bool)
    ellipse = np.full((len(xy0), 2, 2), np.nan)
    ellipse[good] = np.stack([fit[good][:, [2, 3]], fit[good][:, [3, 4]]], axis=-2)
    return _refined(shape, everywhere, fit, N_DOT, good, blur=fit[:, 7], contrast=np.abs(fit[:, 6]), ellipse=ellipse)


def bends(xy_px: Float, axis: int) -> Float:
    """Half the second derivative of the lines along an axis across themselves at each point, (columns, rows), 1/px.

    Straight lines stay straight in perspective: their bends are the lens's. 0 where fewer than three points are seen.
    """
    lines = np.swapaxes(xy_px, 0, 1) if axis == 0 else xy_px
    out = np.zeros(lines.shape[:2])
    for k, line in enumerate(lines):
        seen = np.isfinite(line).all(axis=-1)
        count = int(seen.sum())
        if count < 3:
            continue
        points = line[seen]
        direction = points[-1] - points[0]
        length = float(np.linalg.norm(direction))
        if length <= 0.0:
            continue
        d = (points - points[0]) / length
        t = d @ direction / length
        off = (d[:, 1] * direction[0] - d[:, 0] * direction[1]) / length
        curve = np.polynomial.Polynomial.fit(t, off, 2 if count < 6 else 3, domain=[0.0, 1.0], window=[0.0, 1.0])
        out[k, seen] = 0.5 * curve.deriv(2)(t) / length
    return out.T if axis == 0 else out


def slopes(xy_px: Float, level: Float) -> Float:
    """Slope of levels (columns, rows) across the image, by the plane through each point and its neighbours, 1/px.

    Returns (columns, rows, 2), 0 where too few neighbours are known.
    """
    out = np.zeros((*level.shape, 2))
    for i, j in np.argwhere(np.isfinite(level)):
        near = np.s_[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3]
        values, places = level[near].ravel(), xy_px[near].reshape(-1, 2)
        known = np.isfinite(values)
        if known.sum() < 4:
            continue
        d = places[known] - places[known].mean(axis=0)
        N = d.T @ d
        if np.linalg.det(N) > 1e-3 * np.trace(N) ** 2:
            out[i, j] = np.linalg.solve(N, d.T @ values[known])
    return out


def _markers(target: BoardTarget, ex: Float, ey: Float) -> Float:
    """Distances (n, 2), px, of a ChArUco board's markers from the edges along X and along Y."""
    marker = float(target.marker_mm or 0.0) / target.pitch_mm
    area = np.abs(ex[:, 0] * ey[:, 1] - ex[:, 1] * ey[:, 0])
    across_x, across_y = area / np.linalg.norm(ex, axis=1), area / np.linalg.norm(ey, axis=1)
    frame = 0.5 * (1.0 - marker)
    return frame * np.stack([across_x, across_y], axis=-1)


def _alike(good: Bool, amplitude: Float, noise: Float) -> Bool:
    """Return True for fits whose residuals and contrast are like the others'."""
    if not good.any():
        return good
    depth = np.abs(amplitude)
    typical = float(np.median(depth[good]))
    with np.errstate(invalid="ignore"):
        limit = _MISFIT * float(np.median(noise[good])) + _MISFIT_SHARE * depth
        return np.asarray((noise < limit) & (depth > _LEAST_CONTRAST * typical))


def _refined(
    shape: tuple[int, ...],
    usable: Bool,
    fit: Float,
    n: int,
    good: Bool,
    *,
    blur: Float,
    contrast: Float,
    ellipse: Float | None = None,
) -> Refined:
    xy, covariance = np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan)
    chosen = np.where(good[:, None], fit, np.nan)
    xy[usable] = chosen[:, :2]
    covariance[usable] = np.stack([chosen[:, [n, n + 1]], chosen[:, [n + 1, n + 2]]], axis=-2)
    if not good.any():
        return Refined(xy, covariance, float("nan"), float("nan"), float("nan"))
    own = float(np.median(blur[good])) ** 2 - _PIXEL_VARIANCE
    return Refined(
        xy,
        covariance,
        float(np.sqrt(max(own, 0.0))),
        float(np.median(contrast[good])),
        float(np.median(fit[good, -1])),
        None if ellipse is None else ellipse.reshape(*shape, 2, 2),
    )


def _nothing(shape: tuple[int, ...]) -> Refined:
    nan = float("nan")
    return Refined(np.full((*shape, 2), np.nan), np.full((*shape, 2, 2), np.nan), nan, nan, nan)


def sample(image: Float32, xy_px: Float) -> Float:
    """Return the grey levels (...) of the pixels nearest to positions (..., 2), of the border outside the image."""
    rows, columns = image.shape
    x = np.clip(np.rint(xy_px[..., 0]), 0, columns - 1).astype(int)
    y = np.clip(np.rint(xy_px[..., 1]), 0, rows - 1).astype(int)
    return np.asarray(image[y, x], dtype=np.float64)


def _levels(grey: Float32, xy: Float, ex: Float, ey: Float) -> tuple[Float, Float]:
    """Dark and light levels (n, 2), and the sign of the picture's amplitude, from the four squares near the corner."""
    # u is the distance to the edge along ex, positive along ey; v that to the edge along ey, positive against ex
    ring = np.linspace(0.12, 0.3, 4)
    places: list[NDArray[np.float64]] = []
    for sx, sy in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        places.append(np.mean([sample(grey, xy + r * (sx * ex + sy * ey)) for r in ring], axis=0))
    same, other = 0.5 * (places[0] + places[1]), 0.5 * (places[2] + places[3])
    levels = np.stack([np.minimum(same, other), np.maximum(same, other)], axis=-1)
    return levels, np.where(same > other, -1.0, 1.0)  # u v is negative at xy + ex + ey


def _rim_levels(grey: Float32, xy: Float, matrix: Float, ring: Bool) -> tuple[Float, Float]:
    """Return the levels outside and inside of each dot's rim, (n,) each."""
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outline = np.einsum("nij,mj->nmi", np.linalg.inv(matrix), circle)

    def at(scale: Float, plus_px: float) -> Float:
        length = np.linalg.norm(outline, axis=-1, keepdims=True)
        place = outline * (scale[:, None, None] + plus_px / length)
        return np.asarray(np.median(sample(grey, xy[:, None, :] + place), axis=1))

    one = np.ones(len(xy))
    return at(one, 3.0), at(np.where(ring, 0.8, 0.5), 0.0)
