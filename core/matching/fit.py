"""Fit many points at once: the narrow functions before the compiled kernels."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.camera import Camera
from core.errors import ImageError, InputError
from core.lens import Float
from core.matching.image import PAD, ImageData, prepare
from core.matching.kernels.drivers import motion_points, motion_space, shape_points, shape_space
from core.matching.kernels.motion import n_motion_out
from core.matching.kernels.shape import n_shape_out
from core.matching.options import SPLINE_ORDER, MatchOptions
from core.stereo import StereoPair
from core.threads import run_ranges

Int = NDArray[np.int32]
Status = NDArray[np.int8]

POINTS_AT_ONCE = 128  # per call of a kernel: some ms, against some 50 us to call it
FEWEST_AT_ONCE = 16


@dataclass(frozen=True, eq=False)
class VisiblePixels:
    """Which pixels of a subset count, for the points that do not see all of theirs.

    Attributes
    ----------
    patches
        (k, subset, subset) uint8 in camera 1's reference image, zero where a pixel does not count.
    of_point
        (N,) int32 which patch is a point's; -1 where all pixels count.
    """

    patches: NDArray[np.uint8]
    of_point: Int


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Shape at N points. Numbers of points whose ``status`` is not OK are NaN, but ``zncc`` and ``noise`` stay.

    Attributes
    ----------
    w
        (N, 3) inverse depth in camera 1, 1/mm, at the point and its slopes over normalised x and y; for curved patches
        (N, 6), with the coefficients of x^2, x y and y^2 (offsets from the point) besides.
    epipolar_px, epipolar_sigma_px
        (N,) offset of camera 2's image across the epipolar line, sign as ``StereoPair.epipolar_residual_px``.
    zncc
        (N, 1) correlation with camera 2, at the final parameters.
    noise
        (N,) standard deviation of one image's noise, in camera 1's grey levels, estimated from the residuals.
    covariance
        (N, 2, 2) of (w0, epipolar offset).
    iterations, status
        (N,).
    """

    w: Float
    epipolar_px: Float
    epipolar_sigma_px: Float
    zncc: Float
    noise: Float
    covariance: Float
    iterations: Int
    status: Status


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Shape and motion at N points. Numbers of points whose ``status`` is not OK are NaN, but ``zncc`` stays.

    Attributes
    ----------
    w, epipolar_px, epipolar_sigma_px, noise, iterations, status
        As in :class:`ShapeFit`.
    G
        (N, 3, 3): camera 1 at t sees the patch at ``G (1, X, Y)`` (scale fixed by ``w``); for curved patches (N, 3, 6),
        at ``G (1, X, Y, X^2, X Y, Y^2)``.
    zncc
        (N, 3) correlation with camera 2 at t0, camera 1 at t, camera 2 at t.
    covariance
        (N, 5, 5) of (w0, G00, G10, G20, epipolar offset).
    """

    w: Float
    G: Float
    epipolar_px: Float
    epipolar_sigma_px: Float
    zncc: Float
    noise: Float
    covariance: Float
    iterations: Int
    status: Status


def no_motion(pair: StereoPair, xy_px: ArrayLike) -> Float:
    """Return the G (N, 3, 3) of a patch that did not move: ``[[Xc, 1, 0], [Yc, 0, 1], [1, 0, 0]]``."""
    rays = pair.cam1.rays_cam(xy_px).xyz_mm
    G = np.zeros((*rays.shape[:-1], 3, 3))
    G[..., :, 0] = rays
    G[..., 0, 1] = G[..., 1, 2] = 1.0
    return G


def fit_shape(
    pair: StereoPair,
    ref1: ArrayLike | ImageData,
    ref2: ArrayLike | ImageData,
    xy_px: ArrayLike,
    start: ArrayLike,
    options: MatchOptions | None = None,
    visible: VisiblePixels | None = None,
) -> ShapeFit:
    """Measure inverse depth, slopes and epipolar offset at points of camera 1.

    Parameters
    ----------
    pair
        The calibrated cameras.
    ref1, ref2
        Camera 1's and camera 2's image, raw or prepared.
    xy_px
        (N, 2) points in camera 1.
    start
        (N, 3), or for curved patches (N, 6), start values of ``w``; a point with a start that is not finite comes back
        as NOT_SEEDED.
    options
        Defaults to ``MatchOptions()``.
    visible
        Which pixels of the points' subsets count; all of them when left out.

    Raises
    ------
    InputError, ImageError
        If shapes or settings do not fit together.

    Notes
    -----
    EQUATIONS.md, "Profile", with unknowns linear in camera 2's homogeneous coordinates; criterion zero-mean
    normalised, gradients from the reference.
    """
    options = options or MatchOptions()
    images = [prepare(image, options.interpolation) for image in (ref1, ref2)]
    xy, n = _points(xy_px)
    degree, terms = _patch(options)
    w = _starts("start", start, (n,), terms)
    out = np.full((n, n_shape_out(terms)), np.nan)
    status, iterations = np.zeros(n, np.int8), np.zeros(n, np.int32)
    results = (out, status, iterations)
    pose = pair.cam2_from_cam1
    setting = _setting(options, images)
    fixed = (
        _reference(images[0]), _visible(visible, n, options.subset_px), _flat(images[1]), _lens(pair.cam1),
        _lens(pair.cam2), _own(pose.rotation), _own(pose.translation_mm), xy, w, setting,
    )  # fmt: skip
    kernel, space = shape_points[degree], _one_a_thread(shape_space[degree], options.subset_px)
    run_ranges(lambda first, last: kernel(first, last, *fixed, space(), *results), n, POINTS_AT_ONCE, FEWEST_AT_ONCE)
    failed = status != 0
    out[failed, : terms + 1] = np.nan
    out[failed, terms + 3 :] = np.nan
    covariance = out[:, [terms + 3, terms + 4, terms + 4, terms + 5]].reshape(n, 2, 2)
    return ShapeFit(
        w=out[:, :terms], epipolar_px=out[:, terms], epipolar_sigma_px=np.sqrt(out[:, terms + 5]),
        zncc=out[:, terms + 1 : terms + 2], noise=out[:, terms + 2], covariance=covariance, iterations=iterations,
        status=status,
    )  # fmt: skip


def fit_motion(
    pair: StereoPair,
    ref1: ArrayLike | ImageData,
    ref2: ArrayLike | ImageData,
    cur1: ArrayLike | ImageData,
    cur2: ArrayLike | ImageData,
    xy_px: ArrayLike,
    start_w: ArrayLike,
    start_G: ArrayLike | None = None,
    options: MatchOptions | None = None,
    visible: VisiblePixels | None = None,
) -> MotionFit:
    """Measure shape and motion at points of camera 1 from three comparisons at once.

    Parameters
    ----------
    pair
        The calibrated cameras.
    ref1, ref2, cur1, cur2
        Both cameras' images at t0 and at t, raw or prepared.
    xy_px
        (N, 2) points in camera 1 at t0.
    start_w
        (N, 3), or for curved patches (N, 6), start values of ``w``.
    start_G
        (N, 3, 3), or for curved patches (N, 3, 6), start values of ``G``; no motion when left out.
    options
        Defaults to ``MatchOptions()``.
    visible
        Which pixels of the points' subsets count; all of them when left out.

    Raises
    ------
    InputError, ImageError
        If shapes or settings do not fit together.

    Notes
    -----
    EQUATIONS.md, "Displacement". The three comparisons are weighed with their joint covariance, in which the
    reference's noise is common. The epipolar offset is shared by camera 2's two comparisons, so that a calibration
    error across the epipolar line does not become motion.
    """
    options = options or MatchOptions()
    images = [prepare(image, options.interpolation) for image in (ref1, ref2, cur1, cur2)]
    for i, j, camera in ((0, 2, 1), (1, 3, 2)):
        if images[i].shape != images[j].shape:
            raise ImageError(
                f"camera {camera}'s images have {images[i].shape} and {images[j].shape} rows and columns.",
                code="image_size_mismatch",
                remedy="Give images of one size per camera.",
            )
    xy, n = _points(xy_px)
    degree, terms = _patch(options)
    w = _starts("start_w", start_w, (n,), terms)
    G = _starts("start_G", no_motion(pair, xy) if start_G is None else start_G, (n, 3), terms)
    out = np.full((n, n_motion_out(terms)), np.nan)
    status, iterations = np.zeros(n, np.int8), np.zeros(n, np.int32)
    results = (out, status, iterations)
    pose = pair.cam2_from_cam1
    setting = (*_setting(options, images), options.patch == "rigid")
    fixed = (
        _reference(images[0]), _visible(visible, n, options.subset_px), _flat(images[1]), _flat(images[2]),
        _flat(images[3]), _lens(pair.cam1), _lens(pair.cam2), _own(pose.rotation), _own(pose.translation_mm), xy, w, G,
        setting,
    )  # fmt: skip
    kernel, space = motion_points[degree], _one_a_thread(motion_space[degree], options.subset_px)
    run_ranges(lambda first, last: kernel(first, last, *fixed, space(), *results), n, POINTS_AT_ONCE, FEWEST_AT_ONCE)
    failed, at = status != 0, 4 * terms
    out[failed, : at + 1] = np.nan
    out[failed, at + 5 :] = np.nan
    covariance = out[:, at + 5 :].reshape(n, 5, 5)
    return MotionFit(
        w=out[:, :terms], G=out[:, terms:at].reshape(n, 3, terms), epipolar_px=out[:, at],
        epipolar_sigma_px=np.sqrt(covariance[:, 4, 4]), zncc=out[:, at + 1 : at + 4], noise=out[:, at + 4],
        covariance=covariance, iterations=iterations, status=status,
    )  # fmt: skip


def _one_a_thread(make: Callable[[int], Any], subset: int) -> Callable[[], Any]:
    """Return what gives each thread its own work space, once: one for each range would cost as much as ten points."""
    own = threading.local()

    def space() -> Any:
        if not hasattr(own, "space"):
            own.space = make(subset)
        return own.space

    return space


def _points(xy_px: ArrayLike) -> tuple[Float, int]:
    xy = np.array(xy_px, dtype=np.float64, order="C")
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise InputError(f"xy_px has shape {xy.shape}, it must be (N, 2).", code="shape_mismatch")
    return xy, xy.shape[0]


def _patch(options: MatchOptions) -> tuple[int, int]:
    """Degree of the patch and number of its monomials."""
    return (2, 6) if options.patch == "curved" else (1, 3)


def _starts(name: str, values: ArrayLike, shape: tuple[int, ...], terms: int) -> Float:
    """Start values with ``terms`` columns; a plane's serve a curved patch, the rest is zero."""
    given = np.asarray(values, dtype=np.float64)
    columns = given.shape[-1] if given.ndim else 0
    if given.shape[:-1] != shape or columns not in (3, terms):
        raise InputError(f"{name} has shape {given.shape}, it must be {(*shape, terms)}.", code="shape_mismatch")
    array = np.zeros((*shape, terms))
    array[..., :columns] = given
    return array


