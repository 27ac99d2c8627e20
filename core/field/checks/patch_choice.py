"""Choice of a field's patch: the user's, or the one with the smaller total error on this field.

A plane patch on a curved surface has a bias of half the curvature times the subset's second moment; a curved patch has
none, and about twice the noise. The bias is estimated from the field that plane patches measured. If it could exceed
the noise, ``auto`` compares both on the field itself: a sample of its points is fitted both ways. Because of noise the
two results differ by the difference of their covariances (the plane patch is the more precise of the two as long as it
has no bias, so their difference is independent of it); any further difference is the bias.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.checks.plane_error import PlaneError
from stereorig.core.field.checks.residual_test import AS_NOISE, residual_factors
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.patch import PatchChoice, UsedPatch, format_length
from stereorig.core.matching.geometry import covariance_xyz, covariance_xyzuvw, motion_geometry, shape_geometry

_SAMPLE = 256
_MIN_POINTS = 16
_SHARE = 0.7
_FAR_PX = 1.0
_TRIMMED = 0.02
_CLEARLY = 1.1
_CURVED_NOISE = 1.9  # over a plane patch's: the root of 3.5 for gradients alike all over the subset, as measured
_SURELY = 1.0
_EXPLAINED = 1.5  # standard deviation of a curved patch's residuals over the sample's median


def advise(choice: PatchChoice, estimate: PlaneError | None) -> PatchChoice:
    """Return the user's choice of plane patches with their bias, and advice if quadratic ones have less total error.

    Parameters
    ----------
    choice
        The user's choice.
    estimate
        Bias and noise of the field's plane patches; None if they could not be estimated.
    """
    if estimate is None or choice.patch == "quadratic":
        return choice
    choice = replace(choice, plane_error_mm=estimate.error_mm, plane_noise_mm=estimate.noise_mm)
    if np.hypot(estimate.error_mm, estimate.noise_mm) <= _CLEARLY * _CURVED_NOISE * estimate.noise_mm:
        return choice
    text = (
        f"plane patches have a bias of {format_length(estimate.error_mm)} (rms) in {_quantity(choice.patch)} here, "
        f"besides {format_length(estimate.noise_mm)} of noise; quadratic ones would have the smaller total error"
    )
    return replace(choice, quadratic_advised=True, reason=f"{choice.reason}; {text}")


def choose_patch(fitter: Fitter, points: PointFits, xy_px: Float, estimate: PlaneError | None) -> PatchChoice:
    """Decide between the plane patches that a field was measured with, and quadratic ones.

    Parameters
    ----------
    fitter
        The matcher, with plane patches.
    points
        (n) the field's points, fitted and checked.
    xy_px
        (n, 2) their image coordinates in camera 1.
    estimate
        Bias and noise of the plane patches, or None if the field is too small to estimate them.

    Returns
    -------
    PatchChoice
        ``quadratic`` if that leaves clearly (1.1 times) less error in all, rms over a sample of the field.
    """
    plane: UsedPatch = "plane" if fitter.comparisons == 1 else "affine"
    if estimate is not None and estimate.below_mm < _SURELY * estimate.noise_mm:
        text = (
            f"plane patches have a bias of {_format_bias(estimate)} (rms) in {_quantity(plane)} here and "
            f"{format_length(estimate.noise_mm)} of noise besides; quadratic ones have about "
            f"{_CURVED_NOISE:g} times that noise"
        )
        return replace(
            _simple(plane, f"{plane}: {text}", 0), plane_error_mm=estimate.error_mm, plane_noise_mm=estimate.noise_mm
        )
    ok = np.flatnonzero(points.ok)
    index = np.sort(np.random.default_rng(1).choice(ok, min(_SAMPLE, len(ok)), replace=False))
    curved_fitter = fitter.curved()
    if len(index) < _MIN_POINTS:
        return _simple(plane, f"{plane}: too few valid points to distinguish curvature from noise", len(index))
    xy, flat = xy_px[index], points.take(index)
    start_G = None if fitter.comparisons == 1 else flat.G
    curved = curved_fitter.fit(xy, flat.w, start_G)
    good = curved.ok & ~curved_fitter.far_from_start(xy, curved, flat.w, start_G, _FAR_PX)
    if good.mean() < _SHARE or good.sum() < _MIN_POINTS:
        share = f"{100.0 * (1.0 - good.mean()):.0f} %"
        return _simple(plane, f"{plane}: quadratic patches do not converge on {share} of the points tried", len(index))
    # points that neither patch fits, as a subset across an edge, show nothing of curvature
    explained = good & (curved.noise <= _EXPLAINED * np.median(curved.noise[good]))
    kept = np.flatnonzero(explained if explained.sum() >= _MIN_POINTS else good)
    a, b = flat.take(kept), curved.take(kept)
    _count_residuals(curved_fitter, a, b, xy[kept])
    return decide(*_compared(fitter, xy[kept], a, b), plane=plane)


def decide(difference_mm: Float, plane_mm2: Float, curved_mm2: Float, *, plane: UsedPatch) -> PatchChoice:
    """Decide from a sample that was fitted both ways.

    Parameters
    ----------
    difference_mm
        (n, 3) curved minus plane result.
    plane_mm2, curved_mm2
        (n,) variances (traces of the covariances) of both.
    plane
        Name of the plane patch.

    Returns
    -------
    PatchChoice
        The choice with its reason.

    Notes
    -----
    Mean square of the difference = square of the plane patch's error + (curved - plane) variance: Hausman's test.
    The two per cent of the sample with the largest difference relative to their noise are left out: a wrong fit must
    not decide.

    References
    ----------
    Hausman, Econometrica 46 (1978), doi:10.2307/1913827
    """
    # an image matched with itself has none
    noise = np.maximum(np.maximum(curved_mm2 - plane_mm2, 0.05 * curved_mm2), np.finfo(np.float64).tiny)
    square = (difference_mm**2).sum(axis=1)
    used = np.argsort(square / noise)[: len(square) - int(np.ceil(_TRIMMED * len(square)))]
    error2 = max(float(np.mean(square[used] - noise[used])), 0.0)
    plane2, curved2 = float(np.mean(plane_mm2[used])), float(np.mean(curved_mm2[used]))
    error, plane_noise, curved_noise = np.sqrt([error2, plane2, curved2])
    curved = np.sqrt(error2 + plane2) > _CLEARLY * curved_noise
    # the smallest bias that this sample can show: two standard deviations of a mean of squares
    shown = float(np.mean(noise[used])) * 2.0 * np.sqrt(2.0 / len(used))
    bias = format_length(error) if error2 > shown else f"less than {format_length(np.sqrt(error2 + shown))}"
    numbers = (
        f"plane patches have a bias of {bias} (rms) in {_quantity(plane)} here and {format_length(plane_noise)} of "
        f"noise besides; quadratic ones have {format_length(curved_noise)} of noise"
    )
    return PatchChoice(
        patch="quadratic" if curved else plane,
        asked="auto",
        reason=f"{'quadratic' if curved else plane}: {numbers}",
        sample=len(used),
        plane_error_mm=float(error),
        plane_noise_mm=float(plane_noise),
        quadratic_noise_mm=float(curved_noise),
    )


def _compared(fitter: Fitter, xy: Float, a: PointFits, b: PointFits) -> tuple[Float, Float, Float]:
    """Difference (n, 3) of curved ``b`` and plane ``a``, mm, and the variances (n,) of both."""
    pair = fitter.pair

    def values_of(p: PointFits) -> tuple[Float, Float]:
        if fitter.comparisons == 1:
            return shape_geometry(pair, xy, p.w).xyz_mm, covariance_xyz(pair, xy, p.w, p.covariance)
        cov = covariance_xyzuvw(pair, xy, p.w, p.G, p.covariance)
        return motion_geometry(pair, xy, p.w, p.G).uvw_mm, cov[:, 3:, 3:]

    (one, cov_one), (two, cov_two) = values_of(a), values_of(b)
    return two - one, np.trace(cov_one, axis1=1, axis2=2), np.trace(cov_two, axis1=1, axis2=2)


def _count_residuals(curved_fitter: Fitter, a: PointFits, b: PointFits, xy_px: Float) -> None:
    """Raise the variances of both patches by the residuals of the curved one if these are not noise.

    The loss of texture by blur or the view is noise of both results, and no curvature.
    """
    factor = residual_factors(curved_fitter, b, xy_px)
    root = np.sqrt(np.where(factor > AS_NOISE[1], factor, 1.0))
    for points in (a, b):
        points.covariance *= root[:, None] * root[None, :]


def _simple(plane: UsedPatch, reason: str, sample: int) -> PatchChoice:
    return PatchChoice(patch=plane, asked="auto", reason=reason, sample=sample)


def _format_bias(estimate: PlaneError) -> str:
    return (
        format_length(estimate.error_mm)
        if estimate.error_mm > 0.7 * estimate.below_mm
        else f"less than {format_length(estimate.below_mm)}"
    )


def _quantity(patch: UsedPatch) -> str:
    return "position" if patch == "plane" else "displacement"
