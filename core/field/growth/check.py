"""Checks of the valid points, and growth into the gaps that they leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.field.checks.blank_centres import reject_blank_centres
from stereorig.core.field.checks.residual_test import residual_test
from stereorig.core.field.checks.unreached import mark_outside, reject_near_edges
from stereorig.core.field.checks.validity import apply_validity_checks
from stereorig.core.field.growth.grow import grow
from stereorig.core.field.growth.state import FieldInputs, GrowthState
from stereorig.core.field.parts.straddling import reject_straddling
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.result import Unsure


def check(inputs: FieldInputs, points: PointFits) -> None:
    """Apply the validity checks; points that fail are rejected."""
    apply_validity_checks(
        points,
        pair=inputs.pair,
        shape=inputs.grid.shape,
        xy_px=inputs.xy_px,
        rays=inputs.rays,
        texture=inputs.texture,
        subset_px=inputs.options.subset_px,
        options=inputs.options.validity,
        visibility=inputs.visibility,
    )


def grow_field(inputs: FieldInputs, state: GrowthState) -> int:
    """Grow from the valid points over all usable ones; return the number of points added."""
    return grow(
        state.fitter,
        state.points,
        attempts=state.attempts,
        xy_px=inputs.xy_px,
        rays=inputs.rays,
        usable=inputs.usable,
        progress=inputs.progress,
        cancel=inputs.cancel,
    )


def fill(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Grow, check, and grow into the gaps that the checks leave."""
    for _ in range(3):
        if grow_field(inputs, state) == 0 and state.checked:
            break
        check(inputs, state.points)
        state = replace(state, checked=True)
    return state


def check_edges(inputs: FieldInputs, state: GrowthState) -> None:
    """Reject the points of a shape whose centre is plain at the end of the surface; a motion measures none."""
    if state.fitter.comparisons == 3:
        return
    options = inputs.options
    rejected = reject_blank_centres(
        state.points,
        shape=inputs.grid.shape,
        texture=inputs.texture,
        taken=inputs.ref1.pixels,
        image=inputs.matcher.ref1.pixels,
        xy_px=inputs.xy_px,
        subset_px=options.subset_px,
        spacing_px=inputs.grid.spacing_px,
    )
    if rejected:
        check(inputs, state.points)


def check_residuals(inputs: FieldInputs, state: GrowthState) -> Unsure | None:
    """Test the residuals of points and of parts of subsets, then reject points whose patch leaves the images.

    Returns the usual match's standard deviation if it is above the limit.
    """
    tested = residual_test(
        state.fitter,
        state.points,
        xy_px=inputs.xy_px,
        texture=inputs.texture,
        max_sigma_px=inputs.options.validity.max_sigma_px,
        shape=inputs.grid.shape,
        cancel=inputs.cancel,
    )
    rejected = tested.rejected + reject_straddling(
        state.fitter,
        state.points,
        shape=inputs.grid.shape,
        xy_px=inputs.xy_px,
        rays=inputs.rays,
        texture=inputs.texture,
        spacing_px=inputs.grid.spacing_px,
        noise_factor=float(np.nanmax(tested.factor[:-1], initial=1.0)),
        limit_px=tested.limit_px,
        cancel=inputs.cancel,
    )
    if rejected:
        check(inputs, state.points)  # isolated points fail the neighbour check
    mark_outside(state.fitter, state.points, inputs.xy_px, inputs.usable, however_far=True)
    if inputs.options.blur is not None:
        reject_near_edges(state.fitter, state.points, inputs.xy_px, inputs.options.blur)
    return tested.unsure
