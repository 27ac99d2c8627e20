"""A model's displacement as the measurement would see it: through each point's subset, and through the smoothing.

A subset's displacement is the value at its centre of its shape function, fitted by least squares over its pixels. Here
the same shape function is fitted to the model's displacement over the subset's area on the model's surface. The effect
of the subset on a curved displacement, and of an edge that cuts it, is then in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import leggauss

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import crosses
from stereorig.core.field.smoothed import smoothed_displacement
from stereorig.core.model.surface import ModelSurface
from stereorig.core.status import PointStatus

_NODES = 4  # along each side of a subset; exact for polynomials up to degree 7
_MIN_AREA = 0.5  # share of a subset's area that must be on the model
_AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class ModelField:
    """A model's displacement at the points of a field, system frame.

    Attributes
    ----------
    field
        The measured field with the model's displacement in place of its own; valid at points where the model has one.
    distance_mm
        (r, c) height of the measured point above the model's surface, along its normal; NaN without.
    gradient
        (r, c, 3, 3) derivative of the model's displacement over the position, along its surface.
    covered
        (r, c) True for measured points over the model.
    """

    field: Field
    distance_mm: Float
    gradient: Float
    covered: Bool


def model_at_points(field: Field, surface: ModelSurface, *, subset_px: float, far_mm: float) -> ModelField:
    """Return a placed model's displacement at each valid point of a field, filtered as the measurement's is.

    Parameters
    ----------
    field
        A displacement.
    surface
        Placed in the system frame.
    subset_px
        Width of the subset that the field was measured with.
    far_mm
        A point farther from the surface than this is over no part of it.

    Notes
    -----
    A subset's pixels are on the plane of the point's neighbours in the grid; each of 4 x 4 Gauss points is projected
    onto the model. Those beyond its border, or beyond a cut, are left out of the fit, as the pixels of a masked subset
    are. Patches of the second order take a quadratic, others a plane. If the measured displacement is smoothed, the
    model's is smoothed with the same window.
    """
    valid = field.valid
    rows, cols = np.nonzero(valid)
    x = field.xyz_mm[rows, cols]
    feet = surface.feet(x, within_mm=far_mm)
    normal = surface.normals[feet.triangle]
    away = x - np.einsum("nk,nka->na", feet.weight, surface.corners_mm[feet.triangle])
    towards = field.normal_sys[rows, cols]
    sign = np.where(np.einsum("na,na->n", normal, towards) < 0.0, -1.0, 1.0)
    height = sign * np.einsum("na,na->n", away, normal)
    across = _across(field)[rows, cols]  # (n, 3, 2)
    side = np.linalg.norm(across, axis=1).max(axis=1)
    covered = (feet.beyond_mm <= 0.25 * subset_px * side) & (np.abs(height) <= far_mm)
    value = np.full((len(x), 3), np.nan)
    order = 2 if field.patch is not None and field.patch.patch == "quadratic" else 1
    for first in range(0, len(x), _AT_ONCE):
        some = np.flatnonzero(covered[first : first + _AT_ONCE]) + first
        at = np.stack([field.x_px[rows[some], cols[some]], field.y_px[rows[some], cols[some]]], axis=-1)
        value[some] = _through_subset(x[some], across[some], at, field, surface, subset_px, order, far_mm)
    covered &= np.isfinite(value).all(axis=1)
    value[~covered] = np.nan
    filled = {
        "uvw": np.full((*field.shape, 3), np.nan),
        "height": np.full(field.shape, np.nan),
        "gradient": np.full((*field.shape, 3, 3), np.nan),
    }
    at_point = rows[covered], cols[covered]
    filled["uvw"][at_point] = value[covered]
    filled["height"][at_point] = height[covered]
    filled["gradient"][at_point] = surface.gradient(feet.triangle[covered])
    over = np.zeros(field.shape, bool)
    over[at_point] = True
    made = replace(_masked(field, over), uvw_mm=filled["uvw"])
    if field.smoothing is not None:
        how = field.smoothing
        made = smoothed_displacement(
            replace(made, smoothing=None), how.window, subset_px=round(subset_px), order=how.order
        )
        made = replace(made, covariance=field.covariance)
    return ModelField(made, filled["height"], filled["gradient"], over)


def _masked(field: Field, kept: Bool) -> Field:
    """Return the field with points that are not kept marked as masked."""
    lost = field.valid & ~kept
    status = np.where(lost, np.int8(PointStatus.MASKED), field.status).astype(np.int8)
    return replace(field, status=status)


def _across(field: Field) -> Float:
    """(r, c, 3, 2): how the position changes per pixel along the rows and the columns, from the points about each."""
    valid, step_x, step_y = field.valid, _step(field.x_px, 1), _step(field.y_px, 0)
    out = np.full((*field.shape, 3, 2), np.nan)
    xyz = np.where(valid[..., None], field.xyz_mm, np.nan)
    for axis, step in ((1, step_x), (0, step_y)):
        before, after = np.full_like(xyz, np.nan), np.full_like(xyz, np.nan)
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        change = (xyz[tuple(high)] - xyz[tuple(low)]) / step
        before[tuple(high)], after[tuple(low)] = change, change
        both = np.stack([before, after])
        count = np.isfinite(both).sum(axis=0)
        mean = np.divide(np.nansum(both, axis=0), count, out=np.full_like(xyz, np.nan), where=count > 0)
        out[..., 1 - axis] = mean
    middle = np.full((3, 2), np.nan)
    if np.isfinite(out).any():
        middle = np.nanmedian(out.reshape(-1, 3, 2), axis=0)
    return np.where(np.isfinite(out), out, middle)


def _step(xy: Float, axis: int) -> float:
    return float(np.diff(xy, axis=axis).flat[0]) if xy.shape[axis] > 1 else 1.0


def _through_subset(
    x: Float,
    across: Float,
    at_px: Float,
    field: Field,
    surface: ModelSurface,
    subset_px: float,
    order: int,
    far_mm: float,
) -> Float:
    """(n, 3) values at the centre of polynomials fitted to the surface's displacement over subsets; NaN without."""
    node, weight = leggauss(_NODES)
    a, b = (0.5 * subset_px * v.ravel() for v in np.meshgrid(node, node))
    w = np.outer(weight, weight).ravel() / 4.0
    points = x[:, None, :] + np.einsum("nak,kq->nqa", across, np.stack([a, b]))
    width = np.linalg.norm(across, axis=1).max(axis=1) * subset_px
    feet = surface.feet(points.reshape(-1, 3), within_mm=far_mm + float(width.max(initial=0.0)))
    on = feet.beyond_mm.reshape(len(x), -1) <= 1e-6 * width[:, None]
    if field.cuts:
        to = at_px[:, None, :] + np.stack([a, b], axis=-1)
        on &= ~crosses(at_px[:, None, :], to, field.cuts)
    u = surface.displacement_at(feet).reshape(len(x), -1, 3)
    half = 0.5 * subset_px
    terms = [np.ones_like(a), a / half, b / half]
    if order == 2:
        terms += [(a / half) ** 2, a * b / half**2, (b / half) ** 2]
    A = np.stack(terms, axis=-1)
    out = np.full((len(x), 3), np.nan)
    held = (on * w).sum(axis=1)
    good = held >= _MIN_AREA
    if good.any():
        each = (on[good] * w)[:, :, None] * A
        H = np.swapaxes(each, 1, 2) @ A
        out[good] = np.linalg.solve(H, np.swapaxes(each, 1, 2) @ u[good])[:, 0]
    return out
