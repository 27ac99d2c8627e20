"""Long sequences: which step's images a step is matched against, and when a later reference takes over.

``never``: always the first reference. ``always``: the step before. ``auto``: the last reference as long as it serves;
where it fails, the step before takes over, if that finds what was lost.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.errors import MeasurementError, SeedError
from core.field.checks.residual_test import judge
from core.field.growth.run import Run, Seeds
from core.field.growth.waves import Attempts, grow
from core.field.points.assemble import assemble
from core.field.points.fitter import Fitter, PointFits
from core.field.points.images import MeasureImage
from core.field.points.result import Field, References
from core.field.reference_update import ReferenceUpdate
from core.field.region.region import PointGrid
from core.field.sequence.compose import Totals
from core.field.sequence.propagated import HandedOn, pattern_share
from core.field.sequence.segment import Leg, LegFitter, begin_leg, measure_leg
from core.field.settings import MeasureOptions
from core.matching.fit import no_motion
from core.matching.geometry import plane_from_angles
from core.progress import CancelToken, Progress
from core.status import PointStatus

Pair = tuple[MeasureImage, MeasureImage]

MAY_BE_LOST = 0.01  # of the points that a reference has: the share that checks may refuse with no fault of its own
SIGMAS = 3.0  # a loss beyond that share is no chance
BETTER_SIGMAS = 2.0  # and an update must be better by as much
OLDER = 2  # references besides the current one that are tried for points it does not have
_KEPT = OLDER + 1
_BESIDE = 3  # points
_CONTROLS = 64
_FAR_PX = 1.0
_BY_THE_MATCH = (
    PointStatus.NOT_SEEDED,
    PointStatus.NOT_CONVERGED,
    PointStatus.LOW_CORRELATION,
    PointStatus.EPIPOLAR_MISMATCH,
    PointStatus.NEIGHBOUR_MISMATCH,
    PointStatus.SINGULAR,
    PointStatus.LOW_TEXTURE,
)


@dataclass(frozen=True)
class Earlier:
    """The step measured before: its number and its field."""

    step: int
    field: Field


class Updating:
    """Measures a sequence's steps in order. It holds nothing that cannot be made again from images and fields.

    Parameters
    ----------
    pair, reference, shape, grid, options
        Cameras, the first reference's images and shape, points and settings.
    first
        The first reference's number.
    mode
        ``never``, ``auto`` or ``always``.
    images_of, field_of
        Images and field of an earlier step, by its number. The field as it was measured or as its file gives it back.
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
        self._pair, self._reference, self._shape, self._grid, self._options = pair, reference, shape, grid, options
        self._mode, self._first = mode, first
        self._images_of, self._field_of = images_of, field_of
        self._legs: OrderedDict[int, Leg] = OrderedDict()

    def measure(
        self,
        images: Pair,
        earlier: Earlier | None,
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
        earlier
            The step before; None for the first one after the reference.
        seeds, progress, cancel
            As in :func:`core.measure.measure_motion`.

        Raises
        ------
        MeasurementError, InputError, Cancelled
            As :func:`core.measure.measure_motion`.
        """
        step = _Step(images, earlier, seeds, progress, cancel)
        if earlier is None or self._mode == "never":
            return self._total(step)
        if self._mode == "always":
            return self._against(earlier.step, step)
        current = self._first if earlier.field.references is None else earlier.field.references.step
        try:
            field = self._against(current, step)
        except SeedError:
            if current == earlier.step:
                raise
            return self._against(earlier.step, step)
        if current == earlier.step or not _fails(field, earlier.field, self._held_by(current)):
            return field
        try:
            updated = self._against(earlier.step, step)
        except MeasurementError:
            return field
        return updated if _finds_it(updated, field, earlier.field) else field

    def _held_by(self, step: int) -> Bool:
        return self._shape.valid if step == self._first else self._leg(step).has.reshape(self._grid.shape)

    def _against(self, reference: int, step: _Step) -> Field:
        if reference == self._first:
            return self._total(step)
        return self._by_leg(reference, step)

    def _total(self, step: _Step) -> Field:
        run = Run(self._pair, *self._reference, *step.images, self._grid, self._options, step.progress, step.cancel)
        run.seed_motion(self._shape, None if step.earlier is None else step.earlier.field, step.seeds)
        return run.finish(step.seeds is None, self._shape)

    def _leg(self, step: int) -> Leg:
        """The leg that begins at a step; those last asked for are kept."""
        if step == self._first:
            return self._first_leg()
        if step not in self._legs:
            self._legs[step] = begin_leg(
                step,
                self._field_of(step),
                *self._images_of(step),
                pair=self._pair,
                grid=self._grid,
                options=self._options,
                slope_share=self._slope_share,
                first=self._first,
            )
            while len(self._legs) > _KEPT:
                self._legs.popitem(last=False)
        self._legs.move_to_end(step)
        return self._legs[step]

    @property
    def _slope_share(self) -> float:
        options = self._options
        return self._reference[0].prepared(options.interpolation, options.noise[0], options.blur).slope_share

    def _first_leg(self) -> Leg:
        """The first reference as a leg, for points that a later one does not have."""
        f, n = self._shape, self._grid.x_px.size
        xy = self._grid.xy_px.reshape(n, 2)
        with np.errstate(invalid="ignore", divide="ignore"):
            w = plane_from_angles(self._pair, xy, f.theta_rad.ravel(), f.phi_rad.ravel(), f.zp_mm.ravel())
        has = f.valid & np.isfinite(w).all(axis=1).reshape(f.shape)
        return Leg(
            step=self._first,
            image1=self._reference[0],
            image2=self._reference[1],
            grid=replace(self._grid, allowed=has),
            place_px=xy,
            offset=np.zeros((n, 2)),
            totals=Totals(self._pair.cam1.rays_cam(xy).xyz_mm, w, no_motion(self._pair, xy)),
            plane=w,
            inherited=HandedOn.nothing(n),
            shape=f,
            status=f.status.ravel(),
            steps=np.full(n, self._first, np.int32),
            slope_share=self._slope_share,
        )

    def _by_leg(self, reference: int, step: _Step) -> Field:
        assert step.earlier is not None
        leg = self._leg(reference)
        run = measure_leg(
            leg,
            *step.images,
            pair=self._pair,
            options=self._options,
            previous=step.earlier.field,
            previous_step=step.earlier.step,
            progress=step.progress,
            cancel=step.cancel,
        )
        n, subset = len(leg.has), self._options.subset_px
        zncc = np.where(run.points.ok[:, None], run.points.zncc, np.nan)
        share = pattern_share(zncc.reshape(*self._grid.shape, 3)).ravel()
        points, handed = leg.total(run.points, np.arange(n), share, pair=self._pair, subset_px=subset)
        points.status[~leg.has] = leg.status[~leg.has]
        steps = leg.steps.copy()
        # the first reference's own frame: all totals are told there
        whole = Run(self._pair, *self._reference, *step.images, self._grid, self._options, None, step.cancel)
        self._find_again(leg, points, handed, steps, whole, run, step)
        field = assemble(
            points, pair=self._pair, grid=whole.grid, fits_image=whole.fits_image, shape=self._shape, patch=run.patch
        )
        place = (*field.shape, 2, 2)
        references = References(
            reference, steps.reshape(field.shape), handed.noise.reshape(place), handed.pattern.reshape(place)
        )
        return replace(field, references=references)

    def _find_again(
        self, leg: Leg, points: PointFits, handed: HandedOn, steps: NDArray[np.int32], whole: Run, run: Run, step: _Step
    ) -> None:
        """Try points that the leg does not have against the newest reference that shows them, where a neighbour stands.

        They were lost in an earlier step. What is found goes through the checks among all others.
        """
        standing = points.ok
        missing = whole.usable & self._shape.valid.ravel() & ~leg.has & ~standing
        values, counts = np.unique(steps[missing], return_counts=True)
        for used in values[np.argsort(-counts)][:OLDER]:
            older = self._leg(int(used))
            usable = missing & (steps == used) & older.has
            near = _beside(usable, standing & older.has, self._grid.shape)
            if not near.any():
                continue
            matcher, texture = self._matcher(older, whole, run, step)
            fitter = LegFitter(older, matcher, self._grid)
            level = _level(fitter, points, np.flatnonzero(near), whole.xy_px)
            if level is None:
                continue
            attempts = Attempts.on(self._grid.shape, whole.sight)
            attempts.left[:] = usable
            tried = points.take(np.arange(len(steps)))
            grow(
                fitter,
                tried,
                attempts=attempts,
                xy_px=whole.xy_px,
                rays=whole.rays,
                usable=usable,
                stage="again",
                cancel=step.cancel,
            )
            # an older reference correlates less: by as much as the points beside do that stand in both
            correlation = tried.zncc.copy()
            found = usable & tried.ok
            tried.zncc[found] = 1.0 - np.minimum((1.0 - tried.zncc[found]) * level, 1.0)
            whole.points = tried
            whole.check()
            tried.zncc[:] = correlation
            own = fitter.own
            own.refuse(own.ok & ~(usable & tried.ok), PointStatus.NEIGHBOUR_MISMATCH)
            judge(matcher, own, xy_px=older.pixel_px, texture=texture, limits=whole.sigma_limits, cancel=step.cancel)
            tried.refuse(usable & tried.ok & ~own.ok, PointStatus.LOW_CORRELATION)
            index = np.flatnonzero(usable)
            points.put(index, tried.take(index))
            good = np.flatnonzero(usable & own.ok)
            fits = own.take(good)
            totals, known = older.total(
                fits, good, pattern_share(fits.zncc), pair=self._pair, subset_px=self._options.subset_px
            )
            points.put(good, totals)
            handed.noise[good], handed.pattern[good] = known.noise, known.pattern

    def _matcher(self, leg: Leg, whole: Run, run: Run, step: _Step) -> tuple[Fitter, Float]:
        """The matcher of an older reference, with the patch of the current one, and the texture of its subsets."""
        older = whole
        if leg.step != self._first:
            older = Run(self._pair, leg.image1, leg.image2, *step.images, leg.grid, self._options, None, step.cancel)
        return older.fitter.curved() if run.fitter.terms == 6 else older.fitter, older.texture


@dataclass(frozen=True, eq=False)
class _Step:
    """What a step is measured from."""

    images: Pair
    earlier: Earlier | None
    seeds: Seeds | None
    progress: Progress | None
    cancel: CancelToken | None


def _beside(missing: Bool, standing: Bool, shape: tuple[int, int]) -> Bool:
    """Return the standing points (n,) within a few steps of missing ones."""
    disc = np.ones((2 * _BESIDE + 1, 2 * _BESIDE + 1), np.uint8)
    about = cv2.dilate(missing.reshape(shape).astype(np.uint8), disc)
    return np.asarray(standing & (np.asarray(about).ravel() > 0))


def _level(fitter: LegFitter, points: PointFits, near: NDArray[np.intp], xy_px: Float) -> Float | None:
    """Return (3,) how much 1 - zncc is now over what it is against an older reference, at points that stand in both.

    None where fewer than half of them match the older reference: it then serves for nothing.
    """
    sample = near[np.linspace(0, len(near) - 1, min(len(near), _CONTROLS)).astype(int)]
    fits = fitter.fit(xy_px[sample], points.w[sample], points.G[sample])
    fits.refuse(
        fits.ok & fitter.far_from_start(xy_px[sample], fits, points.w[sample], points.G[sample], _FAR_PX),
        PointStatus.NOT_CONVERGED,
    )
    ok = fits.ok
    if 2 * ok.sum() < len(sample):
        return None
    now, then = (np.maximum(1.0 - z, 1e-9) for z in (points.zncc[sample[ok]], fits.zncc[ok]))
    return np.asarray(np.median(now, axis=0) / np.median(then, axis=0))


def _lost(field: Field, before: Bool) -> Bool:
    """Which points that stood before the matching has lost; not those that left an image."""
    return np.asarray(before & ~field.valid & np.isin(field.status, _BY_THE_MATCH))


def _fails(field: Field, before: Field, held: Bool) -> bool:
    """Whether a reference has lost more of the points it holds than checks refuse by chance, and some in this step."""
    n = int(held.sum())
    chance = MAY_BE_LOST * n + SIGMAS * np.sqrt(MAY_BE_LOST * n)
    return bool(_lost(field, held).sum() > chance and _lost(field, before.valid).sum() > BETTER_SIGMAS**2)


def _finds_it(updated: Field, field: Field, before: Field) -> bool:
    """Whether an update found half of what was lost in this step, and more than it lost itself.

    McNemar's test: points that stand one way only, compared by the root of their number.
    """
    found, gone = (int(a.sum()) for a in (updated.valid & ~field.valid, field.valid & ~updated.valid))
    enough = 2 * found >= int(_lost(field, before.valid).sum())
    return bool(enough and found - gone > BETTER_SIGMAS * np.sqrt(found + gone))
