"""Arguments of the compiled kernels: checked, contiguous, and of the types that they were compiled for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Float, Float32
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import InputError
from stereorig.core.matching.image import PAD, ImageData
from stereorig.core.matching.kernels.given import ComparedImage, Given, ReferenceImage, Setting, Warped
from stereorig.core.matching.kernels.motion import n_kept
from stereorig.core.matching.options import SPLINE_ORDER, MatchOptions
from stereorig.core.threads import run_ranges

Int = NDArray[np.int32]

POINTS_AT_ONCE = 128  # per call of a kernel: some ms, against some 50 us to call it
MIN_AT_ONCE = 16
_TINY = 1e-6  # grey levels squared


@dataclass(frozen=True, eq=False)
class VisiblePixels:
    """Visible pixels of subsets that are not wholly visible.

    Attributes
    ----------
    patches
        (k, subset, subset) uint8 in camera 1's reference image, zero where a pixel does not count.
    of_point
        (N,) int32 index of a point's patch; -1 where all pixels count.
    """

    patches: NDArray[np.uint8]
    of_point: Int


@dataclass(frozen=True, eq=False)
class WarpedImages:
    """The images compared with the reference, interpolated at one predicted place for each of its pixels.

    Attributes
    ----------
    values
        Three (rows, width) float32: grey levels of camera 2's reference and both cameras' current images, over the
        pixels of camera 1's reference, with rows filled up to a width that is a multiple of eight.
    bends_px
        (N, 3, 2, 3) the prediction's terms of second order about each point: x^2, x y and y^2 of an image's position
        along x and y, px, for offsets over half the subset's width.
    epipolar_px
        (N,) the prediction's epipolar offset.
    memory
        (M, k) of :func:`empty_memory`; filled by the fits. Later steps of the sequence, whose prediction of camera 2's
        reference image is the same, then do not compare that image again.
    number
        (N,) the points' rows in it.
    """

    values: tuple[Float32, Float32, Float32]
    bends_px: Float
    epipolar_px: Float
    memory: Float
    number: NDArray[np.intp]

    def take(self, index: NDArray[np.intp]) -> WarpedImages:
        """Return the same for some of the points."""
        return WarpedImages(self.values, self.bends_px[index], self.epipolar_px[index], self.memory, self.number[index])


def empty_memory(n: int) -> Float:
    """Return a memory of n points of which no step was measured yet."""
    return np.full((n, n_kept(1)), np.nan)


_NOT_WARPED = Warped(
    (np.empty((0, 0), np.float32),) * 3, np.zeros((1, 3, 2, 3)), np.zeros((1, n_kept(1))), np.zeros(1, np.intp)
)


def one_a_thread(make: Callable[[int], Any], subset: int) -> Callable[[], Any]:
    """Return a function that gives each thread one work space: one for each range would cost as much as ten points."""
    local = threading.local()

    def space() -> Any:
        if not hasattr(local, "space"):
            local.space = make(subset)
        return local.space

    return space


def points_of(xy_px: ArrayLike) -> tuple[Float, int]:
    """Return the points as (N, 2) doubles, and N."""
    xy = np.array(xy_px, dtype=np.float64, order="C")
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise InputError(f"xy_px has shape {xy.shape}, it must be (N, 2).", code="shape_mismatch")
    return xy, xy.shape[0]


def degree_of(options: MatchOptions) -> tuple[int, int]:
    """Degree of the patch and number of its monomials."""
    return (2, 6) if options.patch == "quadratic" else (1, 3)


def starts_of(name: str, values: ArrayLike, shape: tuple[int, ...], terms: int) -> Float:
    """Return start values with ``terms`` columns; a plane's serve a curved patch, the rest is zero."""
    given = np.asarray(values, dtype=np.float64)
    columns = given.shape[-1] if given.ndim else 0
    if given.shape[:-1] != shape or columns not in (3, terms):
        raise InputError(f"{name} has shape {given.shape}, it must be {(*shape, terms)}.", code="shape_mismatch")
    array = np.zeros((*shape, terms))
    array[..., :columns] = given
    return array


def given_to_kernels(
    pair: StereoPair,
    images: list[ImageData],
    xy: Float,
    w: Float,
    options: MatchOptions,
    visible: VisiblePixels | None,
    *,
    G: Float | None = None,
    epipolar_px: Float | None = None,
    warped: WarpedImages | None = None,
) -> Given:
    """Return the kernels' arguments for n points with unknowns ``w`` and, for a motion, ``G``."""
    n, pose = len(xy), pair.cam2_from_cam1
    patches, which = visible_of(visible, n, options.subset_px)
    return Given(
        reference=reference_of(images[0]),
        patches=patches,
        which=which,
        images=tuple(flat(image) for image in images[1:]),
        lens1=lens_of(pair.cam1),
        lens2=lens_of(pair.cam2),
        R=own(pose.rotation),
        t=own(pose.translation_mm),
        xy=xy,
        w=w,
        G=np.zeros((n, 3, w.shape[1])) if G is None else G,
        e=np.zeros(n) if epipolar_px is None else epipolar_px,
        warped=_NOT_WARPED
        if warped is None
        else Warped(warped.values, own(warped.bends_px), warped.memory, warped.number),
        setting=setting_of(options, images),
    )


