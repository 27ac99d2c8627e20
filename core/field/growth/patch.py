"""The patch that a field is measured with: kept from an earlier step, advised on, or chosen on the field itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.field.checks.patch_choice import advise
from core.field.checks.patch_choice import choose_patch as choose
from core.field.checks.plane_error import PlaneError, plane_error
from core.field.growth.grow import fit_in_batches
from core.field.growth.state import SAMPLE_FAR_PX, FieldInputs, GrowthState, fresh_attempts
from core.field.parts.beside_edges import beside_edges
from core.field.points.fitter import PointFits
from core.field.points.result import Field
from core.status import PointStatus

_ENOUGH, _ENOUGH_SHARE = 256, 0.5  # points off all edges, and their share, of which either is enough to go by


def keep_patch(inputs: FieldInputs, state: GrowthState, previous: Field | None) -> GrowthState:
    """Keep curved patches where an earlier step of the sequence chose them."""
    choice = None if previous is None or not previous.has_motion else previous.patch
    if inputs.options.patch == "auto" and choice is not None and choice.patch == "quadratic":
        return replace(state, patch=choice.for_next_step())
    return state


def refit_curved(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Measure the valid points anew with curved patches; the others keep their status and are tried again."""
    flat, fitter = state.points, state.fitter.curved()
    index = np.flatnonzero(flat.ok)
    points = fitter.empty(len(flat.status))
    points.status[:] = flat.status
    G = None if fitter.comparisons == 1 else flat.G[index]
    fit_in_batches(fitter, points, index, inputs.xy_px, flat.w[index], G, far_px=SAMPLE_FAR_PX, cancel=inputs.cancel)
    return replace(state, fitter=fitter, points=points, attempts=fresh_attempts(inputs), checked=False)


def choose_patch(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Estimate the plane patches' bias; with ``auto``, change to curved ones if their total error is smaller."""
    points, estimate = state.points, None
    if state.fitter.terms == 3:
        estimate = _plane_error(inputs, points)
        if estimate is not None and estimate.error_mm > 0.0:
            points = _off_edges(inputs, state)
            estimate = _plane_error(inputs, points)
    if inputs.options.patch != "auto":
        return replace(state, patch=advise(state.patch, estimate))
    if state.patch.kept:
        return state
    state = replace(state, patch=choose(state.fitter, points, inputs.xy_px, estimate))
    return refit_curved(inputs, state) if state.patch.patch == "quadratic" else state


def _plane_error(inputs: FieldInputs, points: PointFits) -> PlaneError | None:
    return plane_error(
        points,
        shape=inputs.grid.shape,
        rays=inputs.rays,
        spacing_px=inputs.grid.spacing_px,
        subset_px=inputs.options.subset_px,
    )


def _off_edges(inputs: FieldInputs, state: GrowthState) -> PointFits:
    """Return the points without those that straddle an edge, which no patch of one surface explains."""
    points = state.points
    edges = beside_edges(state.fitter, points, inputs.grid.shape, inputs.rays, inputs.grid.spacing_px)
    left = int((points.ok & ~edges).sum())
    if left < min(_ENOUGH, _ENOUGH_SHARE * points.ok.sum()):
        return points
    smooth = points.take(np.arange(len(points.status)))
    smooth.reject(edges & points.ok, PointStatus.NEIGHBOUR_MISMATCH)
    return smooth
