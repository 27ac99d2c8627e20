"""The bias of strain over a window, estimated from the strain itself.

The slope of a plane over a window is the true slope averaged: along the slope by weights of second moment sum x^4 / (3
sum x^2), across it evenly. Plane patches average in addition. So the bias of strain is half its second derivatives
times these moments: the next order of the displacement over the window. Bending without strain has none.
"""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, steps_px
from stereorig.core.field.region.window import window_offsets
from stereorig.core.matching.geometry import tangent_frames
from stereorig.core.strain.result import StrainField, StrainStatus
from stereorig.core.strain.window import plane_weights
from stereorig.core.systematic.term import Term, figure_of

_NAMES = ("exx_microstrain", "eyy_microstrain", "exy_microstrain")
_MICRO = 1e6


def window_term(field: Field, strain: StrainField, *, subset_px: int) -> Term:
    """Estimate the bias that a strain's window gives it.

    Parameters
    ----------
    field
        The displacement that the strain was computed from.
    strain
        The strain.
    subset_px
        Width of the subset.

    Returns
    -------
    Term
        Bias of exx, eyy, exy in microstrain.
    """
    half = strain.options.window // 2
    step = steps_px(field)
    lag = (half + 1) // 2  # wider differences smooth the derivative more, narrower ones are noisier
    if min(field.shape) < 2 * lag + 1:
        return Term("Not known: the field is hardly wider than the window.")
    along, across = (3.0 * half**2 + 3.0 * half - 1.0) / 15.0, half * (half + 1) / 3.0
    plane = field.patch is not None and field.patch.patch != "quadratic"
    patch = tuple((subset_px**2 - 1) / 12.0 / s**2 if plane else 0.0 for s in step)
    # whole windows alone: in cut ones planes and quadratics have biases of their own, which are in sigma
    used = strain.status == StrainStatus.OK
    turns = _turns(field)
    turned = _turned(np.where(used[..., None], strain.strain, np.nan), turns)
    bends = [_second(turned, axis, lag) for axis in (1, 0)]
    # E_cc, E_rr and E_cr of the grid's columns and rows
    moments = np.array(
        [
            [along + patch[0], across + patch[1]],
            [across + patch[0], along + patch[1]],
            [0.5 * (along + across) + patch[0], 0.5 * (along + across) + patch[1]],
        ]
    )
    off = 0.5 * (moments[:, 0] * bends[0] + moments[:, 1] * bends[1])
    off = _turned(off, -turns)
    shared = SharedPixels.of(field, subset_px)
    ratio = _noise_ratio(half, lag, moments, shared, step)
    variance = np.diagonal(strain.covariance, axis1=-2, axis2=-1) * ratio
    count = strain.options.window + int(np.ceil(subset_px / min(step)))
    figures = {}
    for k, name in enumerate(_NAMES):
        figure = figure_of(_MICRO * off[..., k], _MICRO**2 * variance[..., k], independent=1.0 / count**2)
        if figure is not None:
            figures[name] = figure
    if not figures:
        return Term("Not known: too few points have strain on either side.")
    return Term(
        f"Second differences of the strain over {lag} points, times the second moments of the window's weights"
        f"{' and of the plane patches' if plane else ''}; noise of the strain taken off.",
        figures,
    )


def _turns(field: Field) -> Float:
    """(r, c) angle of the grid's columns in the strain's frame."""
    frame = tangent_frames(field.normal_sys)[..., :2]
    tangent = np.full(field.xyz_mm.shape, np.nan)
    tangent[:, 1:-1] = field.xyz_mm[:, 2:] - field.xyz_mm[:, :-2]
    x, y, z = np.moveaxis(tangent, -1, 0)
    along, across = (frame[..., 0, k] * x + frame[..., 1, k] * y + frame[..., 2, k] * z for k in range(2))
    return np.asarray(np.arctan2(across, along))


def _turned(e: Float, angle: Float) -> Float:
    """Components (r, c, 3) in axes turned by an angle (r, c)."""
    c, s = np.cos(angle), np.sin(angle)
    xx, yy, xy = e[..., 0], e[..., 1], e[..., 2]
    return np.stack(
        [
            c * c * xx + s * s * yy + 2.0 * s * c * xy,
            s * s * xx + c * c * yy - 2.0 * s * c * xy,
            s * c * (yy - xx) + (c * c - s * s) * xy,
        ],
        axis=-1,
    )


def _second(values: Float, axis: int, lag: int) -> Float:
    """Second derivative (r, c, 3) per step squared; NaN at the rim."""
    out = np.full(values.shape, np.nan)
    moved = np.moveaxis(values, axis, 0)
    np.moveaxis(out, axis, 0)[lag:-lag] = (moved[2 * lag :] - 2.0 * moved[lag:-lag] + moved[: -2 * lag]) / lag**2
    return out


def _noise_ratio(half: int, lag: int, moments: Float, shared: SharedPixels, step: tuple[float, float]) -> Float:
    """(3,) variance of the estimate over the variance of the strain itself, in whole windows."""
    offsets, _ = window_offsets(half)
    side = 2 * (half + lag) + 1
    at = np.arange(-side, side + 1)
    rho = shared.correlation(at[None, :] * step[0], at[:, None] * step[1])

    # sums over pairs of points by products of spectra, wide enough that nothing comes round
    whole = (3 * side, 3 * side)
    between = np.fft.rfft2(rho, whole)

    def spread(weights: Float) -> float:
        around = np.fft.irfft2(np.fft.rfft2(weights, whole) * between, whole)
        return float((weights * around[side : 2 * side, side : 2 * side]).sum())

    ratios = []
    for weights, moment in zip(plane_weights(half), moments, strict=False):
        window = np.zeros((side, side))
        window[offsets[:, 0] + half + lag, offsets[:, 1] + half + lag] = weights
        together = np.zeros((side, side))
        for axis, m in zip((1, 0), moment, strict=True):
            second = np.roll(window, lag, axis) + np.roll(window, -lag, axis) - 2.0 * window
            together += 0.5 * m * second / lag**2
        ratios.append(spread(together) / spread(window))
    return np.array([*ratios, float(np.mean(ratios))])
