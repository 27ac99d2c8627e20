"""Which patch a field is measured with: what was asked for, or what errs least on this field.

A plane patch on a curved surface is off by half the curvature times the subset's second moment; a curved patch is not,
and has about twice the noise. The field that plane patches measured tells what they err by. Where that could outweigh
the noise, ``auto`` weighs one against the other on the field itself: a sample of its points is fitted both ways. Noise
makes the two answers differ by the difference of their covariances (the plane patch is the more precise of the two as
long as it is right, so their difference is independent of it); what they differ by beyond that is the plane patch's
error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.arrays import Float
from core.field.checks.plane_error import PlaneError
from core.field.points.fitter import Fitter, PointFits
from core.field.points.patch import PatchChoice, UsedPatch, told_um
from core.matching.geometry import covariance_xyz, covariance_xyzuvw, motion_geometry, shape_geometry

_SAMPLE = 256
_FEWEST = 16
_SHARE = 0.7
_FAR_PX = 1.0
_NOT_HEARD = 0.02
_CLEARLY = 1.1
_CURVED_NOISE = 1.9  # over a plane patch's: the root of 3.5 for gradients alike all over the subset, as measured
_SURELY = 1.0


def advise(choice: PatchChoice, told: PlaneError | None) -> PatchChoice:
    """Return the user's choice of plane patches with what they err by, and whether curved ones would err less."""
    if told is None or choice.patch == "curved":
        return choice
    choice = replace(choice, plane_error_mm=told.error_mm, plane_noise_mm=told.noise_mm)
    if np.hypot(told.error_mm, told.noise_mm) <= _CLEARLY * _CURVED_NOISE * told.noise_mm:
        return choice
    said = (
        f"plane patches err by {told_um(told.error_mm)} (rms) in {_what(choice.patch)} here, besides "
        f"{told_um(told.noise_mm)} of noise; curved ones would err less"
    )
    return replace(choice, curved_advised=True, reason=f"{choice.reason}; {said}")


def choose_patch(fitter: Fitter, points: PointFits, xy_px: Float, told: PlaneError | None) -> PatchChoice:
    """Decide between the plane patches that a field stands with, and curved ones.

    Parameters
    ----------
    fitter
        The matcher, with plane patches.
    points
        (n) the field's points, fitted and checked.
    xy_px
        (n, 2) where they lie.
    told
        What the field says of the plane patches' error, or None.

    Returns
    -------
    PatchChoice
        ``curved`` if that leaves clearly (1.1 times) less error in all, rms over a sample of the field.
    """
    plane: UsedPatch = "plane" if fitter.comparisons == 1 else "stretch"
    if told is not None and told.below_mm < _SURELY * told.noise_mm:
        said = (
            f"plane patches err by {_told(told)} (rms) in {_what(plane)} here and have "
            f"{told_um(told.noise_mm)} of noise besides; curved ones have about {_CURVED_NOISE:g} times that noise"
        )
        return replace(
            _simple(plane, f"{plane}: {said}", 0), plane_error_mm=told.error_mm, plane_noise_mm=told.noise_mm
        )
    ok = np.flatnonzero(points.ok)
    index = np.sort(np.random.default_rng(1).choice(ok, min(_SAMPLE, len(ok)), replace=False))
    curved_fitter = fitter.curved()
    if len(index) < _FEWEST:
        return _simple(plane, f"{plane}: too few points stand to tell curvature from noise", len(index))
    xy, flat = xy_px[index], points.take(index)
    start_G = None if fitter.comparisons == 1 else flat.G
    curved = curved_fitter.fit(xy, flat.w, start_G)
    good = curved.ok & ~curved_fitter.far_from_start(xy, curved, flat.w, start_G, _FAR_PX)
    if good.mean() < _SHARE or good.sum() < _FEWEST:
        share = f"{100.0 * (1.0 - good.mean()):.0f} %"
        return _simple(plane, f"{plane}: curved patches find no place on {share} of the points tried", len(index))
    kept = np.flatnonzero(good)
    a, b = flat.take(kept), curved.take(kept)
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
        What the simple patch is called.

    Notes
    -----
    Mean square of the difference = square of the plane patch's error + (curved - plane) variance: Hausman's test.
    The two per cent of the sample that differ most, for their noise, are not heard: a wrong fit must not decide.
    """
    # an image matched with itself has none
    noise = np.maximum(np.maximum(curved_mm2 - plane_mm2, 0.05 * curved_mm2), np.finfo(np.float64).tiny)
    square = (difference_mm**2).sum(axis=1)
    heard = np.argsort(square / noise)[: len(square) - int(np.ceil(_NOT_HEARD * len(square)))]
    error2 = max(float(np.mean(square[heard] - noise[heard])), 0.0)
    plane2, curved2 = float(np.mean(plane_mm2[heard])), float(np.mean(curved_mm2[heard]))
    error, plane_noise, curved_noise = np.sqrt([error2, plane2, curved2])
    curved = np.sqrt(error2 + plane2) > _CLEARLY * curved_noise
    # what this sample could have shown, two standard deviations of a mean of squares
    shown = float(np.mean(noise[heard])) * 2.0 * np.sqrt(2.0 / len(heard))
    err = told_um(error) if error2 > shown else f"less than {told_um(np.sqrt(error2 + shown))}"
    numbers = (
        f"plane patches err by {err} (rms) in {_what(plane)} here and have {told_um(plane_noise)} of noise besides; "
        f"curved ones have {told_um(curved_noise)} of noise"
    )
    return PatchChoice(
        patch="curved" if curved else plane,
        asked="auto",
        reason=f"{'curved' if curved else plane}: {numbers}",
        sample=len(heard),
        plane_error_mm=float(error),
        plane_noise_mm=float(plane_noise),
        curved_noise_mm=float(curved_noise),
    )


def _compared(fitter: Fitter, xy: Float, a: PointFits, b: PointFits) -> tuple[Float, Float, Float]:
    """Difference (n, 3) of curved ``b`` and plane ``a``, mm, and the variances (n,) of both."""
    pair = fitter.pair

    def told(p: PointFits) -> tuple[Float, Float]:
        if fitter.comparisons == 1:
            return shape_geometry(pair, xy, p.w).xyz_mm, covariance_xyz(pair, xy, p.w, p.covariance)
        cov = covariance_xyzuvw(pair, xy, p.w, p.G, p.covariance)
        return motion_geometry(pair, xy, p.w, p.G).uvw_mm, cov[:, 3:, 3:]

    (one, cov_one), (two, cov_two) = told(a), told(b)
    return two - one, np.trace(cov_one, axis1=1, axis2=2), np.trace(cov_two, axis1=1, axis2=2)


def _simple(plane: UsedPatch, reason: str, sample: int) -> PatchChoice:
    return PatchChoice(patch=plane, asked="auto", reason=reason, sample=sample)


def _told(told: PlaneError) -> str:
    return told_um(told.error_mm) if told.error_mm > 0.7 * told.below_mm else f"less than {told_um(told.below_mm)}"


def _what(patch: UsedPatch) -> str:
    return "position" if patch == "plane" else "displacement"
