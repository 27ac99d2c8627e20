"""A reference segment: the part of a sequence that is matched against one later step's images.

The material points are always the first reference's grid. In camera 1's image at the segment's reference they are
between pixels; a segment's subset is centred on the nearest whole pixel, so that no reference is interpolated, and the
point is the patch evaluated at most half a pixel off its middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import RegionError, SeedError
from stereorig.core.field.growth.field import fill_field
from stereorig.core.field.growth.patch import keep_patch
from stereorig.core.field.growth.seed import seed_motion
from stereorig.core.field.growth.state import GrowthState, begin, prepare
from stereorig.core.field.points.assemble import assemble
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.starts import Starts, move_matrix, move_w
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.sequence.carried_visibility import carry_visibility
from stereorig.core.field.sequence.compose import (
    Totals,
    follow,
    follow_covariance,
    image_slopes,
    in_step,
    position_covariance,
    since,
    totals_of,
)
from stereorig.core.field.sequence.propagated import Propagated, first_propagated, propagate
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.progress import CancelToken, Progress
from stereorig.core.status import PointStatus


@dataclass(frozen=True, eq=False)
class Segment:
    """The state of n points at the step whose images they are matched against.

    Attributes
    ----------
    step
        Number of that step.
    image1, image2
        Its images.
    grid
        The pixels nearest to the points in camera 1's image; ``allowed`` is True for the points that the segment has.
    position_px
        (n, 2) the points' positions in camera 1's image, px.
    offset
        (n, 2) from the pixel's ray to the point's, normalised.
    totals
        Their totals at that step.
    plane
        (n, 3) inverse depth and slopes about the point's own ray at that step.
    propagated
        Covariances of the positions that the noise of the segment's reference does not cancel, normalised.
    shape
        The shape at that step, as far as the matching needs it.
    status
        (n,) int8: OK, or why the segment does not have a point.
    steps
        (n,) int32: the newest reference that shows each point, of those up to this one.
    slope_share
        As in :func:`propagate`.
    """

    step: int
    image1: MeasureImage
    image2: MeasureImage
    grid: PointGrid
    position_px: Float
    offset: Float
    totals: Totals
    plane: Float
    propagated: Propagated
    shape: Field
    status: NDArray[np.int8]
    steps: NDArray[np.int32]
    slope_share: float

    @property
    def has(self) -> Bool:
        """(n,) True for the points that the segment has."""
        return np.asarray(self.grid.allowed.ravel())

    @property
    def pixel_px(self) -> Float:
        """(n, 2) the pixels that the subsets are centred on."""
        return self.grid.xy_px.reshape(-1, 2)

    def starts(self, now: Totals) -> tuple[Float, Float]:
        """Return the segment's unknowns about its pixels that lead to totals of all n points."""
        G = since(self.totals, now, self.plane)
        return move_w(self.plane, -self.offset), move_matrix(G, -self.offset)

    def total(
        self, fits: PointFits, index: NDArray[np.intp], pattern: Float, *, pair: StereoPair, subset_px: int
    ) -> tuple[PointFits, Propagated, Float]:
        """Return totals of points ``index`` fitted in this segment, their propagated covariance, and the added part.

        ``pattern`` (m,) is their :func:`stereorig.core.field.sequence.propagated.pattern_share`. Covariances are px^2;
        the added part (m, 2, 2) belongs to the current positions in camera 1: noise that earlier references did not
        cancel.
        """
        start = self._at(index)
        w, G = self._own(fits.w, fits.G, index)
        with np.errstate(invalid="ignore", divide="ignore"):
            after = follow(start, w, G)
            slopes, own = image_slopes(G), position_covariance(G, fits.covariance)
            known = self.propagated.at(index).through(slopes)
            changed = pattern[:, None, None] * own
            together = in_step(known.pattern, changed)
            added = known.noise + together - changed
            covariance = follow_covariance(start, w, G, fits.covariance, added)
            propagated = propagate(
                pair, self.position_px[index], self.offset[index], G, own, known, pattern, subset_px, self.slope_share
            )
            to_px = pair.cam1.lens.image_jacobian(after.seen)
        totals = replace(fits, w=after.w.copy(), G=after.G, covariance=covariance)
        if fits.rejected_w is not None and fits.rejected_g is not None:
            with np.errstate(invalid="ignore", divide="ignore"):
                before = follow(start, *self._own(fits.rejected_w, fits.rejected_g, index))
            totals.rejected_w = np.where(np.isfinite(fits.rejected_w[:, :1]), before.w, np.nan)
            totals.rejected_g = before.G
        return totals, propagated, to_px @ added @ np.swapaxes(to_px, 1, 2)

    def _at(self, index: NDArray[np.intp]) -> Totals:
        return Totals(self.totals.rays[index], self.totals.w[index], self.totals.G[index])

    def _own(self, w: Float, G: Float, index: NDArray[np.intp]) -> tuple[Float, Float]:
        """Return the segment's plane terms (m, 3), (m, 3, 3) about the points' own rays."""
        w, G = move_w(w, self.offset[index]), move_matrix(G, self.offset[index])
        return w[:, :3], G[:, :, :3]


