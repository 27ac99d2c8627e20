"""Search of single points' shapes along the epipolar line, at the depths that the field spans and a little beyond.

For faces that neither features nor growth reached: small, steep, or behind a step. Unlike the sweep that starts a
field, it knows the depths to search, and tries tilts about every axis.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.scales import depth_per_px
from stereorig.core.field.points.starts import image_shift_px
from stereorig.core.field.seeding.epipolar_search import distinct, normalise, sample, tilted

_BEYOND = 0.5  # share of the range of depths, on either side
_BEYOND_PX = 24.0
_AS_DEEP_AS_WIDE = 0.5  # share of the field's width to either side: range for a part that no match has shown yet
_MAX_DEPTHS = 600
_TILT_RAD = 1.05
_TILT_STEP_RAD = (0.22, 0.52)
_STEEPEST_RAD = 1.19  # steepest face that both cameras of a pair with a usual angle still see
_TILT_PX = 2.2  # change of disparity at the subset's edge: half a step is refined
_CANDIDATES = 4
_SAMPLES = 11  # per side
_STEP_PX = 1.5  # step of depth as disparity: the refinement converges over two
_FAR_PX = 4.0
_DISTINCT_PX = 2.0
_AMBIGUOUS = 2.0


class DepthRange(NamedTuple):
    """Inverse depths that are searched, 1/mm."""

    low: float
    high: float


def depth_range(pair: StereoPair, rays: Float, w0: Float) -> DepthRange:
    """Return the range of inverse depths (n,) of a field's points on rays (n, 3), with a margin on either side."""
    low, high = float(w0.min()), float(w0.max())
    per_px = float(np.median(depth_per_px(pair, rays, w0)))
    more = max(_BEYOND * (high - low), _BEYOND_PX * per_px)
    return DepthRange(max(low - more, 0.2 * low), high + more)


def deeper_range(pair: StereoPair, rays: Float, w0: Float) -> DepthRange:
    """Return the range of inverse depths of a specimen that is as deep as the field's points show it to be wide."""
    low, high = float(w0.min()), float(w0.max())
    half = min(_AS_DEEP_AS_WIDE * float(np.ptp(rays[:, :2], axis=0).max()), 0.5)
    most = 0.5 * (_MAX_DEPTHS * _STEP_PX * float(np.median(depth_per_px(pair, rays, w0))) - (high - low))
    return DepthRange(max(low / (1.0 + half), low - most), min(high / (1.0 - half), high + most))


def tilts(between_rad: float, subset_px: int) -> Float:
    """Return (m, 3) unit normals, as :func:`stereorig.core.field.seeding.epipolar_search.tilted` takes them.

    The wider the angle between the views, the more a tilt distorts one of them, and the finer the steps.
    """
    per_rad = max(subset_px // 2 * 2.0 * np.tan(0.5 * between_rad), 1e-3)
    step = float(np.clip(_TILT_PX / per_rad, *_TILT_STEP_RAD))
    out = [(0.0, 0.0, 1.0)]
    for tilt in np.arange(step, _TILT_RAD + 1e-9, step):
        count = max(int(np.ceil(2.0 * np.pi * np.sin(tilt) / step)), 5)
        turn = 2.0 * np.pi * np.arange(count) / count
        out += list(
            zip(np.sin(tilt) * np.sin(turn), np.sin(tilt) * np.cos(turn), np.full(count, np.cos(tilt)), strict=True)
        )
    return np.array(out)


def steep_tilts(between_rad: float, subset_px: int) -> Float:
    """Return (m, 3) unit normals of faces steeper than those in :func:`tilts`, up to 68 degrees.

    Disparity changes over a subset as the tangent of the tilt, so the tangent is stepped.
    """
    per_unit = max(subset_px // 2 * 2.0 * np.tan(0.5 * between_rad), 1e-3)
    step = float(np.clip(_TILT_PX / per_unit, *_TILT_STEP_RAD))
    tilt = np.arange(step, _TILT_RAD + 1e-9, step)[-1]
    out: list[tuple[float, float, float]] = []
    for slope in np.arange(np.tan(tilt) + step, np.tan(_STEEPEST_RAD) + 0.5 * step, step):
        turn = 2.0 * np.pi * np.arange(np.ceil(2.0 * np.pi * slope / step)) / np.ceil(2.0 * np.pi * slope / step)
        flat = 1.0 / np.hypot(1.0, slope)
        out += list(
            zip(flat * slope * np.sin(turn), flat * slope * np.cos(turn), np.full(len(turn), flat), strict=True)
        )
    return np.array(out)


def pair_angle(pair: StereoPair, xy_px: Float, w0: float) -> float:
    """Return the median angle between both cameras' views of points (n, 2) at an inverse depth, rad."""
    point = pair.cam1.rays_cam(xy_px).xyz_mm / w0
    other = point - pair.cam2_from_cam1.inverse().translation_mm
    cosine = np.sum(point * other, axis=1) / np.linalg.norm(point, axis=1) / np.linalg.norm(other, axis=1)
    return float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))


