"""Points that were lost where strain is localised, measured again with narrower subsets.

In a neck, at the border of a plastic band or beside a notch the motion bends within a subset by more than a curved
patch can: its residuals are no noise, and checks reject the point. The part that no curved patch has falls with the
fourth power of the width, noise rises with its second: a narrower subset measures the point, and the same checks test
it. Elsewhere nothing is tried again: what was lost there is no matter of the width.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.residual_test import residual_test
from stereorig.core.field.growth.check import check, grow_field
from stereorig.core.field.growth.local_bias import local_bias, worth_curving
from stereorig.core.field.growth.state import FieldInputs, GrowthState, fresh_attempts, place_of
from stereorig.core.field.parts.straddling import reject_straddling
from stereorig.core.field.points.fitter import NOT_KEPT, Fitter, PointFits
from stereorig.core.matching.arguments import VisiblePixels
from stereorig.core.settings import single_sigma_px
from stereorig.core.status import PointStatus

_NARROWER = 0.6
_LEAST_PX = 11  # narrower ones are mostly noise
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