def _setting(options: MatchOptions, images: list[ImageData]) -> tuple[Any, ...]:
    """Options and what is known of the noise: the images' variances, or all one where any is unknown."""
    given = [image.noise_variance for image in images]
    variances = [v for v in given if v is not None and v > 0.0]
    known = len(variances) == len(images)
    return (
        options.subset_px, SPLINE_ORDER[options.interpolation], options.max_iterations, options.tolerance_px,
        options.max_sigma_px, options.max_step_px, (images[0].slope_noise, images[0].slope_share),
        tuple(variances) if known else (1.0,) * len(images), known,
    )  # fmt: skip


def _visible(visible: VisiblePixels | None, n: int, subset: int) -> tuple[NDArray[np.uint8], Int]:
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


def _reference(image: ImageData) -> tuple[Any, ...]:
    weights = np.empty((0, 0), np.float32) if image.weights is None else image.weights
    return (image.pixels, *image.gradients, weights)


def _flat(image: ImageData) -> tuple[Any, ...]:
    rows, cols = image.shape
    return image.coefficients.ravel(), rows, cols, cols + 2 * PAD


def _lens(camera: Camera) -> Float:
    return _own(camera.lens.kernel_parameters())


def _own(array: Float) -> Float:
    # the kernels are compiled for writable contiguous arrays; a read-only one would compile them again
    return np.array(array, dtype=np.float64)
