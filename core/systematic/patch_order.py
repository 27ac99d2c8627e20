"""The bias of patches of limited order, estimated from the field that they measured.

A plane patch averages the surface and the displacement below it: it is off by half the second derivative times the
subset's second moment, (h^2 - 1) / 12 px^2 along either axis. A curved patch follows second derivatives and has the
fourth ones' bias: 3 a^4 / 35 and a^4 / 9 of the Taylor terms x^4 and x^2 y^2, a half the subset. Inverse depth and the
motion in its measure are linear in the image for planes that move; their differences over neighbours give the
derivatives: a subset away, where the noise is their own, of quadratic patches half a subset.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.patch import format_length
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import steps_px
from stereorig.core.systematic.term import Term, figure_of

_NAMES = ("x_um", "y_um", "z_um"), ("u_um", "v_um", "w_um")
_FAR_SUBSETS = 2.0  # neighbours further away say little about a subset
_TO_UM = 1e3


def patch_term(field: Field, pair: StereoPair, *, subset_px: int) -> Term:
    """Estimate the bias of a field's patches.

    Parameters
    ----------
    field
        As it was measured, on a regular grid.
    pair
        The cameras.
    subset_px
        Width of the subset.

    Returns
    -------
    Term
        Bias of X, Y, Z for a shape, of U, V, W for a displacement, um.
    """
    if field.patch is None:
        return Term("Not known: the field has no record of its patches.")
    if (off_mm := field.patch.taken_off_mm) is not None:
        return Term(f"plane patches: {format_length(off_mm)} (rms) by the slopes about each point, taken off.")
    step = steps_px(field)
    curved = field.patch.patch == "quadratic"
    # fourth derivatives need neighbours twice as far, half a subset apart: their noise has little part in them
    apart_px = 0.5 * subset_px if curved else float(subset_px)
    lags = tuple(max(1, int(np.ceil(apart_px / s))) for s in step)
    reach = 2 if curved else 1
    if any(lag * s > _FAR_SUBSETS * subset_px for lag, s in zip(lags, step, strict=True)) or (
        field.shape[0] < 2 * reach * lags[1] + 1 or field.shape[1] < 2 * reach * lags[0] + 1
    ):
        return Term("Not known: too few points are far enough apart.")
    off, noise = _fourth(field, pair, lags, step, subset_px) if curved else _second(field, pair, lags, step, subset_px)
    if field.patch_degree is not None:  # quadratic patches among plane ones have no bias by second derivatives
        off[field.patch_degree == 2] = np.nan
    names = _NAMES[1 if field.has_motion else 0]
    # neighbouring estimates a subset apart are independent
    share = float(np.prod([min(s / subset_px, 1.0) for s in step]))
    figures = {}
    for k, name in enumerate(names):
        figure = figure_of(_TO_UM * off[..., k], _TO_UM**2 * noise[..., k], independent=share)
        if figure is not None:
            figures[name] = figure
    if not figures:
        return Term("Not known: too few points have neighbours at that distance.")
    what = "fourth" if curved else "second"
    kind = "quadratic" if curved else "plane"
    return Term(
        f"{kind} patches: {what} derivatives from differences over neighbours {lags[0]} points away, times the "
        f"subset's moments; noise of {'displacement' if field.has_motion else 'position'} taken off.",
        figures,
    )


def _measures(field: Field, pair: StereoPair) -> tuple[Float, Callable[[Float], Float]]:
    """(r, c, m) quantities that planes make linear in the image; and the errors (r, c, 3), mm, by errors of these."""
    camera = pair.cam1.cam_from_sys
    at = camera.apply(field.xyz_mm)
    w = 1.0 / at[..., 2:]
    ray = at * w
    if field.uvw_mm is None:
        return w, lambda off: off * (-ray / w**2) @ camera.rotation
    G = camera.apply(field.xyz_mm + field.uvw_mm) * w
    by_w = -(G - ray) / w**2
    return np.concatenate([w, G], axis=-1), lambda off: (off[..., :1] * by_w + off[..., 1:] / w) @ camera.rotation


def _second(
    field: Field, pair: StereoPair, lags: tuple[int, ...], step: tuple[float, float], subset_px: int
) -> tuple[Float, Float]:
    """(r, c, 3) bias of planes, mm, and the variance of the estimate, mm^2."""
    values, to_mm = _measures(field, pair)
    moment = (subset_px**2 - 1) / 24.0
    own = _own_variance(field)
    bend, noise = np.zeros_like(values), np.zeros_like(own)
    for axis, lag, s in ((1, lags[0], step[0]), (0, lags[1], step[1])):
        scale = moment / (lag * s) ** 2
        bend += scale * _stencil(values, (1.0, -2.0, 1.0), axis, lag)
        noise += scale**2 * _stencil(own, (1.0, 0.0, 1.0), axis, lag)
    both = 2.0 * moment * sum(1.0 / (lag * s) ** 2 for lag, s in zip(lags, step, strict=True))
    return to_mm(bend), noise + both**2 * own


def _fourth(
    field: Field, pair: StereoPair, lags: tuple[int, ...], step: tuple[float, float], subset_px: int
) -> tuple[Float, Float]:
    """(r, c, 3) bias of quadratics, mm, and the variance of the estimate, mm^2."""
    values, to_mm = _measures(field, pair)
    own = _own_variance(field)
    a4 = (0.5 * subset_px) ** 4
    bend, noise = np.zeros_like(values), np.zeros_like(own)
    for axis, lag, s in ((1, lags[0], step[0]), (0, lags[1], step[1])):
        scale = a4 * 3.0 / 35.0 / 24.0 / (lag * s) ** 4
        bend -= scale * _stencil(values, (1.0, -4.0, 6.0, -4.0, 1.0), axis, lag)
        noise += scale**2 * _stencil(own, (1.0, 16.0, 36.0, 16.0, 1.0), axis, lag)
    scale = a4 / 9.0 / 4.0 / (lags[0] * step[0] * lags[1] * step[1]) ** 2
    inner = _stencil(values, (1.0, -2.0, 1.0), 1, lags[0])
    bend -= scale * _stencil(inner, (1.0, -2.0, 1.0), 0, lags[1])
    spread = _stencil(own, (1.0, 4.0, 1.0), 1, lags[0])
    noise += scale**2 * _stencil(spread, (1.0, 4.0, 1.0), 0, lags[1])
    return to_mm(bend), noise


def _own_variance(field: Field) -> Float:
    """(r, c, 3) variance of the quantities that the bias is stated for, from the points' own noise."""
    diagonal = np.diagonal(field.covariance, axis1=-2, axis2=-1)
    return np.asarray(diagonal[..., 3:] if field.has_motion else diagonal[..., :3])


def _stencil(values: Float, weights: tuple[float, ...], axis: int, lag: int) -> Float:
    """Weighted sum (r, c, m) over points ``lag`` apart along an axis; NaN if one is missing."""
    out = np.full(values.shape, np.nan)
    reach = (len(weights) // 2) * lag
    size = values.shape[axis]
    inner = [slice(None)] * values.ndim
    inner[axis] = slice(reach, size - reach)
    total: Float = np.zeros(out[tuple(inner)].shape)
    for k, weight in enumerate(weights):
        part = [slice(None)] * values.ndim
        part[axis] = slice(k * lag, size - 2 * reach + k * lag)
        if weight != 0.0:
            total = total + weight * values[tuple(part)]
    out[tuple(inner)] = total
    return out
