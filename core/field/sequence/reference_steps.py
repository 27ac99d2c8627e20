"""Long sequences: the choice of the reference step that a step is matched against.

``never``: always the first reference. ``always``: the step before. ``auto``: the latest reference as long as it serves;
if it fails, the step before replaces it, if lost points are found again.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereorig.core.arrays import Bool
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import MeasurementError, SeedError
from stereorig.core.field.growth.field import assemble_field, motion_field
from stereorig.core.field.growth.seed import Seeds
from stereorig.core.field.growth.state import FieldInputs, prepare
from stereorig.core.field.points.assemble import patch_degree
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field, References
from stereorig.core.field.region.find_visible import with_visibility
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.sequence.compose import Totals
from stereorig.core.field.sequence.lost_points import OLDER, find_again
from stereorig.core.field.sequence.propagated import Propagated, added_share, pattern_share
from stereorig.core.field.sequence.segment import Segment, begin_segment, measure_segment
from stereorig.core.field.sequence.still_visible import still_visible
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.matching.fit import no_motion
from stereorig.core.matching.geometry import plane_from_angles
from stereorig.core.progress import CancelToken, Progress
from stereorig.core.settings import ReferenceUpdate
from stereorig.core.status import PointStatus

Pair = tuple[MeasureImage, MeasureImage]

MAY_BE_LOST = 0.01  # share of the points of a reference that checks may reject without any fault of the reference
SIGMAS = 3.0  # a larger loss is significant
BETTER_SIGMAS = 2.0  # and an update must be better by this much
_KEPT = OLDER + 1
_BY_THE_MATCH = (
    PointStatus.NOT_SEEDED,
    PointStatus.NOT_CONVERGED,
    PointStatus.LOW_CORRELATION,
    PointStatus.SIGMA_TOO_LARGE,
    PointStatus.EPIPOLAR_MISMATCH,
    PointStatus.NEIGHBOUR_MISMATCH,
    PointStatus.SINGULAR,
    PointStatus.LOW_TEXTURE,
)


@dataclass(frozen=True)
class PreviousStep:
    """The step measured before: its number and its field."""

    step: int
    field: Field


class Updating:
    """Measures a sequence's steps in order. Its state can be computed again from images and fields.

    Parameters
    ----------
    pair, reference, shape, grid, options
        Cameras, the first reference's images and shape, points and settings.
    mode
        ``never``, ``auto`` or ``always``.
    images_of, field_of
        Functions that return images and field of an earlier step, by its number. The field as measured or as read from
        its file.
    first
        The first reference's number.
    """

    def __init__(
        self,
        pair: StereoPair,
        reference: Pair,
        shape: Field,
        grid: PointGrid,
        options: MeasureOptions,
        *,
        mode: ReferenceUpdate,
        images_of: Callable[[int], Pair],
        field_of: Callable[[int], Field],
        first: int = 0,
    ) -> None:
        self._pair, self._reference, self._shape, self._options = pair, reference, shape, options
        self._grid = with_visibility(grid, options.subset_px)
        self._mode, self._first = mode, first
        self._images_of, self._field_of = images_of, field_of
        self._segments: OrderedDict[int, Segment] = OrderedDict()

    def measure(
        self,
        images: Pair,
        previous: PreviousStep | None,
        *,
        seeds: Seeds | None = None,
        progress: Progress | None = None,
        cancel: CancelToken | None = None,
    ) -> Field:
        """Measure one step.

        Parameters
        ----------
        images
            Both cameras' images.
        previous
            The step before; None for the first one after the reference.
        seeds, progress, cancel
            As in :func:`stereorig.core.measure.measure_motion`.

        Raises
        ------
        MeasurementError, InputError, Cancelled
            As :func:`stereorig.core.measure.measure_motion`.
        """
        step = _Step(images, previous, seeds, progress, cancel)
        if previous is None or self._mode == "never":
            return self._total(step)
        if self._mode == "always":
            return self._against(previous.step, step)
        reference = self._first if previous.field.references is None else previous.field.references.step
        try:
            field = self._against(reference, step)
        except SeedError:
            if reference == previous.step:
                raise
            return self._against(previous.step, step)
        if reference == previous.step or not _fails(field, previous.field.valid, self._held_by(reference)):
            return field
        lost = _lost(field, previous.field.valid)
        before, subset_px = self._images_of(previous.step), self._options.subset_px
        if not still_visible(self._pair, before, images, previous.field, field, lost, subset_px=subset_px):
            return field
        try:
            updated = self._against(previous.step, step)
        except MeasurementError:
            return field
        return updated if _finds_it(updated, field, previous.field) else field

    def begin_at(
        self,
        images: Pair,
        reference: int,
        *,
        seeds: Seeds | None = None,
        progress: Progress | None = None,
        cancel: CancelToken | None = None,
    ) -> Field:
        """Measure a step against a given reference without the steps between, from seeds that are found.

        Parameters
        ----------
        images
            Both cameras' images.
        reference
            Number of the first reference, or of an earlier step whose images and field can be had.
        seeds, progress, cancel
            As in :meth:`measure`.

        Returns
        -------
        Field
            The field as the chain would give it, as far as it does not depend on the steps between: later steps can be
            measured from it, and the comparison when the chain arrives decides if it is the chain's own (see
            :mod:`stereorig.core.field.sequence.joint`).

        Raises
        ------
        SeedError
            As :meth:`measure`, and if the reference does not serve: the chain would have looked for a later one.
        """
        if reference == self._first:
            field = self._total(_Step(images, None, seeds, progress, cancel))
        else:
            begun = PreviousStep(reference, self._field_of(reference))
            field = self._by_segment(reference, _Step(images, begun, seeds, progress, cancel))
        held = self._held_by(reference)
        if self._mode == "auto" and _fails(field, held, held):
            raise SeedError(f"the images have changed too much since step {reference} to be matched against it.")
        return field

    def _held_by(self, step: int) -> Bool:
        return self._shape.valid if step == self._first else self._segment(step).has.reshape(self._grid.shape)

    def _against(self, reference: int, step: _Step) -> Field:
        if reference == self._first:
            return self._total(step)
        return self._by_segment(reference, step)

    def _total(self, step: _Step) -> Field:
        inputs = self._inputs(self._reference, self._grid, step, step.progress)
        previous = None if step.previous is None else step.previous.field
        return motion_field(inputs, self._shape, previous, step.seeds)

    def _inputs(self, reference: Pair, grid: PointGrid, step: _Step, progress: Progress | None = None) -> FieldInputs:
        more: Any = {"progress": progress, "cancel": step.cancel}
        return prepare(self._pair, reference, step.images, grid, self._options, **more)

    def _segment(self, step: int) -> Segment:
        """Return the segment that begins at a step; the latest ones are kept."""
        if step == self._first:
            return self._first_segment()
        if step not in self._segments:
            self._segments[step] = begin_segment(
                step,
                self._field_of(step),
                *self._images_of(step),
                pair=self._pair,
                grid=self._grid,
                options=self._options,
                slope_share=self._slope_share,
                first=self._first,
            )
            while len(self._segments) > _KEPT:
                self._segments.popitem(last=False)
        self._segments.move_to_end(step)
        return self._segments[step]

    @property
    def _slope_share(self) -> float:
        options = self._options
        return self._reference[0].prepared(options.interpolation, options.noise[0], options.blur).slope_share

    def _first_segment(self) -> Segment:
        """Return the first reference as a segment, for points that a later one does not have."""
        f, n = self._shape, self._grid.x_px.size
        xy = self._grid.xy_px.reshape(n, 2)
        with np.errstate(invalid="ignore", divide="ignore"):
            w = plane_from_angles(self._pair, xy, f.theta_rad.ravel(), f.phi_rad.ravel(), f.zp_mm.ravel())
        has = f.valid & np.isfinite(w).all(axis=1).reshape(f.shape)
        return Segment(
            step=self._first,
            image1=self._reference[0],
            image2=self._reference[1],
            grid=replace(self._grid, allowed=has),
            position_px=xy,
            offset=np.zeros((n, 2)),
            totals=Totals(self._pair.cam1.rays_cam(xy).xyz_mm, w, no_motion(self._pair, xy)),
            plane=w,
            propagated=Propagated.nothing(n),
            shape=f,
            status=f.status.ravel(),
            steps=np.full(n, self._first, np.int32),
            slope_share=self._slope_share,
        )

    def _by_segment(self, reference: int, step: _Step) -> Field:
        assert step.previous is not None
        segment = self._segment(reference)
        state = measure_segment(
            segment,
            *step.images,
            pair=self._pair,
            options=self._options,
            previous=step.previous.field,
            previous_step=step.previous.step,
            progress=step.progress,
            cancel=step.cancel,
        )
        n, subset = len(segment.has), self._options.subset_px
        zncc = np.where(state.points.ok[:, None], state.points.zncc, np.nan)
        share = pattern_share(zncc.reshape(*self._grid.shape, 3)).ravel()
        points, propagated, added_px2 = segment.total(
            state.points, np.arange(n), share, pair=self._pair, subset_px=subset
        )
        points.status[~segment.has] = segment.status[~segment.has]
        steps = segment.steps.copy()
        whole = self._inputs(
            self._reference, self._grid, step
        )  # the first reference's own frame: all totals are stated there

        def inputs_of(older: Segment) -> FieldInputs:
            return whole if older.step == self._first else self._inputs((older.image1, older.image2), older.grid, step)

        find_again(
            segment,
            points,
            propagated,
            added_px2,
            steps,
            whole=whole,
            shape=self._shape,
            curved=state.fitter.terms == 6,
            segment_of=self._segment,
            inputs_of=inputs_of,
        )
        field = assemble_field(whole, replace(state, points=points), self._shape)
        blocks = (*field.shape, 2, 2)
        references = References(
            reference,
            steps.reshape(field.shape),
            propagated.noise.reshape(blocks),
            propagated.pattern.reshape(blocks),
            added_share(field, self._pair, added_px2.reshape(blocks)),
        )
        # totals have plane terms alone: the degrees are those that the segment's own points have
        mixed = state.fitter.terms == 6 and bool((state.points.plane & points.ok).any())
        degree = patch_degree(state.points, field.valid) if mixed else None
        return replace(field, references=references, patch_degree=degree)


@dataclass(frozen=True, eq=False)
class _Step:
    """Inputs of one step."""

    images: Pair
    previous: PreviousStep | None
    seeds: Seeds | None
    progress: Progress | None
    cancel: CancelToken | None


def _lost(field: Field, before: Bool) -> Bool:
    """Return True for formerly valid points that the matching has lost; not those that left an image."""
    return np.asarray(before & ~field.valid & np.isin(field.status, _BY_THE_MATCH))


def _fails(field: Field, before: Bool, held: Bool) -> bool:
    """Return True if a reference lost more of its points than checks reject by chance, some of them in this step."""
    n = int(held.sum())
    chance = MAY_BE_LOST * n + SIGMAS * np.sqrt(MAY_BE_LOST * n)
    return bool(_lost(field, held).sum() > chance and _lost(field, before).sum() > BETTER_SIGMAS**2)


def _finds_it(updated: Field, field: Field, before: Field) -> bool:
    """Return True if an update found half of the points lost in this step, and more than it lost itself.

    McNemar's test (doi:10.1007/BF02295996): points valid against one reference only, compared by the root of their
    number.
    """
    found, lost = (int(a.sum()) for a in (updated.valid & ~field.valid, field.valid & ~updated.valid))
    enough = 2 * found >= int(_lost(field, before.valid).sum())
    return bool(enough and found - lost > BETTER_SIGMAS * np.sqrt(found + lost))
