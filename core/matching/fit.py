"""Fit many points at once: the narrow functions before the compiled kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import ImageError, InputError
from stereorig.core.matching.arguments import (
    Int,
    VisiblePixels,
    WarpedImages,
    assumed_variance,
    degree_of,
    given_to_kernels,
    own,
    points_of,
    run_kernel,
    starts_of,
)
from stereorig.core.matching.image import ImageData, prepare
from stereorig.core.matching.kernels.drivers import run_points, work_space
from stereorig.core.matching.kernels.motion import n_motion_out
from stereorig.core.matching.kernels.shape import n_shape_out
from stereorig.core.matching.options import MatchOptions
from stereorig.core.status import PointStatus

Status = NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Shape at N points. Numbers of points whose ``status`` is not OK are NaN, but ``zncc`` and ``noise`` stay.

    Attributes
    ----------
    w
        (N, 3) inverse depth in camera 1, 1/mm, at the point and its slopes over normalised x and y; for curved patches
        (N, 6), including the coefficients of x^2, x y and y^2 (offsets from the point).
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
    variance
        (N,) noise variance assumed in the covariance if no model states it.
    """

    w: Float
    epipolar_px: Float
    epipolar_sigma_px: Float
    zncc: Float
    noise: Float
    covariance: Float
    iterations: Int
    status: Status
    variance: Float


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Shape and motion at N points. Numbers of points whose ``status`` is not OK are NaN, but ``zncc`` stays.

    Attributes
    ----------
    w, epipolar_px, epipolar_sigma_px, noise, iterations, status, variance
        As in :class:`ShapeFit`.
    G
        (N, 3, 3): the patch in camera 1's current frame is ``G (1, X, Y)`` (scale fixed by ``w``); for curved patches
        (N, 3, 6), at ``G (1, X, Y, X^2, X Y, Y^2)``.
    zncc
        (N, 3) correlation with camera 2's reference, camera 1's current and camera 2's current image.
    covariance
        (N, 5, 5) of (w0, G00, G10, G20, epipolar offset).
    rate
        (N,) the last step's motion over the motion of the step before; NaN after a single step.
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
    variance: Float
    rate: Float


