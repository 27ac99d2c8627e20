"""Inputs of one measurement of a field, and the state that its phases pass on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.checks.residual_test import OF_USUAL
from stereorig.core.field.checks.unreached import clear_of_edges
from stereorig.core.field.growth.grow import Attempts
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.images import MeasureImage, different, refuse_stale, same_size
from stereorig.core.field.points.patch import PatchChoice, UsedPatch, asked_for
from stereorig.core.field.points.result import Field, Unsure
from stereorig.core.field.points.scales import depth_per_px
from stereorig.core.field.region.find_visible import with_visibility
from stereorig.core.field.region.region import PointGrid, check_region
from stereorig.core.field.region.visibility import Visibility
from stereorig.core.field.settings import MeasureOptions
from stereorig.core.matching.image import ImageData
from stereorig.core.progress import CancelToken, Progress, no_progress
from stereorig.core.robust import median
from stereorig.core.settings import single_sigma_px

Image = ArrayLike | ImageData | MeasureImage

SAMPLE_FAR_PX = 3.0


@dataclass(frozen=True, eq=False)
class FieldInputs:
    """Images, points and settings of one measurement; constant while it runs.

    Attributes
    ----------
    pair, options
        Cameras and settings.
    grid
        The points, with their visibility.
    ref1, ref2
        Both cameras' images at the reference.
    current
        Both cameras' current images; empty for a shape.
    matcher
        The prepared images, with the patch that is tried first.
    fits_image
        (r, c) True at allowed points whose subset is inside the image.
    xy_px, rays
        (n, 2) px, (n, 3) normalised: the points in camera 1's image.
    texture
        (n,) grey-level variance of the subsets.
    usable
        (n,) True for points that may be measured.
    hoped_for
        (n,) True for points at which new seeds are searched for.
    known_w
        (n, k) the shape measured before, NaN at points without one; None without a shape.
    progress, cancel
        Receiver of progress reports, and the means to stop.
    """

    pair: StereoPair
    grid: PointGrid
    options: MeasureOptions
    ref1: MeasureImage
    ref2: MeasureImage
    current: tuple[MeasureImage, ...]
    matcher: Fitter
    fits_image: Bool
    xy_px: Float
    rays: Float
    texture: Float
    usable: Bool
    hoped_for: Bool
    known_w: Float | None
    progress: Progress
    cancel: CancelToken | None

    @property
    def visibility(self) -> Visibility | None:
        """The points' visibility; None: all of every subset."""
        return self.grid.visibility

    @cached_property
    def repeating(self) -> Bool:
        """(n,) True at points whose texture repeats itself, which must not be seeds."""
        out = np.zeros(len(self.xy_px), bool)
        out[self.usable] = self.ref1.repeating(self.xy_px[self.usable], self.options.subset_px)
        return out

    def on_shape(self, shape: Field, previous: Field | None) -> FieldInputs:
        """Return the inputs of a motion: the points that the shape has; those lost in the previous step come second.

        A match may be as unsure as the shape's usual ones make it, in a sure shape no more than a single point.
        """
        usable = self.usable & shape.valid.ravel()
        known_w = None if shape.starts is None else shape.starts.w.reshape(len(self.xy_px), -1)
        options = self.matcher.options
        if known_w is not None and usable.any():
            most_px = self.options.validity.max_sigma_px
            sd_mm = np.sqrt(np.trace(shape.covariance[..., :3, :3], axis1=-2, axis2=-1)).ravel()[usable]
            w0 = known_w[usable, 0]
            usual_px = np.nan_to_num(median(sd_mm * w0**2 / depth_per_px(self.pair, self.rays[usable], w0)))
            limit_px = float(np.clip(OF_USUAL * usual_px, single_sigma_px(most_px), most_px))
            options = replace(options, max_sigma_px=limit_px)
        return replace(
            self,
            matcher=replace(self.matcher, options=options),
            usable=usable,
            hoped_for=usable if previous is None else usable & previous.valid.ravel(),
            known_w=known_w,
        )


