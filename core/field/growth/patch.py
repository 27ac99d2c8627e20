"""The patch that a field is measured with: kept from an earlier step, advised on, or chosen on the field itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.field.checks.patch_choice import advise
from core.field.checks.patch_choice import choose_patch as choose
from core.field.checks.plane_error import plane_error
from core.field.growth.grow import fit_in_batches
from core.field.growth.state import SAMPLE_FAR_PX, FieldInputs, GrowthState, fresh_attempts
from core.field.points.result import Field


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
    fit_in_batches(
        fitter, points, index, inputs.xy_px, flat.w[index], G, far_px=SAMPLE_FAR_PX, shared=True, cancel=inputs.cancel
    )
    return replace(state, fitter=fitter, points=points, attempts=fresh_attempts(inputs), checked=False)


def choose_patch(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Estimate the plane patches' bias; with ``auto``, change to curved ones if their total error is smaller."""
    estimate = None
    if state.fitter.terms == 3:
        estimate = plane_error(
            state.points,
            shape=inputs.grid.shape,
            rays=inputs.rays,
            spacing_px=inputs.grid.spacing_px,
            subset_px=inputs.options.subset_px,
        )
    if inputs.options.patch != "auto":
        return replace(state, patch=advise(state.patch, estimate))
    if state.patch.kept:
        return state
    state = replace(state, patch=choose(state.fitter, state.points, inputs.xy_px, estimate))
    return refit_curved(inputs, state) if state.patch.patch == "quadratic" else state
