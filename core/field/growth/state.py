"""Inputs of one measurement of a field, and the state that its phases pass on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.field.checks.edges import clear_of_edges
from core.field.growth.grow import Attempts
from core.field.points.crew import Crew
from core.field.points.fitter import Fitter, PointFits
from core.field.points.images import MeasureImage, different, refuse_stale, same_size
from core.field.points.patch import PatchChoice, UsedPatch, asked_for
from core.field.points.result import Field
from core.field.region.find_visible import with_visibility
from core.field.region.region import PointGrid, check_region
from core.field.region.visibility import Visibility
from core.field.settings import MeasureOptions
from core.matching.image import ImageData
from core.progress import CancelToken, Progress, no_progress

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
        Both cameras' current images; none of a shape.
    matcher
        The prepared images, with the patch that is tried first.
    fits_image
        (r, c) True where a point is allowed and its subset lies in the image.
    xy_px, rays
        (n, 2) px, (n, 3) normalised: the points in camera 1's image.
    texture
        (n,) grey-level variance of the subsets.
    usable
        (n,) True where a point may be measured.
    hoped_for
        (n,) True where new seeds are searched for.
    known_w
        (n, k) the shape measured before, NaN where it has no point; None without one.
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
        """(n,) True where the texture repeats itself, so that no seed may lie there."""
        out = np.zeros(len(self.xy_px), bool)
        out[self.usable] = self.ref1.repeating(self.xy_px[self.usable], self.options.subset_px)
        return out

    def on_shape(self, shape: Field, previous: Field | None) -> FieldInputs:
        """Return the inputs of a motion: the points that the shape has; those lost in the previous step come second."""
        usable = self.usable & shape.valid.ravel()
        return replace(
            self,
            usable=usable,
            hoped_for=usable if previous is None else usable & previous.valid.ravel(),
            known_w=None if shape.starts is None else shape.starts.w.reshape(len(self.xy_px), -1),
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
    crew: Crew | None = None,
) -> FieldInputs:
    """Check and prepare the inputs of a field: a shape, or with current images a motion.

    ``crew`` are those who may fit tiles of many points; None: nobody.

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
        options=options.match_options(),
        min_zncc=options.min_zncc,
        visibility=grid.visibility,
        keep_rejected=options.keep_rejected,
        crew=crew if int(usable.sum()) >= options.split_from else None,
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
    """

    fitter: Fitter
    patch: PatchChoice
    points: PointFits
    attempts: Attempts
    checked: bool
    failed_seeds_px: tuple[tuple[float, float], ...] = ()


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
    """Return attempts that let growth try every point anew; those lost in an earlier step once only."""
    attempts = Attempts.on(inputs.grid.shape, inputs.visibility)
    attempts.left[inputs.usable & ~inputs.hoped_for] = 1
    return attempts
