"""Change of the relative orientation that explains offsets across epipolar lines, with its covariance.

Robust least squares on the offsets, with a prior of the bump's own size: over a narrow field the offsets of vergence
and of the baseline's direction are nearly alike, and the prior keeps their undetermined combination small. The size
comes from the offsets too (MacKay 1992, doi:10.1162/neco.1992.4.3.415).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.orientation.change import ChangeSlopes, changed, offset_slopes, plausible_bump
from stereorig.core.orientation.matched import MatchedPoints
from stereorig.core.orientation.noise import SharedNoise, effective_variance, robust_weights

#: smallest and largest bump that the prior takes for plausible, rad
_SMALLEST_RAD, _LARGEST_RAD = 2e-5, 0.1
_FIRST_RAD = 0.01
_ITERATIONS = 60
_RANK = 1e-9
SYSTEMATIC_PX = 0.001
"""Standard deviation of smooth errors of the offsets that do not average out (interpolation, lens), a term."""


@dataclass(frozen=True, eq=False)
class OrientationEstimate:
    """A change of the relative orientation.

    Attributes
    ----------
    change
        (5,) :data:`stereorig.core.orientation.change.CHANGE_NAMES`, against the pair given.
    covariance
        (5, 5) from the offsets' noise, their systematic part and the prior.
    response
        (5, n) d(change) / d(offset), for errors of the offsets that come from elsewhere.
    bump_rad
        Size of the bump that the prior has, a standard deviation of each camera's turn about each axis.
    determined
        How many of the five the offsets determine themselves, 0 to 5.
    weights
        (n,) robust weights of the points.
    residual_px
        (n,) offsets that are left.
    noise_px
        Robust standard deviation of those.
    """

    change: Float
    covariance: Float
    response: Float
    bump_rad: float
    determined: float
    weights: Float
    residual_px: Float
    noise_px: float


def estimate_change(
    pair: StereoPair,
    points: MatchedPoints,
    offset_px: Float | None = None,
    *,
    bump_rad: float | None = None,
    start: Float | None = None,
    slopes: ChangeSlopes | None = None,
    shared: SharedNoise | None = None,
) -> OrientationEstimate:
    """Estimate the change of the relative orientation.

    Parameters
    ----------
    pair
        The cameras before the change.
    points
        Points matched in both images, six or more.
    offset_px
        (n,) the offsets to explain, small, if they are not the points' own: a difference to an earlier step.
    bump_rad
        Size of the bump, if it is known; else from the offsets.
    start
        (5,) a change to start from; none if left out.
    slopes, shared
        For these points, if they are known already: :class:`stereorig.core.orientation.change.ChangeSlopes`, without a
        start; :class:`stereorig.core.orientation.noise.SharedNoise`.

    Returns
    -------
    OrientationEstimate
        ``changed(pair, estimate.change)`` is the pair after the change.
    """
    rays = pair.rays(points.xy1_px, points.xy2_px) if slopes is None else slopes.rays
    unit, size = plausible_bump(pair), _FIRST_RAD if bump_rad is None else bump_rad
    firm = np.linalg.inv(unit)
    terms = smooth_terms(points.xy1_px)
    basis = orthonormal(terms)
    shared = SharedNoise.of(points) if shared is None else shared
    change = np.zeros(5) if start is None else np.array(start, dtype=np.float64)
    J = offset_slopes(pair, change, rays) if slopes is None or start is not None else slopes.offset

    def left_at(at: Float) -> Float:
        if offset_px is None:
            return changed(pair, at).epipolar_residual_of_rays(*rays)
        return np.asarray(offset_px + J @ at)

    for _ in range(_ITERATIONS):
        residual = left_at(change)
        if offset_px is None:
            J = offset_slopes(pair, change, rays)
        weights, _ = robust_weights(residual - smooth_surface(basis, residual))
        variance = effective_variance(J, weights, residual, shared)
        information = (J * weights[:, None]).T @ J / variance
        prior = firm / size**2
        posterior = np.linalg.inv(information + prior)
        step = -posterior @ ((J * weights[:, None]).T @ residual / variance + prior @ change)
        change = change + step
        determined = 5.0 - float(np.trace(prior @ posterior))
        if bump_rad is None:
            found = float(change @ firm @ change) / max(determined, 1.0)
            size = float(np.clip(np.sqrt(found), _SMALLEST_RAD, _LARGEST_RAD))
        if np.abs(step).max() < 1e-8:
            break
    residual = left_at(change)
    weights, noise = robust_weights(residual)
    variance = effective_variance(J, weights, residual, shared)
    information = (J * weights[:, None]).T @ J / variance
    prior = firm / size**2
    posterior = np.linalg.inv(information + prior)
    response = -posterior @ (J * weights[:, None]).T / variance
    systematic = response @ terms * SYSTEMATIC_PX
    return OrientationEstimate(
        change=change,
        covariance=posterior + systematic @ systematic.T,
        response=response,
        bump_rad=size,
        determined=5.0 - float(np.trace(prior @ posterior)),
        weights=weights,
        residual_px=residual,
        noise_px=noise,
    )


def orthonormal(terms: Float) -> Float:
    """Return an orthonormal basis (n, k) of the space of terms (n, m)."""
    basis, size, _ = np.linalg.svd(terms, full_matrices=False)
    return np.asarray(basis[:, size > _RANK * size[0]])


def smooth_surface(basis: Float, values: Float) -> Float:
    """Surface through values (n,) with outliers: least squares, then without those far off.

    ``basis`` is :func:`orthonormal` of :func:`smooth_terms`.
    """
    weights = np.ones(len(values))
    for _ in range(4):
        weighed = basis * weights[:, None]
        # six by six, and of unit size but for the weights
        surface = basis @ np.linalg.lstsq(weighed.T @ basis, weighed.T @ values, rcond=_RANK)[0]
        weights = robust_weights(values - surface)[0]
    return np.asarray(surface)
