"""Seeds: the first points of a field, found without any start value, or from the user's click."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import RegionError
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.scales import depth_per_px
from stereorig.core.field.points.starts import Starts
from stereorig.core.field.region.visibility import Visibility
from stereorig.core.field.seeding.epipolar_search import sweep
from stereorig.core.field.seeding.scattered_matches import (
    ScatteredMotion,
    ScatteredShape,
    combine,
    motion_starts,
    shape_starts,
)
from stereorig.core.matching.fit import no_motion
from stereorig.core.matching.image import ImageData
from stereorig.core.settings import AnalysisSettings
from stereorig.core.status import PointStatus

_FAR_PX = 4.0
_POINTS_PER_SEED = 60
_MIN_SEEDS, _MAX_SEEDS = 24, 240
_ROUNDS = 3
_SWEEPS = 16
_AMBIGUOUS = 0.9


@dataclass(frozen=True)
class Seed:
    """A seed point that the user gives.

    Attributes
    ----------
    xy_px
        (x, y) in camera 1's reference image.
    xy2_px
        The same point in camera 2's reference image, if known.
    xy_current_px, xy2_current_px
        The same point in camera 1's and camera 2's current image, if known (both or neither).
    """

    xy_px: tuple[float, float]
    xy2_px: tuple[float, float] | None = None
    xy_current_px: tuple[float, float] | None = None
    xy2_current_px: tuple[float, float] | None = None


def seeds_of(settings: AnalysisSettings) -> list[Seed] | None:
    """Return the seeds in an analysis's settings; None if they are searched for."""
    one = settings.seeds
    if one is None:
        return None
    two = settings.seeds_cam2 or [None] * len(one)
    return [Seed(a, b) for a, b in zip(one, two, strict=True)]


def as_seeds(seeds: Sequence[Seed | Sequence[float]] | NDArray[Any]) -> tuple[Seed, ...]:
    """Accept ``Seed`` objects or bare (x, y) pairs.

    Raises
    ------
    RegionError
        ``seed_invalid``.
    """
    out = []
    for s in seeds:
        seed = s if isinstance(s, Seed) else None
        if seed is None:
            values = np.asarray(s, dtype=np.float64).ravel()
            if values.shape != (2,):
                raise RegionError(f"a seed needs x and y, got {s}.", code="seed_invalid", remedy="Give x and y in px.")
            seed = Seed((float(values[0]), float(values[1])))
        for xy in (seed.xy_px, seed.xy2_px, seed.xy_current_px, seed.xy2_current_px):
            if xy is not None and not np.isfinite(xy).all():
                raise RegionError(f"the seed {seed.xy_px} holds a number that is not finite.", code="seed_invalid")
        out.append(seed)
    return tuple(out)


def nearest_points(
    seeds: Sequence[Seed], xy_px: Float, usable: Bool, *, reach_px: float, visibility: Visibility | None = None
) -> NDArray[np.intp]:
    """Return the index of the measurable point nearest to each seed, on the seed's own side of cuts.

    Raises
    ------
    RegionError
        ``seed_outside`` if no point is within ``reach_px``.
    """
    candidates = np.flatnonzero(usable)
    out = []
    for seed in seeds:
        distance = np.linalg.norm(xy_px[candidates] - np.asarray(seed.xy_px), axis=1)
        if visibility is not None:
            position = np.broadcast_to(np.asarray(seed.xy_px, dtype=np.float64), (len(candidates), 2))
            distance[visibility.are_separated(position, xy_px[candidates])] = np.inf
        best = int(np.argmin(distance))
        if distance[best] > reach_px:
            far = f"{distance[best]:.0f} px" if np.isfinite(distance[best]) else "across a crack or a mask's black"
            raise RegionError(
                f"the seed ({seed.xy_px[0]:g}, {seed.xy_px[1]:g}) lies {far} from the nearest point "
                f"that can be measured.",
                code="seed_outside",
                remedy="Give a seed inside the region, in camera 1's reference image.",
            )
        out.append(candidates[best])
    return np.asarray(out, dtype=np.intp)


