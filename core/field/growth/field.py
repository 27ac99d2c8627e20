"""One measurement of a field, phase by phase: seed, grow, check, choose the patch, grow again, assemble."""

from __future__ import annotations

from dataclasses import replace

from stereorig.core.errors import SeedError
from stereorig.core.field.checks.unreached import mark_outside
from stereorig.core.field.growth.check import check, check_edges, check_residuals, fill, grow_field
from stereorig.core.field.growth.coarse_first import grow_coarse_first, is_large
from stereorig.core.field.growth.other_widths import measure_narrower, measure_wider
from stereorig.core.field.growth.patch import choose_patch, refit_curved, take_off_bias
from stereorig.core.field.growth.reach import hidden, reach_further
from stereorig.core.field.growth.seed import Seeds, match_seeds, seed_motion, seed_shape
from stereorig.core.field.growth.state import FieldInputs, GrowthState, begin, fresh_attempts
from stereorig.core.field.points.assemble import assemble
from stereorig.core.field.points.result import Field
from stereorig.core.field.seeding.diagnosis import diagnose, seed_error
from stereorig.core.status import PointStatus

_LEFT_OVER = 0.02
_MOSTLY = 0.5


def shape_field(inputs: FieldInputs, seeds: Seeds | None) -> Field:
    """Measure a shape from given seeds, or from those that are found."""
    state = seed_shape(inputs, begin(inputs), seeds)
    return assemble_field(inputs, fill_field(inputs, state), None)


def motion_field(inputs: FieldInputs, shape: Field, previous: Field | None, seeds: Seeds | None) -> Field:
    """Measure a motion from the previous step, from given seeds, or from those that are found."""
    inputs = inputs.on_shape(shape, previous)
    state = seed_motion(inputs, begin(inputs), shape, previous, seeds)
    return assemble_field(inputs, fill_field(inputs, state, shape=shape), shape)


def assemble_field(inputs: FieldInputs, state: GrowthState, shape: Field | None) -> Field:
    """Return the field in the system frame."""
    field = assemble(
        state.points, pair=inputs.pair, grid=inputs.grid, fits_image=inputs.fits_image, shape=shape, patch=state.patch
    )
    return replace(field, failed_seeds_px=state.failed_seeds_px, unsure=state.unsure)


def fill_field(inputs: FieldInputs, state: GrowthState, *, shape: Field | None = None) -> GrowthState:
    """Grow from the seeds, check, choose the patch, grow into the gaps, and check again.

    Parameters
    ----------
    inputs, state
        With seeds.
    shape
        For a motion: the shape that was measured before.

    Raises
    ------
    SeedError
        If no point is valid.
    """
    if not state.points.ok.any() and (shape is None or shape.valid.any()):
        raise _no_seed(inputs)
    if state.patch.patch == "quadratic" and state.fitter.terms == 3:
        state = refit_curved(inputs, state)
    if not state.checked and is_large(inputs):
        grow_coarse_first(inputs, state)
    state = choose_patch(inputs, fill(inputs, state))
    if not state.checked:  # measured again
        state = fill(inputs, state)
    mark_outside(state.fitter, state.points, inputs.xy_px, inputs.usable)
    if shape is not None:
        reach_further(inputs, state)
    if _unreached(inputs, state) > _LEFT_OVER and not hidden(inputs, state) and match_seeds(inputs, state) > 0:
        state = replace(state, attempts=fresh_attempts(inputs))
        grow_field(inputs, state)
        check(inputs, state.points)
        reach_further(inputs, state)
    elif shape is None:
        reach_further(inputs, state)
    check_edges(inputs, state)
    state = replace(state, unsure=check_residuals(inputs, state))
    state = take_off_bias(inputs, measure_wider(inputs, measure_narrower(inputs, state)))
    inputs.progress("done", int(state.points.ok.sum()), int(inputs.usable.sum()))
    return state


def _unreached(inputs: FieldInputs, state: GrowthState) -> float:
    """Share of the usable points that were not reached; those lost in an earlier step do not count again."""
    untouched = inputs.hoped_for & (state.points.status == PointStatus.NOT_SEEDED)
    return float(untouched.sum()) / max(int(inputs.usable.sum()), 1)


def _no_seed(inputs: FieldInputs) -> SeedError:
    """Return the error for a field without a start, with the cause as far as its images show it."""
    usable = inputs.usable
    found = diagnose(
        inputs.pair,
        (inputs.ref1, inputs.ref2),
        inputs.current,
        region_px=inputs.grid.extent_px,
        repeating=bool(usable.any() and inputs.repeating[usable].mean() > _MOSTLY),
    )
    return seed_error(found, inputs.matcher.ref1.noise_variance)
