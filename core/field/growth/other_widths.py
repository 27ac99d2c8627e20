"""Points that were lost, measured again with subsets of another width, as far as these help.

In a neck, at the border of a plastic band or beside a notch the motion bends within a subset by more than a curved
patch can: its residuals are no noise, and checks reject the point. The part that no curved patch has falls with the
fourth power of the width, noise rises with its second: a narrower subset measures the point, and the same checks test
it. Where noise or blur makes points unsure it is a wider subset, since it has more of the texture. Elsewhere nothing is
tried again: what was lost there is no matter of the width.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.block_median import block_medians, reach_of
from stereorig.core.field.checks.residual_test import residual_test, sigma_px
from stereorig.core.field.growth.check import check, grow_field
from stereorig.core.field.growth.local_bias import local_bias, worth_curving
from stereorig.core.field.growth.state import FieldInputs, GrowthState, fresh_attempts, place_of
from stereorig.core.field.parts.straddling import reject_straddling
from stereorig.core.field.points.fitter import NOT_KEPT, Fitter, PointFits
from stereorig.core.field.region.find_visible import with_visibility
from stereorig.core.matching.arguments import VisiblePixels
from stereorig.core.settings import SUBSET_PX, single_sigma_px
from stereorig.core.status import PointStatus

_NARROWER = 0.6
_LEAST_PX = 11  # narrower ones are mostly noise
_WIDER = 1.5  # halves what blur scatters, which goes by the width's power of 1.5 to 2
_UNSURE = 0.4  # share of a single point's limit: beside points that are surer, noise and blur have lost none
_FAR = 2  # times a point's reach: beside a place that is lost
_BY_THE_MATCH = (
    PointStatus.NOT_CONVERGED,
    PointStatus.LOW_CORRELATION,
    PointStatus.NEIGHBOUR_MISMATCH,
    PointStatus.SIGMA_TOO_LARGE,
)


def measure_narrower(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Measure lost points of a motion again, with narrower subsets, where strain is localised.

    The patch's reason says how many.
    """
    options, points = inputs.options, state.points
    width = max(_LEAST_PX, 2 * int(0.5 * _NARROWER * options.subset_px) + 1)
    tried = _tried(inputs, state)
    if width >= options.subset_px or not tried.any():
        return state
    fitter = _with_width(state.fitter.curved(), width)
    narrow = replace(
        inputs,
        options=replace(options, subset_px=width),
        texture=_texture(inputs, fitter, width),
        usable=points.ok | tried,
        hoped_for=points.ok | tried,
    )
    before = points.ok
    found = points.take(np.arange(len(before)))
    if found.w.shape[1] < fitter.terms:
        return state
    found.status[tried] = PointStatus.NOT_SEEDED
    grow_field(narrow, replace(state, fitter=fitter, points=found, attempts=fresh_attempts(narrow)))
    found.status[before] = PointStatus.MASKED  # tested before
    _test(narrow, fitter, found)
    index = np.flatnonzero(found.ok)
    if len(index) == 0:
        return state
    points.put(index, replace(found.take(index), **NOT_KEPT))
    widths = np.full(len(before), options.subset_px)
    widths[index] = width
    check(inputs, points)
    kept = int(points.ok[index].sum())
    patch = replace(state.patch, reason=f"{state.patch.reason}; subsets of {width} px at {kept} points")
    return replace(state, patch=patch, widths_px=widths)


def _tried(inputs: FieldInputs, state: GrowthState) -> Bool:
    """(n,) True at points that the match lost where strain is localised."""
    points = state.points
    lost = inputs.usable & inputs.hoped_for & np.isin(points.status, _BY_THE_MATCH)  # others were tried once already
    curved = state.fitter.comparisons == 3 and state.fitter.terms == 6 and inputs.options.patch == "auto"
    if not curved or inputs.options.blur is not None or not lost.any():
        return np.zeros_like(lost)
    bias = local_bias(points, rays=inputs.rays, **place_of(inputs))
    return lost if bias is None else lost & worth_curving(points, bias, **place_of(inputs))