_Fit = TypeVar("_Fit", ShapeFit, MotionFit)


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
        (N, 3), or for curved patches (N, 6), start values of ``w``; a point with a start that is not finite gets the
        status NOT_SEEDED.
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
    _check_blur(images)
    xy, n = points_of(xy_px)
    degree, terms = degree_of(options)
    w = starts_of("start", start, (n,), terms)
    out = np.full((n, n_shape_out(terms)), np.nan)
    given = given_to_kernels(pair, images, xy, w, options, visible)
    status, iterations = run_kernel(run_points["shape"][degree], work_space["shape"][degree], given, out)
    failed = status != 0
    out[failed, : terms + 1] = np.nan
    out[failed, terms + 3 :] = np.nan
    covariance = out[:, [terms + 3, terms + 4, terms + 4, terms + 5]].reshape(n, 2, 2)
    fit = ShapeFit(
        w=out[:, :terms],
        epipolar_px=out[:, terms],
        epipolar_sigma_px=np.sqrt(out[:, terms + 5]),
        zncc=out[:, terms + 1 : terms + 2],
        noise=out[:, terms + 2],
        covariance=covariance,
        iterations=iterations,
        status=status,
        variance=out[:, terms + 2] ** 2,
    )
    if images[0].blur is None:
        return fit

    def sharp(before: list[ImageData], once: MatchOptions) -> ShapeFit:
        return fit_shape(pair, before[0], before[1], xy, fit.w, once, visible)

    return _with_blurred_noise(fit, images, xy, options, sharp)


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
    warped: WarpedImages | None = None,
) -> MotionFit:
    """Measure shape and motion at points of camera 1 from three comparisons at once.

    Parameters
    ----------
    pair
        The calibrated cameras.
    ref1, ref2, cur1, cur2
        Both cameras' reference and current images, raw or prepared.
    xy_px
        (N, 2) points in camera 1's reference image.
    start_w
        (N, 3), or for curved patches (N, 6), start values of ``w``.
    start_G
        (N, 3, 3), or for curved patches (N, 3, 6), start values of ``G``; no motion when left out.
    options
        Defaults to ``MatchOptions()``.
    visible
        Which pixels of the points' subsets count; all of them when left out.
    warped
        The images at the places that the starts predict. Then a single step is made from these, with images that are
        not interpolated again; a point that is further from its prediction gets the status NOT_CONVERGED.

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
    _check_blur(images)
    for i, j, camera in ((0, 2, 1), (1, 3, 2)):
        if images[i].shape != images[j].shape:
            raise ImageError(
                f"camera {camera}'s images have {images[i].shape} and {images[j].shape} rows and columns.",
                code="image_size_mismatch",
                remedy="Give images of one size per camera.",
            )
    xy, n = points_of(xy_px)
    degree, terms = degree_of(options)
    w = starts_of("start_w", start_w, (n,), terms)
    G = starts_of("start_G", no_motion(pair, xy) if start_G is None else start_G, (n, 3), terms)
    out = np.full((n, n_motion_out(terms)), np.nan)
    e = None if warped is None else own(warped.epipolar_px)
    given = given_to_kernels(pair, images, xy, w, options, visible, G=G, epipolar_px=e, warped=warped)
    status, iterations = run_kernel(run_points["motion"][degree], work_space["motion"][degree], given, out)
    failed, at = status != 0, 4 * terms
    out[failed, : at + 1] = np.nan
    out[failed, at + 5 : at + 30] = np.nan
    covariance = out[:, at + 5 : at + 30].reshape(n, 5, 5)
    fit = MotionFit(
        w=out[:, :terms],
        G=out[:, terms:at].reshape(n, 3, terms),
        epipolar_px=out[:, at],
        epipolar_sigma_px=np.sqrt(covariance[:, 4, 4]),
        zncc=out[:, at + 1 : at + 4],
        noise=out[:, at + 4],
        covariance=covariance,
        iterations=iterations,
        status=status,
        variance=out[:, at + 30],
        rate=out[:, at + 31],
    )
    if images[0].blur is None:
        return fit

    def sharp(before: list[ImageData], once: MatchOptions) -> MotionFit:
        one, two, one_now, two_now = before
        return fit_motion(pair, one, two, one_now, two_now, xy, fit.w, fit.G, once, visible)

    return _with_blurred_noise(fit, images, xy, options, sharp)


def _check_blur(images: list[ImageData]) -> None:
    if any(image.blur != images[0].blur for image in images):
        raise InputError(
            "the images were not blurred alike.", code="blur_mismatch", remedy="Prepare all images with the same blur."
        )


def _with_blurred_noise(
    fit: _Fit,
    images: list[ImageData],
    xy: Float,
    options: MatchOptions,
    sharp: Callable[[list[ImageData], MatchOptions], _Fit],
) -> _Fit:
    """Return a fit of blurred images with the covariance and the noise of such images.

    One step from the result on the images before the blur gives their noise, and detects subsets with noise alone.
    """
    blur, spread = images[0].blur, images[0].spread(options.subset_px, degree_of(options)[0])
    assert blur is not None
    assert spread is not None
    rows, cols = spread.shape
    col, row = (np.clip(np.rint(a), 0, last - 1).astype(int) for a, last in zip(xy.T, (cols, rows), strict=True))
    factor = spread[row, col].astype(np.float64)
    before = [image.sharp for image in images]
    unblurred = sharp([image for image in before if image is not None], replace(options, max_iterations=1))
    if not all(image.noise_variance for image in images):
        factor *= blur.gain * unblurred.variance / assumed_variance(images[0])
    unseen = (fit.status == PointStatus.OK) & ~np.isfinite(unblurred.variance)
    status, noise = np.where(unseen, unblurred.status, fit.status), np.sqrt(blur.gain) * unblurred.noise
    covariance = fit.covariance * factor[:, None, None]
    return replace(
        fit, status=status, noise=noise, covariance=covariance, epipolar_sigma_px=np.sqrt(covariance[:, -1, -1])
    )