def search_shapes(
    fitter: Fitter, xy_px: Float, within: DepthRange, *, min_zncc: float, deeper: DepthRange | None = None
) -> PointFits:
    """Find the shapes of points (n, 2) by search along their epipolar lines; NOT_SEEDED if none is clearly best.

    Parameters
    ----------
    fitter
        The matcher of a shape.
    xy_px
        (n, 2) px of camera 1.
    within
        Depths that are searched.
    min_zncc
        Correlation below which a match that no neighbour supports is taken for chance.
    deeper
        Depths that are searched if there is nothing at the first ones, without steep tilts.
    """
    shape, n = fitter.shape_only(), len(xy_px)
    out = shape.empty(n)
    if n == 0:
        return out
    smooth1, smooth2 = (
        np.asarray(cv2.GaussianBlur(image.pixels, (0, 0), 1.0), np.float32) for image in (fitter.ref1, fitter.ref2)
    )
    middle = pair_angle(fitter.pair, xy_px, 0.5 * (within.low + within.high))
    usual, steep = (f(middle, fitter.options.subset_px) for f in (tilts, steep_tilts))
    for depths, normals in ((within, usual), (within, steep), (deeper, usual)):
        left = np.flatnonzero(~out.ok)
        if depths is None or len(left) == 0:
            continue
        found = _search_tilts(shape, smooth1, smooth2, xy_px[left], depths, normals, min_zncc)
        out.put(left[found.ok], found.take(np.flatnonzero(found.ok)))
    return out


def _search_tilts(
    shape: Fitter, smooth1: Float32, smooth2: Float32, xy_px: Float, within: DepthRange, normals: Float, min_zncc: float
) -> PointFits:
    out = shape.empty(len(xy_px))
    starts = [_matches(shape.pair, smooth1, smooth2, xy, within, normals, shape.options.subset_px) for xy in xy_px] or [
        np.zeros((0, 3))
    ]
    w, owner = np.concatenate(starts), np.repeat(np.arange(len(xy_px)), [len(s) for s in starts[: len(xy_px)]])
    if len(w) == 0:
        return out
    fits = shape.fit(xy_px[owner], w, None)
    away = fits.ok & shape.far_from_start(xy_px[owner], fits, w, None, _FAR_PX)
    quality = np.where(away, -1.0, fits.quality)
    for i in np.unique(owner):
        mine = np.flatnonzero(owner == i)
        best = mine[int(np.argmax(quality[mine]))]
        if quality[best] < min_zncc or _has_rival(shape.pair, fits, mine, int(best), quality, xy_px[i]):
            continue
        out.put(np.array([i]), fits.take(np.array([best])))
    return out


def _matches(
    pair: StereoPair, image1: Float32, image2: Float32, xy_px: Float, within: DepthRange, normals: Float, subset_px: int
) -> Float:
    """Return starts (m, 3) of a point: the depths and tilts that correlate best.

    Camera 2's grey levels are taken once, along each sample's own epipolar line; a tilt then only chooses among them.
    """
    half = subset_px // 2
    offsets = np.linspace(-half, half, _SAMPLES)
    ox, oy = (a.ravel() for a in np.meshgrid(offsets, offsets))
    pixels = xy_px + np.stack([ox, oy], axis=-1)
    rows, cols = image1.shape
    inside = pixels.min() >= 0 and pixels[:, 0].max() <= cols - 1 and pixels[:, 1].max() <= rows - 1
    if not inside:
        return np.zeros((0, 3))
    rays = pair.cam1.rays_cam(pixels).xyz_mm
    ray = pair.cam1.rays_cam(xy_px[None]).xyz_mm[0]
    px = float(depth_per_px(pair, ray[None], np.array([0.5 * (within.low + within.high)]))[0])
    depths = np.arange(within.low, within.high, _STEP_PX * px)
    if not 2 <= len(depths) <= _MAX_DEPTHS:
        return np.zeros((0, 3))
    d = rays[:, :2] - ray[:2]
    w = np.concatenate(tilted(pair, ray, depths, normals))
    inverse = w[:, :1] + w[:, 1:] @ d.T  # (m, s)
    # a face of 65 degrees changes the depth by a px in a px of the subset
    low, high = max(within.low - half * px, 0.5 * within.low), within.high + half * px
    step = 0.5 * px
    ladder = np.arange(low, high + step, step)
    xy2 = pair.image2_at_depth(pixels[:, None], 1.0 / ladder[None])  # (s, l, 2)
    with np.errstate(invalid="ignore"):
        seen = (xy2 >= 0.0).all(axis=-1) & (xy2[..., 0] <= image2.shape[1] - 1) & (xy2[..., 1] <= image2.shape[0] - 1)
    levels = np.where(seen, sample(image2, np.where(seen[..., None], xy2, 0.0)), np.nan).astype(np.float32)
    place = np.rint((inverse - low) / step).astype(np.int64)
    whole = ((place >= 0) & (place < len(ladder))).all(axis=1)
    w, place = w[whole], place[whole]
    grey = levels[np.arange(len(pixels))[None], place]
    whole = np.isfinite(grey).all(axis=1)
    w, grey = w[whole], grey[whole]
    if len(w) == 0:
        return np.zeros((0, 3))
    zncc = normalise(grey) @ normalise(sample(image1, pixels[None]))[0].astype(np.float32)
    return distinct(w, np.asarray(zncc, np.float64), depths, _CANDIDATES)[0]


def _has_rival(pair: StereoPair, fits: PointFits, mine: np.ndarray, best: int, quality: Float, xy_px: Float) -> bool:
    """Return True if a match at another depth leaves no more than twice the residual: then the best may be chance."""
    ray = np.broadcast_to(pair.cam1.rays_cam(xy_px[None]).xyz_mm, (len(mine), 3))
    with np.errstate(invalid="ignore"):
        apart = image_shift_px(pair, ray, fits.w[mine, 0], np.full(len(mine), fits.w[best, 0])) > _DISTINCT_PX
    rival: Bool = apart & (quality[mine] > 0.0) & (1.0 - quality[mine] < _AMBIGUOUS * (1.0 - quality[best]))
    return bool(rival.any())