def begin_segment(
    step: int,
    field: Field,
    image1: MeasureImage,
    image2: MeasureImage,
    *,
    pair: StereoPair,
    grid: PointGrid,
    options: MeasureOptions,
    slope_share: float,
    first: int,
) -> Segment:
    """Return the segment whose reference is a step that was measured.

    Parameters
    ----------
    step, field
        The step's number and its field, with a motion; as measured, or as read from its file.
    image1, image2
        The step's images.
    pair, grid, options
        The cameras, and points (with their visibility) and settings of the first reference.
    slope_share
        As in :func:`propagate`.
    first
        Number of the first reference.

    Raises
    ------
    SeedError
        If no point's subset is inside camera 1's image at that step.
    """
    totals = totals_of(field, pair)
    n = len(totals.w)
    subset = options.subset_px
    with np.errstate(invalid="ignore", divide="ignore"):
        position = pair.cam1.lens.image_from_normalised(totals.seen).xy
        has = field.valid.ravel() & np.isfinite(position).all(axis=1) & np.isfinite(totals.G).all(axis=(1, 2))
        pixel = np.rint(position)
        half = subset // 2
        rows, cols = image1.shape
        has &= ((pixel >= half) & (pixel <= np.array([cols, rows]) - 1 - half)).all(axis=1)
        if not has.any():
            raise SeedError(f"no point of step {step} is left to match a later step against.")
        r = field.references
        if r is None:
            propagated_px = first_propagated(field, pair, totals, subset, slope_share)
        else:
            propagated_px = Propagated(r.noise_px2.reshape(n, 2, 2), r.pattern_px2.reshape(n, 2, 2))
    middle = np.median(pixel[has], axis=0)
    # points that the segment does not have are put inside, at a place that disturbs no scale
    pixel, position = (np.where(has[:, None], a, middle) for a in (pixel, position))
    rays, own = (pair.cam1.rays_cam(a).xyz_mm for a in (pixel, position))
    J = np.linalg.inv(pair.cam1.lens.image_jacobian(own[:, :2]))
    with np.errstate(invalid="ignore", divide="ignore"):
        propagated = propagated_px.through(np.asarray(J))
        steep = totals.plane
        plane = np.concatenate([np.sum(steep * own, axis=1)[:, None], steep[:, :2]], axis=1)
        slopes_px = (
            np.linalg.inv(J) @ totals.image_slopes @ np.linalg.inv(pair.cam1.lens.image_jacobian(totals.rays[:, :2]))
        )
    offset = own[:, :2] - rays[:, :2]
    has &= np.isfinite(plane).all(axis=1) & np.isfinite(propagated.noise + propagated.pattern).all(axis=(1, 2))
    spread = float(np.median(np.sqrt(np.abs(np.linalg.det(slopes_px[has])))))
    segment_grid = PointGrid(
        x_px=pixel[:, 0].reshape(grid.shape),
        y_px=pixel[:, 1].reshape(grid.shape),
        allowed=has.reshape(grid.shape),
        spacing_px=max(grid.spacing_px * spread, 1.0),
        extent_px=(0.0, 0.0, cols - 1.0, rows - 1.0),
    )
    if grid.visibility is not None:
        segment_grid = replace(
            segment_grid, visibility=carry_visibility(grid.visibility, segment_grid, grid, position, slopes_px)
        )
    points = PointFits.empty(n, 1)
    points.w[has] = move_w(plane, -offset)[has]
    points.status[has] = PointStatus.OK
    flat = assemble(points, pair=pair, grid=segment_grid, fits_image=segment_grid.allowed, shape=None)
    # a point valid at that step and not in the segment was too near to the image's border
    why = np.where(field.valid, PointStatus.OUTSIDE_IMAGE, field.status).ravel()
    status = np.where(has, PointStatus.OK, why).astype(np.int8)
    older = np.full(n, first, np.int32) if field.references is None else field.references.steps.ravel()
    return Segment(
        step=step,
        image1=image1,
        image2=image2,
        grid=segment_grid,
        position_px=position,
        offset=offset,
        totals=totals,
        plane=plane,
        propagated=propagated,
        shape=flat,
        status=status,
        steps=np.where(has, step, older).astype(np.int32),
        slope_share=slope_share,
    )


def measure_segment(
    segment: Segment,
    cur1: MeasureImage,
    cur2: MeasureImage,
    *,
    pair: StereoPair,
    options: MeasureOptions,
    previous: Field,
    previous_step: int,
    progress: Progress | None,
    cancel: CancelToken | None,
) -> GrowthState:
    """Match a pair of images against a segment's reference; return the final state, about the segment's pixels.

    ``previous`` is the field of the step before, in totals; it gives the start unless it is the segment's own
    reference.

    Raises
    ------
    SeedError, ImageError, Cancelled
        As :func:`stereorig.core.measure.measure_motion`.
    """
    images = (segment.image1, segment.image2), (cur1, cur2)
    try:
        inputs = prepare(pair, *images, segment.grid, options, progress=progress, cancel=cancel)
    except RegionError as error:
        raise SeedError(f"no point of step {segment.step} is left to match a later step against.") from error
    start = None if previous_step == segment.step else _started(segment, previous, pair)
    inputs = inputs.on_shape(segment.shape, start)
    state = seed_motion(inputs, keep_patch(inputs, begin(inputs), previous), segment.shape, start, None)
    return fill_field(inputs, state, shape=segment.shape)


def _started(segment: Segment, previous: Field, pair: StereoPair) -> Field:
    """Return the previous step's field about the segment's pixels, as far as a start needs it."""
    with np.errstate(invalid="ignore", divide="ignore"):
        starts = segment.starts(totals_of(previous, pair))
    w, G = starts
    known = previous.valid & segment.grid.allowed
    known &= np.isfinite(G).all(axis=(1, 2)).reshape(known.shape)
    status = np.where(known, PointStatus.OK, np.where(previous.valid, PointStatus.MASKED, previous.status))
    shape = previous.shape
    return replace(
        segment.shape,
        status=status.astype(np.int8),
        uvw_mm=np.where(known[..., None], 0.0, np.nan),
        patch=previous.patch,
        starts=Starts(w.reshape(*shape, 3), G.reshape(*shape, 3, 3)),
    )
