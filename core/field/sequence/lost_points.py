"""Points lost in an earlier step of a sequence, tried again against older references."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.residual_test import residual_test
from stereorig.core.field.growth.check import check
from stereorig.core.field.growth.grow import Attempts, grow
from stereorig.core.field.growth.state import FieldInputs
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.starts import move_matrix, move_w
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.sequence.compose import Totals, since
from stereorig.core.field.sequence.propagated import Propagated, pattern_share
from stereorig.core.field.sequence.segment import Segment
from stereorig.core.status import PointStatus

OLDER = 2
"""Number of references, in addition to the current one, that are tried for points that it does not have."""
_BESIDE = 3  # points
_CONTROLS = 64
_FAR_PX = 1.0


def find_again(
    segment: Segment,
    points: PointFits,
    propagated: Propagated,
    added_px2: Float,
    steps: NDArray[np.int32],
    *,
    whole: FieldInputs,
    shape: Field,
    curved: bool,
    segment_of: Callable[[int], Segment],
    inputs_of: Callable[[Segment], FieldInputs],
) -> None:
    """Match points that the segment does not have against the newest reference that shows them, near valid points.

    Points found again pass the validity checks like all others.

    Parameters
    ----------
    segment
        The segment that the step was matched against.
    points, propagated, added_px2
        The step's n points, in totals, and their covariances of
        :meth:`stereorig.core.field.sequence.segment.Segment.total`; results are written there.
    steps
        (n,) the newest reference that shows each point.
    whole, shape
        The step against the first reference, in whose frame all totals are stated, and the shape measured there.
    curved
        True if the segment's points were measured with curved patches.
    segment_of, inputs_of
        Functions that return the segment that begins at a step, and the inputs of this step against a segment.
    """
    valid = points.ok
    missing = whole.usable & shape.valid.ravel() & ~segment.has & ~valid
    values, counts = np.unique(steps[missing], return_counts=True)
    for used in values[np.argsort(-counts)][:OLDER]:
        older = segment_of(int(used))
        usable = missing & (steps == used) & older.has
        near = _near_valid(usable, valid & older.has, whole.grid.shape)
        if not near.any():
            continue
        inputs = inputs_of(older)
        matcher = inputs.matcher.curved() if curved else inputs.matcher
        fitter = SegmentFitter(older, matcher, whole.grid)
        level = _level(fitter, points, np.flatnonzero(near), whole.xy_px)
        if level is None:
            continue
        attempts = Attempts.on(whole.grid.shape, whole.visibility)
        attempts.left[:] = usable
        tried = points.take(np.arange(len(steps)))
        grow(
            fitter,
            tried,
            attempts=attempts,
            xy_px=whole.xy_px,
            rays=whole.rays,
            usable=usable,
            phase="again",
            cancel=whole.cancel,
        )
        # an older reference correlates less: by as much as neighbouring points valid against both
        correlation = tried.zncc.copy()
        found = usable & tried.ok
        tried.zncc[found] = 1.0 - np.minimum((1.0 - tried.zncc[found]) * level, 1.0)
        check(whole, tried)
        tried.zncc[:] = correlation
        own = fitter.own
        own.reject(own.ok & ~(usable & tried.ok), PointStatus.NEIGHBOUR_MISMATCH)
        residual_test(
            matcher,
            own,
            xy_px=older.pixel_px,
            texture=inputs.texture,
            max_sigma_px=whole.options.validity.max_sigma_px,
            cancel=whole.cancel,
        )
        tried.reject(usable & tried.ok & ~own.ok, PointStatus.LOW_CORRELATION)
        index = np.flatnonzero(usable)
        points.put(index, tried.take(index))
        good = np.flatnonzero(usable & own.ok)
        fits = own.take(good)
        totals, known, added_px2[good] = older.total(
            fits, good, pattern_share(fits.zncc), pair=whole.pair, subset_px=whole.options.subset_px
        )
        points.put(good, totals)
        propagated.noise[good], propagated.pattern[good] = known.noise, known.pattern


def _near_valid(missing: Bool, valid: Bool, shape: tuple[int, int]) -> Bool:
    """Return (n,) True for valid points within a few grid points of missing ones."""
    disc = np.ones((2 * _BESIDE + 1, 2 * _BESIDE + 1), np.uint8)
    about = cv2.dilate(missing.reshape(shape).astype(np.uint8), disc)
    return np.asarray(valid & (np.asarray(about).ravel() > 0))


def _level(fitter: SegmentFitter, points: PointFits, near: NDArray[np.intp], xy_px: Float) -> Float | None:
    """Return (3,) the ratio of 1 - zncc to that against an older reference, median over points valid against both.

    None if fewer than half of them match the older reference, which is then of no use.
    """
    sample = near[np.linspace(0, len(near) - 1, min(len(near), _CONTROLS)).astype(int)]
    fits = fitter.fit(xy_px[sample], points.w[sample], points.G[sample])
    fits.reject(
        fits.ok & fitter.far_from_start(xy_px[sample], fits, points.w[sample], points.G[sample], _FAR_PX),
        PointStatus.NOT_CONVERGED,
    )
    ok = fits.ok
    if 2 * ok.sum() < len(sample):
        return None
    now, then = (np.maximum(1.0 - z, 1e-9) for z in (points.zncc[sample[ok]], fits.zncc[ok]))
    return np.asarray(np.median(now, axis=0) / np.median(then, axis=0))


class SegmentFitter:
    """Fits points of the first reference's grid against a segment's images: totals in, totals out.

    Attributes
    ----------
    own
        (n,) the points as last fitted, about the segment's pixels.
    """

    def __init__(self, segment: Segment, fitter: Fitter, grid: PointGrid) -> None:
        self._segment, self._fitter, self._subset_px = segment, fitter, fitter.options.subset_px
        self.own = fitter.empty(grid.x_px.size)
        self._corner, self._step_px, self._cols = grid.xy_px[0, 0], grid.spacing_px, grid.shape[1]
        self.comparisons, self.terms = 3, 3

    def fit(self, xy_px: Float, w: Float, G: Float | None) -> PointFits:
        """Refine totals from totals; as :meth:`stereorig.core.field.points.fitter.Fitter.fit`."""
        if G is None:
            raise ValueError("a segment measures motions")
        segment = self._segment
        col, row = np.rint((xy_px - self._corner) / self._step_px).astype(np.int64).T
        index = row * self._cols + col
        start = Totals(segment.totals.rays[index], segment.totals.w[index], segment.totals.G[index])
        own = since(start, Totals(start.rays, w, G), segment.plane[index])
        offset = segment.offset[index]
        fits = self._fitter.fit(
            segment.pixel_px[index], move_w(segment.plane[index], -offset), move_matrix(own, -offset)
        )
        self.own.put(index, fits)
        return segment.total(fits, index, np.zeros(len(index)), pair=self._fitter.pair, subset_px=self._subset_px)[0]

    def far_from_start(self, xy_px: Float, fits: PointFits, w: Float, G: Float | None, limit_px: float) -> Bool:
        """As :meth:`stereorig.core.field.points.fitter.Fitter.far_from_start`."""
        return self._fitter.far_from_start(xy_px, fits, w, G, limit_px)