def measure_wider(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Measure lost points of a motion again, with wider subsets, where noise or blur makes all points unsure.

    The patch has the mean width, and its reason the number of points.
    """
    options, points = inputs.options, state.points
    width = min(2 * int(0.5 * _WIDER * options.subset_px) + 1, int(SUBSET_PX.high))
    lost = _lost_to_noise(inputs, state, width)
    if width <= options.subset_px or not lost.any():
        return state
    grid, before = with_visibility(inputs.grid, width), points.ok
    matching = replace(state.fitter.options, subset_px=width, patch="affine")
    fitter = replace(state.fitter, options=matching, visibility=grid.visibility)
    wide = replace(
        inputs,
        grid=grid,
        options=replace(options, subset_px=width),
        texture=_texture(inputs, fitter, width),
        usable=before | lost,
        hoped_for=before | lost,
    )
    found = points.take(np.arange(len(before)))
    w, G = (np.ascontiguousarray(one[..., : fitter.terms]) for one in (found.w, found.G))
    found = replace(found, w=w, G=G, **NOT_KEPT)
    found.status[lost] = PointStatus.NOT_SEEDED
    grow_field(wide, replace(state, fitter=fitter, points=found, attempts=fresh_attempts(wide)))
    found.status[before] = PointStatus.MASKED  # tested before
    _test(wide, fitter, found)
    index = np.flatnonzero(found.ok)
    if len(index) == 0:
        return state
    _no_surer(found, index, points, inputs, options.subset_px / width)
    measured = points.take(index)
    measured.put_plane(np.arange(len(index)), found.take(index))
    points.put(index, replace(measured, **NOT_KEPT))
    check(inputs, points)
    widths = np.full(len(before), options.subset_px) if state.widths_px is None else state.widths_px
    widths[index] = width
    kept = int(points.ok[index].sum())
    patch = replace(
        state.patch,
        reason=f"{state.patch.reason}; subsets of {width} px at {kept} points, which noise or blur makes unsure",
        width_px=float(np.sqrt(np.mean(widths[points.ok] ** 2))) if points.ok.any() else None,
    )
    return replace(state, patch=patch, widths_px=widths)


def _no_surer(found: PointFits, index: NDArray[np.intp], points: PointFits, inputs: FieldInputs, share: float) -> None:
    """Raise covariances of points ``index`` (m,), in place, to ``share`` of the usual standard deviations about them.

    What blur scatters shows in the field only: so few points' own residuals miss up to half of it.
    """
    reach = _FAR * reach_of(inputs.options.subset_px, inputs.grid.spacing_px)
    raised = np.ones((len(index), 5))
    for k in range(4):
        own, usual = (np.sqrt(np.where(one.ok, one.covariance[:, k, k], 0.0)) for one in (found, points))
        usual = block_medians(usual, points.ok, inputs.grid.shape, reach)[index]
        raised[:, k] = np.maximum(share * usual / own[index], 1.0)
    found.covariance[index] *= raised[:, :, None] * raised[:, None, :]


def _lost_to_noise(inputs: FieldInputs, state: GrowthState, width: int) -> Bool:
    """(n,) True at points lost by the match beside points that are unsure, if the image holds the wider subset."""
    points, options = state.points, inputs.options
    lost = inputs.usable & inputs.hoped_for & np.isin(points.status, (*_BY_THE_MATCH, PointStatus.LOW_TEXTURE))
    ok = np.flatnonzero(points.ok)
    plane = state.fitter.comparisons == 3 and options.patch in ("auto", "affine") and state.patch.patch == "affine"
    if not plane or options.blur is not None or not lost.any() or len(ok) == 0:
        return np.zeros_like(lost)
    rows, cols = inputs.ref1.shape
    inside = np.abs(inputs.xy_px - 0.5 * np.array([cols - 1, rows - 1])) < 0.5 * np.array([cols, rows]) - width // 2 - 1
    lost &= inside.all(axis=1)
    place = cv2.connectedComponents(lost.reshape(inputs.grid.shape).astype(np.uint8), connectivity=8)[1]
    about = cv2.dilate(place.astype(np.float32), np.ones((3, 3), np.uint8)).ravel()[ok].astype(int)
    ok, about = ok[about > 0], about[about > 0]
    sigma = np.maximum(*sigma_px(state.fitter, points, ok, inputs.xy_px))
    count, total = np.bincount(about, minlength=place.max() + 1), np.bincount(about, sigma, minlength=place.max() + 1)
    unsure = total > _UNSURE * single_sigma_px(options.validity.max_sigma_px) * count
    return np.asarray(lost & unsure[place.ravel()])


def _with_width(fitter: Fitter, width: int) -> Fitter:
    """Return the matcher with narrower subsets, of which the same pixels are visible."""
    visibility, off = fitter.visibility, (fitter.options.subset_px - width) // 2
    if visibility is not None:
        patches = np.ascontiguousarray(visibility.visible.patches[:, off:-off, off:-off])
        visibility = replace(visibility, visible=VisiblePixels(patches, visibility.visible.of_point))
    return replace(fitter, options=replace(fitter.options, subset_px=width), visibility=visibility)


def _texture(inputs: FieldInputs, fitter: Fitter, width: int) -> Float:
    texture = inputs.ref1.subset_variance(inputs.xy_px, width, None)
    return texture if fitter.visibility is None else fitter.visibility.correct_variance(texture, inputs.ref1.pixels)


def _test(inputs: FieldInputs, fitter: Fitter, points: PointFits) -> None:
    """Test the residuals of the points and of parts of their subsets; none may be less sure than a single point."""
    shared: dict[str, Any] = {
        "xy_px": inputs.xy_px,
        "texture": inputs.texture,
        "shape": inputs.grid.shape,
        "cancel": inputs.cancel,
    }
    most_px = single_sigma_px(inputs.options.validity.max_sigma_px)
    tested = residual_test(fitter, points, max_sigma_px=most_px, **shared)
    reject_straddling(
        fitter,
        points,
        rays=inputs.rays,
        spacing_px=inputs.grid.spacing_px,
        noise_factor=float(np.nanmax(tested.factor[:-1], initial=1.0)),
        limit_px=tested.limit_px,
        **shared,
    )