def spread(xy_px: Float, usable: Bool, support_px: Float) -> list[NDArray[np.intp]]:
    """Choose seed points all over the region.

    Parameters
    ----------
    xy_px, usable
        (n, 2), (n,) the field's points.
    support_px
        (n,) px, distance of the feature matches about a point; small is good.

    Returns
    -------
    list of index arrays
        First, second and third choice of every cell of the region.
    """
    index = np.flatnonzero(usable)
    count = float(np.clip(len(index) / _POINTS_PER_SEED, _MIN_SEEDS, _MAX_SEEDS))
    at = xy_px[index].T.copy()  # x of all points, then y
    span = np.maximum(np.ptp(at, axis=1), 1.0)
    # cells by area of usable points, so that thin regions and regions with holes get their share
    cell = np.sqrt(np.prod(span) / count * max(len(index), 1) / max(len(usable), 1))
    column, row = np.floor((at - at.min(axis=1, keepdims=True)) / max(cell, 1.0)).astype(np.int64)
    key = column * 1_000_003 + row
    order = np.lexsort((support_px[index], key))
    sorted_key = key[order]
    first = np.searchsorted(sorted_key, sorted_key, side="left")
    rank = np.arange(len(order)) - first
    size = np.searchsorted(sorted_key, sorted_key, side="right") - first
    choices = []
    for r in range(_ROUNDS):
        # not the three nearest to one another: further down the cell's list each time
        wanted = (rank == np.minimum(r * np.maximum(size // _ROUNDS, 1), size - 1)) & ((r == 0) | (size > r))
        choices.append(index[order[wanted]])
    return choices


def refine(fitter: Fitter, xy_px: Float, starts: Starts, *, far_px: float = _FAR_PX) -> PointFits:
    """Refine seeds; those that end far from their start are rejected."""
    fits = fitter.fit(xy_px, starts.w, starts.G)
    away = fits.ok & fitter.far_from_start(xy_px, fits, starts.w, starts.G, far_px)
    fits.reject(away, PointStatus.NOT_CONVERGED)
    return fits


def seeds_from_matches(
    fitter: Fitter,
    points: PointFits,
    xy_px: Float,
    usable: Bool,
    shape: ScatteredShape,
    motion: ScatteredMotion | None,
    current_shape: ScatteredShape | None,
    known_w: Float | None,
) -> int:
    """Put refined seeds into ``points``, spread over the region; return the number of valid ones.

    ``known_w`` (n, 3 or 6) is the shape if it was measured before (NaN at points without one).
    """
    if len(shape.xy_px) < 4 and known_w is None:
        return 0
    source = shape.xy_px if motion is None else motion.xy_px
    if len(source) < 4:
        return 0
    support = np.asarray(cKDTree(source).query(xy_px, k=min(8, len(source)))[0])[:, -1]
    if fitter.visibility is not None:  # next to a cut only if there is no other point
        support = np.where(fitter.visibility.whole, support, support + np.ptp(xy_px))
    found = 0
    for choice in spread(xy_px, usable & (points.status == PointStatus.NOT_SEEDED), support):
        index = choice
        if len(index) == 0:
            continue
        starts = starts_at(
            fitter.pair,
            xy_px[index],
            shape,
            motion,
            current_shape,
            None if known_w is None else known_w[index],
            fitter.visibility,
        )
        finite = np.isfinite(starts.w).all(axis=1)
        if starts.G is not None:
            finite &= np.isfinite(starts.G).all(axis=(1, 2))
        if not finite.any():
            continue
        index = index[finite]
        fits = refine(fitter, xy_px[index], Starts(starts.w[finite], None if starts.G is None else starts.G[finite]))
        good = fits.ok
        points.put(index[good], fits.take(np.flatnonzero(good)))
        found += int(good.sum())
        if good.mean() > 0.7:
            break
    return found


def starts_at(
    pair: StereoPair,
    xy_px: Float,
    shape: ScatteredShape,
    motion: ScatteredMotion | None,
    current_shape: ScatteredShape | None,
    known_w: Float | None,
    visibility: Visibility | None = None,
) -> Starts:
    """Return starts at positions from the matches not separated from them, with the measured shape if known."""
    are_separated = None if visibility is None else visibility.are_separated
    w = shape_starts(pair, shape, xy_px, are_separated).w
    if known_w is not None:
        measured = np.isfinite(known_w).all(axis=1)
        w[measured] = known_w[measured, :3]
    if motion is None or current_shape is None:
        return Starts(w)
    return motion_starts(pair, w, motion, current_shape, xy_px, are_separated)


def sweep_shape(fitter: Fitter, image1: NDArray[Any], image2: NDArray[Any], xy_px: Float) -> PointFits:
    """Find one point's shape by search along the epipolar line; the best of several candidates after refinement.

    A second candidate that correlates nearly as well means that the texture repeats: then none is taken.
    """
    shape = fitter.shape_only()
    w, _ = sweep(fitter.pair, image1, image2, xy_px, subset_px=max(fitter.options.subset_px, 25))
    if len(w) == 0:
        return PointFits.empty(1, 1)
    positions = np.broadcast_to(xy_px, (len(w), 2))
    fits = shape.fit(positions, w, None)
    quality = fits.quality
    best = int(np.argmax(quality))
    if quality[best] <= 0.0:
        return PointFits.empty(1, 1)
    ray = fitter.pair.cam1.rays_cam(positions).xyz_mm
    distinct = (
        np.abs(fits.w[:, 0] - fits.w[best, 0]) / depth_per_px(fitter.pair, ray, np.full(len(w), fits.w[best, 0])) > 2.0
    )
    # residual energy 1 - zncc distinguishes candidates better than zncc itself
    if np.any(distinct & (1.0 - quality < (1.0 - quality[best]) / _AMBIGUOUS + 0.01)):
        return PointFits.empty(1, 1)
    return fits.take(np.array([best]))


def find_template(ref1: ImageData, cur1: ImageData, xy_px: Float, *, subset_px: int, candidates: int = 3) -> Float:
    """Find a patch in camera 1's current image, by normalised cross-correlation over the whole image; (m, 2) px."""
    half = subset_px  # twice the subset: one that moved without turning much
    rows, cols = ref1.shape
    x, y = round(float(xy_px[0])), round(float(xy_px[1]))
    half = min(half, x, y, cols - 1 - x, rows - 1 - y)
    if half < 6:
        return np.zeros((0, 2))
    template = np.ascontiguousarray(ref1.pixels[y - half : y + half + 1, x - half : x + half + 1])
    score = np.array(cv2.matchTemplate(cur1.pixels, template, cv2.TM_CCOEFF_NORMED))
    out = []
    for _ in range(candidates):
        r, c = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[r, c] < 0.2:
            break
        out.append((c + half + float(xy_px[0]) - x, r + half + float(xy_px[1]) - y))
        score[max(r - 3, 0) : r + 4, max(c - 3, 0) : c + 4] = -1.0
    return np.asarray(out, dtype=np.float64).reshape(-1, 2)


def search_motion(fitter: Fitter, xy_px: Float, w: Float) -> PointFits:
    """Find one point's motion from its shape ``w`` (3,): at rest, then by template and depth search."""
    if fitter.cur1 is None or fitter.cur2 is None:
        raise ValueError("search_motion needs current images")
    position = xy_px[None]
    still = fitter.fit(position, w[None], no_motion(fitter.pair, position))
    tries = [still]
    for now in find_template(fitter.ref1, fitter.cur1, xy_px, subset_px=fitter.options.subset_px):
        w_current, _ = sweep(
            fitter.pair, fitter.cur1.pixels, fitter.cur2.pixels, now, subset_px=max(fitter.options.subset_px, 25)
        )
        m = len(w_current)
        if m:
            G = combine(
                fitter.pair,
                np.tile(w, (m, 1)),
                np.tile(position, (m, 1)),
                np.tile(now, (m, 1)),
                np.tile(np.eye(2), (m, 1, 1)),
                w_current,
            )
            tries.append(fitter.fit(np.tile(position, (m, 1)), np.tile(w, (m, 1)), G))
    best = max(((float(t.quality.max()), i) for i, t in enumerate(tries)), key=lambda item: item[0])[1]
    chosen = tries[best]
    return chosen.take(np.array([int(np.argmax(chosen.quality))]))


def swept_positions(xy_px: Float, usable: Bool) -> NDArray[np.intp]:
    """Choose up to 16 points for the depth search, the region's middle first."""
    index = np.flatnonzero(usable)
    if len(index) <= _SWEEPS:
        return index
    rng = np.random.default_rng(1)
    middle = np.argmin(np.linalg.norm(xy_px[index] - np.median(xy_px[index], axis=0), axis=1))
    others = rng.choice(len(index), _SWEEPS - 1, replace=False)
    return np.asarray(index[np.unique(np.concatenate([[middle], others]))], dtype=np.intp)
