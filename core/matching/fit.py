"""Fit many points at once: the narrow functions before the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.camera import Camera
from core.errors import ImageError, InputError
from core.lens import Float
from core.matching.image import PAD, ImageData, prepare
from core.matching.kernels.drivers import motion_points, shape_points
from core.matching.kernels.motion import N_MOTION_OUT
from core.matching.kernels.shape import N_SHAPE_OUT
from core.matching.options import SPLINE_ORDER, MatchOptions
from core.stereo import StereoPair
from core.threads import run_ranges

Int = NDArray[np.int32]
Status = NDArray[np.int8]

POINTS_AT_ONCE = 128  # per call of a kernel: some ms, against some 50 us to set it up


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Shape at N points. Numbers of points whose ``status`` is not OK are NaN, but ``zncc`` and ``noise`` stay.

    Attributes
    ----------
    w
        (N, 3) inverse depth in camera 1, 1/mm, at the point and its slopes over normalised x and y.
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
        (N, 3, 3): camera 1 at t sees the patch at ``G (1, X, Y)`` (scale fixed by ``w``).
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
        (N, 3) start values of ``w``; a point with a start that is not finite comes back as NOT_SEEDED.
    options
        Defaults to ``MatchOptions()``.

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
    w = _starts("start", start, (n, 3))
    out = np.full((n, N_SHAPE_OUT), np.nan)
    status, iterations = np.zeros(n, np.int8), np.zeros(n, np.int32)
    pose = pair.cam2_from_cam1
    setting = _setting(options)
    fixed = (
        images[0].pixels, images[0].gradients, _flat(images[1]), _lens(pair.cam1), _lens(pair.cam2),
        _own(pose.rotation), _own(pose.translation_mm), xy, w, setting, out, status, iterations,
    )  # fmt: skip
    run_ranges(lambda first, last: shape_points(first, last, *fixed), n, POINTS_AT_ONCE)
    out[status != 0, :4] = np.nan
    out[status != 0, 6:] = np.nan
    covariance = out[:, [6, 7, 7, 8]].reshape(n, 2, 2)
    return ShapeFit(
        w=out[:, :3], epipolar_px=out[:, 3], epipolar_sigma_px=np.sqrt(out[:, 8]), zncc=out[:, 4:5], noise=out[:, 5],
        covariance=covariance, iterations=iterations, status=status,
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
        (N, 3) start values of ``w``.
    start_G
        (N, 3, 3) start values of ``G``; no motion when left out.
    options
        Defaults to ``MatchOptions()``.

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
    w = _starts("start_w", start_w, (n, 3))
    G = _starts("start_G", no_motion(pair, xy) if start_G is None else start_G, (n, 3, 3))
    out = np.full((n, N_MOTION_OUT), np.nan)
    status, iterations = np.zeros(n, np.int8), np.zeros(n, np.int32)
    pose = pair.cam2_from_cam1
    setting = (*_setting(options), options.patch == "rigid")
    fixed = (
        images[0].pixels, images[0].gradients, _flat(images[1]), _flat(images[2]), _flat(images[3]),
        _lens(pair.cam1), _lens(pair.cam2), _own(pose.rotation), _own(pose.translation_mm), xy, w, G, setting, out,
        status, iterations,
    )  # fmt: skip
    run_ranges(lambda first, last: motion_points(first, last, *fixed), n, POINTS_AT_ONCE)
    out[status != 0, :13] = np.nan
    out[status != 0, 17:] = np.nan
    covariance = out[:, 17:].reshape(n, 5, 5)
    return MotionFit(
        w=out[:, :3], G=out[:, 3:12].reshape(n, 3, 3), epipolar_px=out[:, 12],
        epipolar_sigma_px=np.sqrt(covariance[:, 4, 4]), zncc=out[:, 13:16], noise=out[:, 16], covariance=covariance,
        iterations=iterations, status=status,
    )  # fmt: skip


def _points(xy_px: ArrayLike) -> tuple[Float, int]:
    xy = np.array(xy_px, dtype=np.float64, order="C")
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise InputError(f"xy_px has shape {xy.shape}, it must be (N, 2).", code="shape_mismatch")
    return xy, xy.shape[0]


def _starts(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Float:
    array = np.array(values, dtype=np.float64, order="C")
    if array.shape != shape:
        raise InputError(f"{name} has shape {array.shape}, it must be {shape}.", code="shape_mismatch")
    return array


def _setting(options: MatchOptions) -> tuple[Any, ...]:
    return (
        options.subset_px, SPLINE_ORDER[options.interpolation], options.max_iterations, options.tolerance_px,
        options.max_sigma_px, options.max_step_px,
    )  # fmt: skip


def _flat(image: ImageData) -> tuple[Any, ...]:
    rows, cols = image.shape
    return image.coefficients.ravel(), rows, cols, cols + 2 * PAD


def _lens(camera: Camera) -> Float:
    return _own(camera.lens.kernel_parameters())


def _own(array: Float) -> Float:
    # the kernels are compiled for writable contiguous arrays; a read-only one would compile them again
    return np.array(array, dtype=np.float64)