def prepare(
    pair: StereoPair,
    reference: tuple[Image, Image],
    current: tuple[Image, Image] | None,
    grid: PointGrid,
    options: MeasureOptions | None,
    *,
    progress: Progress | None = None,
    cancel: CancelToken | None = None,
) -> FieldInputs:
    """Check and prepare the inputs of a field: a shape, or with current images a motion.

    Raises
    ------
    RegionError, ImageError
        If region or images cannot be used.
    InputError
        ``baseline_zero`` if both cameras have the same position.
    """
    pair.require_baseline()
    options = options or MeasureOptions()
    subset_px, kind, blur = options.subset_px, options.interpolation, options.blur
    ref1, ref2 = (MeasureImage(reference[k], f"camera {k + 1}'s image") for k in (0, 1))
    now = () if current is None else tuple(MeasureImage(current[k], f"camera {k + 1}'s current image") for k in (0, 1))
    grid = with_visibility(grid, subset_px)
    if grid.visibility is not None:
        grid = replace(grid, allowed=grid.allowed & grid.visibility.enough)
    fits_image = check_region(grid, image_shape=ref1.shape, subset_px=subset_px)
    if now:
        for before, after in zip((ref1, ref2), now, strict=True):
            same_size(before, after)
        for image in now:
            image.refuse_blank()
        different(*now)
        refuse_stale(ref1, ref2, *now)
    else:
        ref1.refuse_blank(grid.extent_px)
        ref2.refuse_blank()
        different(ref1, ref2)
    if blur is not None:
        fits_image = clear_of_edges(fits_image, grid, ref1.shape, subset_px, blur)
    xy_px = grid.xy_px.reshape(-1, 2)
    rays = pair.cam1.rays_cam(xy_px).xyz_mm
    usable: Bool = fits_image.ravel() & np.isfinite(rays).all(axis=1)
    prepared = [
        image.prepared(kind, noise, blur) for image, noise in zip((ref1, ref2, *now), 2 * options.noise, strict=False)
    ]
    matcher = Fitter(
        pair=pair,
        ref1=prepared[0],
        ref2=prepared[1],
        cur1=prepared[2] if now else None,
        cur2=prepared[3] if now else None,
        # the check of residuals limits a single point further
        options=replace(options.match_options(), max_sigma_px=options.validity.max_sigma_px),
        min_zncc=options.min_zncc,
        visibility=grid.visibility,
        keep_rejected=options.keep_rejected,
    )
    compared = None if blur is None else matcher.ref1
    texture = ref1.subset_variance(xy_px, subset_px, compared)
    if grid.visibility is not None:
        texture = grid.visibility.correct_variance(texture, ref1.pixels if compared is None else compared.pixels)
    return FieldInputs(
        pair=pair,
        grid=grid,
        options=options,
        ref1=ref1,
        ref2=ref2,
        current=now,
        matcher=matcher,
        fits_image=fits_image,
        xy_px=xy_px,
        rays=rays,
        texture=texture,
        usable=usable,
        hoped_for=usable,
        known_w=None,
        progress=progress or no_progress,
        cancel=cancel,
    )


@dataclass(frozen=True, eq=False)
class GrowthState:
    """State of a measurement. A phase returns the state that it leaves; points and attempts are changed in place.

    Attributes
    ----------
    fitter, patch
        The matcher with the patch that the points are measured with, and the choice of it with its reason.
    points
        The n points as far as they are measured.
    attempts
        Starts that growth has tried.
    checked
        True if all valid points have passed the validity checks.
    failed_seeds_px
        (x, y) of the seeds that were given and did not match.
    unsure
        The usual match's standard deviation and the limit if it is above it, else None.
    widths_px
        (n,) widths of the points' subsets where some are narrower than the field's, else None.
    """

    fitter: Fitter
    patch: PatchChoice
    points: PointFits
    attempts: Attempts
    checked: bool
    failed_seeds_px: tuple[tuple[float, float], ...] = ()
    unsure: Unsure | None = None
    widths_px: NDArray[np.intp] | None = None


def begin(inputs: FieldInputs) -> GrowthState:
    """Return the state before any point is valid."""
    asked, matcher = inputs.options.patch, inputs.matcher
    plane: UsedPatch = "plane" if matcher.comparisons == 1 else matcher.options.patch
    return GrowthState(
        fitter=matcher,
        patch=asked_for("quadratic" if asked == "quadratic" else plane, asked),
        points=matcher.empty(len(inputs.xy_px)),
        attempts=fresh_attempts(inputs),
        checked=False,
    )


def fresh_attempts(inputs: FieldInputs) -> Attempts:
    """Return attempts with which growth tries every point again; points lost in an earlier step only once."""
    attempts = Attempts.on(inputs.grid.shape, inputs.visibility)
    attempts.left[inputs.usable & ~inputs.hoped_for] = 1
    return attempts


def place_of(inputs: FieldInputs) -> dict[str, Any]:
    """Return the grid's shape, its spacing and the subset, by their names, for estimates of bias."""
    return {"shape": inputs.grid.shape, "spacing_px": inputs.grid.spacing_px, "subset_px": inputs.options.subset_px}
