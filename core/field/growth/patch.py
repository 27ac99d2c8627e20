"""The patch that a field is measured with: kept from an earlier step, advised on, or chosen on the field itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.field.checks.patch_choice import advise
from stereorig.core.field.checks.patch_choice import choose_patch as choose
from stereorig.core.field.checks.plane_error import plane_error
from stereorig.core.field.checks.residual_test import AS_NOISE, residual_factors
from stereorig.core.field.growth.grow import fit_in_batches
from stereorig.core.field.growth.local_bias import (
    change_of_bend,
    local_bias,
    mean_bias,
    state_bias,
    state_change,
    take_off,
    without,
    worth_curving,
)
from stereorig.core.field.growth.state import SAMPLE_FAR_PX, FieldInputs, GrowthState, fresh_attempts, place_of
from stereorig.core.field.points.patch import format_length
from stereorig.core.field.points.result import Field
from stereorig.core.robust import spread_indices

_SAMPLE = 256


def keep_patch(inputs: FieldInputs, state: GrowthState, previous: Field | None) -> GrowthState:
    """Keep curved patches at points for which an earlier step of the sequence chose them."""
    choice = None if previous is None or not previous.has_motion else previous.patch
    if inputs.options.patch == "auto" and choice is not None and choice.patch == "quadratic":
        return replace(state, patch=choice.for_next_step())
    return state


def refit_curved(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Measure the valid points again with curved patches; the others keep their status and are tried again."""
    flat, fitter = state.points, state.fitter.curved()
    index = np.flatnonzero(flat.ok)
    points = fitter.empty(len(flat.status))
    points.status[:] = flat.status
    G = None if fitter.comparisons == 1 else flat.G[index]
    fit_in_batches(fitter, points, index, inputs.xy_px, flat.w[index], G, far_px=SAMPLE_FAR_PX, cancel=inputs.cancel)
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
    return refit_curved(inputs, state) if state.patch.patch == "quadratic" else _curved_in_places(inputs, state)


def take_off_bias(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Subtract the mean bias of a motion's plane patches, and add the rest to the covariances if it counts."""
    if state.fitter.comparisons == 1 or state.patch.patch == "rigid":  # slopes of rigid patches show no strain
        return state
    place, points = place_of(inputs), state.points
    bias = local_bias(points, rays=inputs.rays, **place)
    bend = change_of_bend(points, rays=inputs.rays, widths_px=state.widths_px, **place)
    if bias is not None:
        known = points.ok & points.plane & ~worth_curving(points, bias, **place)
        if inputs.visibility is not None:  # across a cut slopes differ without a bend
            known &= inputs.visibility.whole
        mean = mean_bias(bias, known, **place)
        if state.patch.width_px is not None and state.widths_px is not None:  # it goes by the square of the width
            more = (state.widths_px[:, None] / inputs.options.subset_px) ** 2
            share, noise = more[:, 0] * bias.share, more[:, 0] * bias.noise
            bias = bias._replace(change=more * bias.change, off=more * bias.off, share=share, noise=noise)
            mean = None if mean is None else more * mean
        if mean is not None:
            bias, off = without(points, bias, mean), take_off(points, mean)
            reason = f"{state.patch.reason}; {format_length(off)} (rms) of bias taken off plane ones"
            state = replace(state, patch=replace(state.patch, taken_off_mm=off, reason=reason))
        state_bias(points, bias, inputs.grid.shape)
    if bend is not None:
        state_change(points, bend)
    return state


def _curved_in_places(inputs: FieldInputs, state: GrowthState) -> GrowthState:
    """Measure with curved patches where strain is localised; points lost to plane ones are tried again."""
    flat = state.points
    place = place_of(inputs)
    if state.fitter.comparisons == 1 or (bias := local_bias(flat, rays=inputs.rays, **place)) is None:
        return state
    chosen = worth_curving(flat, bias, **place)
    if chosen.any():  # blur scatters the slopes, too, by more than the noise that the fit knows
        usual = np.flatnonzero(flat.ok)
        some = usual[np.unique(spread_indices(len(usual), _SAMPLE))]
        factor = residual_factors(state.fitter, flat.take(some), inputs.xy_px[some])
        largest = float(np.nanmax(factor[1:4], initial=1.0))
        noisier = float(np.sqrt(largest)) if largest > AS_NOISE[1] else 1.0
        quieter = bias._replace(share=bias.share / noisier, variance=noisier**2 * bias.variance)
        chosen = worth_curving(flat, quieter, **place)
    index = np.flatnonzero(chosen & flat.ok)
    if len(index) == 0:
        return state
    fitter = state.fitter.curved()
    points = fitter.empty(len(flat.status))
    points.put_plane(np.flatnonzero(~chosen | ~flat.ok), flat)
    fit_in_batches(
        fitter, points, index, inputs.xy_px, flat.w[index], flat.G[index], far_px=SAMPLE_FAR_PX, cancel=inputs.cancel
    )
    found = f"quadratic at {int(points.ok.sum() - (points.ok & points.plane).sum())} points, where strain is localised"
    patch = replace(state.patch, reason=f"{state.patch.reason}; {found}")
    attempts = fresh_attempts(inputs)
    return replace(state, fitter=fitter, patch=patch, points=points, attempts=attempts, checked=False)
