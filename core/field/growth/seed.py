"""The first points of a field: from the previous step, from given seeds, from feature matches, or from searches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import SeedError
from stereorig.core.field.growth.check import check
from stereorig.core.field.growth.grow import fit_in_batches
from stereorig.core.field.growth.patch import keep_patch, refit_curved
from stereorig.core.field.growth.state import SAMPLE_FAR_PX, FieldInputs, GrowthState
from stereorig.core.field.growth.warped import fit_on_warped_images
from stereorig.core.field.points.features import Box
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.images import features_of
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.starts import Starts
from stereorig.core.field.seeding.predicted import predict
from stereorig.core.field.seeding.scattered_matches import (
    ScatteredMotion,
    ScatteredShape,
    scattered_motion,
    scattered_shape,
    stretched_motion,
)
from stereorig.core.field.seeding.search_region import box_around, half_serves, scales, seen_by_camera2
from stereorig.core.field.seeding.seeds import (
    Seed,
    as_seeds,
    nearest_points,
    refine,
    search_motion,
    seeds_from_matches,
    spread,
    sweep_shape,
    swept_positions,
)
from stereorig.core.matching.fit import no_motion
from stereorig.core.progress import raise_if_cancelled
from stereorig.core.status import PointStatus

Seeds = Sequence[Seed | Sequence[float]] | NDArray[Any]

_MIN_MATCHES = 12
_SAMPLE_SHARE = 0.3  # share of a sample: the rest may be hidden, or have moved by itself, and is seeded after growth
_SEEDED_SHARE = 0.7  # share of a region's cells: neighbouring faces need seeds of their own
_NEAREST = 3
_REACH_STEPS = 2.0
_SEARCHED = 6  # positions


def seed_shape(inputs: FieldInputs, state: GrowthState, seeds: Seeds | None) -> GrowthState:
    """Seed a shape."""
    inputs.progress("seeds", 0, 1)
    if seeds is not None:
        state = _given_shape(inputs, state, as_seeds(seeds))
    # a user's seed comes first: for a texture that repeats itself it determines the right period
    if not state.points.ok.any() and match_seeds(inputs, state) == 0:
        _swept_shape(inputs, state)
    inputs.progress("seeds", 1, 1)
    return state


def seed_motion(
    inputs: FieldInputs, state: GrowthState, shape: Field, previous: Field | None, seeds: Seeds | None
) -> GrowthState:
    """Seed a motion: from the previous step, at the reference positions, or from matches."""
    if not inputs.usable.any():
        return state
    state = keep_patch(inputs, state, previous)
    left = ~inputs.usable & inputs.fits_image.ravel()
    state.points.status[left] = shape.status.ravel()[left]
    if previous is not None and previous.starts is not None and previous.starts.G is not None:
        n = len(inputs.xy_px)
        w, G = previous.starts.w.reshape(n, -1), previous.starts.G.reshape(n, 3, -1)
        tried = _sample_holds(inputs, state, w, G)
        if len(tried):
            return _from_previous(inputs, state, w, G, shape, tried)
    inputs.progress("seeds", 0, 1)
    if seeds is not None:
        state = _given_motion(inputs, state, as_seeds(seeds))
    if not state.points.ok.any() and not _stayed(inputs, state):
        state.points.status[inputs.usable] = PointStatus.NOT_SEEDED
        if match_seeds(inputs, state) == 0:
            _searched_motion(inputs, state)
    inputs.progress("seeds", 1, 1)
    return state


def match_seeds(inputs: FieldInputs, state: GrowthState) -> int:
    """Seed from feature matches of reduced images, reduced less until seeds are found; return their number."""
    if not (inputs.usable & ~inputs.repeating).any():
        return 0
    reach = inputs.options.subset_px + inputs.grid.spacing_px
    shape1, shape2 = inputs.ref1.shape, inputs.ref2.shape
    box1 = box_around(inputs.xy_px[inputs.usable], reach, shape1)
    box2 = seen_by_camera2(inputs.pair, box1, shape2)
    found = 0
    if half_serves((box1, box2), (shape1, shape2)):
        cells = len(spread(inputs.xy_px, inputs.usable & ~inputs.repeating, np.zeros(len(inputs.xy_px)))[0])
        found = _match_seeds_at(inputs, state, 2, box1, box2, stretched=False)
        if found >= _SEEDED_SHARE * cells:
            return found
    for scale in scales((box1, box2), (shape1, shape2)):
        found += _match_seeds_at(inputs, state, scale, box1, box2)
        if found > 0:
            break
    return found


def _match_seeds_at(
    inputs: FieldInputs, state: GrowthState, scale: int, box1: Box, box2: Box, *, stretched: bool = True
) -> int:
    """Seed from matches at one scale; ``stretched``: also from stretched copies if there are no other matches."""
    raise_if_cancelled(inputs.cancel)
    known_w, pair = inputs.known_w, inputs.pair
    wanted = [(inputs.ref1, box1)]
    if known_w is None:
        wanted.append((inputs.ref2, box2))
    wanted += [(image, (0, 0, *image.shape[::-1])) for image in inputs.current]
    features = features_of(wanted, scale)
    raise_if_cancelled(inputs.cancel)
    shape = ScatteredShape.empty() if known_w is not None else scattered_shape(pair, *features[:2])
    motion = current_shape = None
    if inputs.current:
        motion = scattered_motion(features[0], features[-2])
        raise_if_cancelled(inputs.cancel)
        current_shape = scattered_shape(pair, *features[-2:])
    elif len(shape.xy_px) < _MIN_MATCHES:
        return 0

    def put_seeds(motion: ScatteredMotion | None) -> int:
        usable = inputs.usable & ~inputs.repeating
        return seeds_from_matches(
            state.fitter, state.points, inputs.xy_px, usable, shape, motion, current_shape, inputs.known_w
        )

    found = put_seeds(motion)
    if found == 0 and motion is not None and stretched:
        # a strain or tilt too large for the features' own tolerance
        found = put_seeds(stretched_motion(inputs.ref1.pixels, box1, features[-2], scale))
    return found


def _from_previous(
    inputs: FieldInputs, state: GrowthState, w: Float, G: Float, shape: Field, tried: NDArray[np.intp]
) -> GrowthState:
    """Start all points from the previous step's values; a fitted sample of them is valid already.

    Points near those of the sample ``tried`` that failed are probably hidden: they are left to growth.
    """
    if state.patch.patch == "quadratic":
        state = refit_curved(inputs, state)
    points = state.points
    sample = np.flatnonzero(points.ok)
    w, G = w[:, : state.fitter.terms], G[:, :, : state.fitter.terms]  # a few points may have had curved patches
    if points.G.shape == G.shape:
        G = predict(inputs.pair, inputs.xy_px, G, sample, points.w[sample], points.G[sample])
    known = np.isfinite(w).all(axis=1) & np.isfinite(G).all(axis=(1, 2))
    known &= ~_amid_failed(inputs.xy_px, tried, points.ok[tried])
    index = np.flatnonzero(inputs.usable & known & ~points.ok)
    inputs.progress("previous", 0, len(index))
    if state.fitter.terms == 3:
        index = fit_on_warped_images(inputs, state, w, G, shape, sample, index)
    fitter = state.fitter.converging(points.rate[sample])
    fit_in_batches(
        fitter,
        points,
        index,
        inputs.xy_px,
        w[index],
        G[index],
        far_px=SAMPLE_FAR_PX,
        report=lambda done: inputs.progress("previous", done, len(index)),
        cancel=inputs.cancel,
    )
    check(inputs, points)
    return replace(state, checked=True)


def _stayed(inputs: FieldInputs, state: GrowthState) -> bool:
    """Return True if the surface is about in the same place; not tried on a texture that repeats itself."""
    w = inputs.known_w
    if w is None:
        return False
    return len(_sample_holds(inputs, state, w, no_motion(inputs.pair, inputs.xy_px), once_only=True)) > 0


def _amid_failed(xy_px: Float, tried: NDArray[np.intp], held: Bool) -> Bool:
    """Return (n,) True where all of the nearest points of a sample failed."""
    if held.all() or len(tried) < _NEAREST:
        return np.zeros(len(xy_px), bool)
    nearest = np.asarray(cKDTree(xy_px[tried]).query(xy_px, k=_NEAREST)[1])
    return np.asarray(~held[nearest].any(axis=1))


def _sample_holds(
    inputs: FieldInputs, state: GrowthState, w: Float, G: Float, *, once_only: bool = False
) -> NDArray[np.intp]:
    """Fit a spread sample from given starts; return it, and keep its matches as seeds, if enough of it matches."""
    usable = inputs.usable & np.isfinite(w).all(axis=1) & np.isfinite(G).all(axis=(1, 2))
    if once_only:
        usable &= ~inputs.repeating
    nothing = np.zeros(0, np.intp)
    if usable.sum() < 1:
        return nothing
    index = spread(inputs.xy_px, usable, np.zeros(len(usable)))[0]
    fits = refine(state.fitter, inputs.xy_px[index], Starts(w[index], G[index]), far_px=SAMPLE_FAR_PX)
    if fits.ok.mean() < _SAMPLE_SHARE:
        return nothing
    good = np.flatnonzero(fits.ok)
    state.points.put(index[good], fits.take(good))
    return index


def _swept_shape(inputs: FieldInputs, state: GrowthState) -> None:
    for i in swept_positions(inputs.xy_px, _rather_whole(inputs, inputs.usable & ~inputs.repeating)):
        raise_if_cancelled(inputs.cancel)
        _put_one(state, i, sweep_shape(state.fitter, inputs.ref1.pixels, inputs.ref2.pixels, inputs.xy_px[i]))


def _searched_motion(inputs: FieldInputs, state: GrowthState) -> None:
    if inputs.known_w is None:
        return
    known = inputs.usable & np.isfinite(inputs.known_w).all(axis=1) & ~inputs.repeating
    for i in swept_positions(inputs.xy_px, _rather_whole(inputs, known))[:_SEARCHED]:
        raise_if_cancelled(inputs.cancel)
        _put_one(state, i, search_motion(state.fitter, inputs.xy_px[i], inputs.known_w[i]))


def _put_one(state: GrowthState, i: np.intp, found: PointFits) -> None:
    if found.ok[0]:
        state.points.put(np.array([i]), found)


def _rather_whole(inputs: FieldInputs, usable: Bool) -> Bool:
    """Usable points with a wholly visible subset, if there are any, else all: searches compare whole squares."""
    whole = usable if inputs.visibility is None else usable & inputs.visibility.whole
    return whole if whole.any() else usable


def _nearest(inputs: FieldInputs, seeds: tuple[Seed, ...], usable: Bool) -> NDArray[np.intp]:
    reach = max(_REACH_STEPS * inputs.grid.spacing_px, float(inputs.options.subset_px))
    return nearest_points(seeds, inputs.xy_px, usable, reach_px=reach, visibility=inputs.visibility)


def _given_shape(inputs: FieldInputs, state: GrowthState, seeds: tuple[Seed, ...]) -> GrowthState:
    failed = []
    for seed, i in zip(seeds, _nearest(inputs, seeds, inputs.usable), strict=True):
        raise_if_cancelled(inputs.cancel)
        found = PointFits.empty(1, 1)
        if seed.xy2_px is not None:
            p = inputs.pair.triangulate(np.array([seed.xy_px]), np.array([seed.xy2_px]))
            depth = inputs.pair.cam1.cam_from_sys.apply(p.xyz_mm)[:, 2]
            start = Starts(np.array([[1.0 / depth[0], 0.0, 0.0]]))
            found = refine(state.fitter.shape_only(), inputs.xy_px[i : i + 1], start)
        if not found.ok[0]:
            found = sweep_shape(state.fitter, inputs.ref1.pixels, inputs.ref2.pixels, inputs.xy_px[i])
        _put_one(state, i, found)
        if not found.ok[0]:
            failed.append(seed.xy_px)
    return replace(state, failed_seeds_px=tuple(failed))


def _given_motion(inputs: FieldInputs, state: GrowthState, seeds: tuple[Seed, ...]) -> GrowthState:
    if inputs.known_w is None:
        raise SeedError("a seed for a motion needs the shape that was measured before it.")
    failed = []
    for seed, i in zip(
        seeds, _nearest(inputs, seeds, inputs.usable & np.isfinite(inputs.known_w).all(axis=1)), strict=True
    ):
        if inputs.repeating[i]:
            continue
        raise_if_cancelled(inputs.cancel)
        found = search_motion(state.fitter, inputs.xy_px[i], inputs.known_w[i])
        _put_one(state, i, found)
        if not found.ok[0]:
            failed.append(seed.xy_px)
    if not state.points.ok.any():
        # turned or stretched too far for a template: the matches about the seed give the deformation
        match_seeds(inputs, state)
    return replace(state, failed_seeds_px=tuple(failed))