def run_kernel(
    kernel: Any,
    make_space: Callable[[int], Any],
    given: Given,
    out: Float,
    *,
    kept_space: Callable[[], Any] | None = None,
    at_once: int = POINTS_AT_ONCE,
) -> tuple[NDArray[np.int8], Int]:
    """Run a kernel over all points, on all threads, ``out`` (n, ...) in place; return status and iterations (n,).

    ``kept_space`` is of :func:`one_a_thread`, from a call before for points with the same partly visible subsets.
    """
    n = len(given.xy)
    status, iterations = np.ones(n, np.int8), np.zeros(n, np.int32)
    space = kept_space or one_a_thread(make_space, given.setting.subset)
    run_ranges(
        lambda first, last: kernel(first, last, given, space(), out, status, iterations), n, at_once, MIN_AT_ONCE
    )
    return status, iterations


def setting_of(options: MatchOptions, images: list[ImageData]) -> Setting:
    """Return options and noise: the images' variances, or all one where any is unknown."""
    given = [image.noise_variance for image in images]
    variances = [v for v in given if v is not None and v > 0.0]
    known = len(variances) == len(images)
    max_sigma_px, spread = options.max_sigma_px, images[0].spread(options.subset_px, degree_of(options)[0])
    if spread is not None:  # the kernels assume white noise
        max_sigma_px /= float(np.sqrt(np.median(spread[::4, ::4])))
        variances = variances if known else [assumed_variance(images[0])] * len(images)
        known = True
    return Setting(
        subset=options.subset_px,
        order=SPLINE_ORDER[options.interpolation],
        max_iterations=options.max_iterations,
        tolerance=options.tolerance_px,
        first_rate=options.first_rate,
        max_sigma=max_sigma_px,
        max_step=options.max_step_px,
        slope_noise=images[0].slope_noise,
        slope_share=images[0].slope_share,
        variances=tuple(variances) if known else (1.0,) * len(images),
        known_noise=known,
        rigid=options.patch == "rigid",
    )


def assumed_variance(blurred: ImageData) -> float:
    """Return the noise of a blurred image's pixels, from its spectrum before the blur; without noise a little."""
    return max(blurred.slopes.noise_variance if blurred.slopes else 0.0, _TINY)


def visible_of(visible: VisiblePixels | None, n: int, subset: int) -> tuple[NDArray[np.uint8], Int]:
    """Return the patches (k, subset, subset) of partly visible subsets, and the index of each point's."""
    if visible is None or not (visible.of_point >= 0).any():
        return np.zeros((0, subset, subset), np.uint8), np.full(n, -1, np.int32)
    patches, of_point = np.ascontiguousarray(visible.patches, np.uint8), np.array(visible.of_point, np.int32)
    if patches.ndim != 3 or patches.shape[1:] != (subset, subset) or of_point.shape != (n,):
        raise InputError(
            f"visible has patches of shape {patches.shape} for {of_point.shape} points, it must be "
            f"(k, {subset}, {subset}) for ({n},).",
            code="shape_mismatch",
        )
    if of_point.max() >= len(patches):
        raise InputError(f"visible names patch {of_point.max()} of {len(patches)}.", code="shape_mismatch")
    return patches, of_point


def reference_of(image: ImageData) -> ReferenceImage:
    """Return the reference's pixels, gradients and weights; empty if all pixels weigh alike."""
    weights = np.empty((0, 0), np.float32) if image.weights is None else image.weights
    return ReferenceImage(image.pixels, *image.gradients, weights)


def flat(image: ImageData) -> ComparedImage:
    """Return the padded coefficients as one row, the image's rows and columns, and the padded row's length."""
    rows, cols = image.shape
    return ComparedImage(image.coefficients.ravel(), rows, cols, cols + 2 * PAD)


def lens_of(camera: Camera) -> Float:
    """Return the lens as the kernels use it."""
    return own(camera.lens.kernel_parameters())


def own(array: Float) -> Float:
    """Return a copy in doubles."""
    # the kernels are compiled for writable contiguous arrays; a read-only one would compile them again
    return np.array(array, dtype=np.float64, order="C")
