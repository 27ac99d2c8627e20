"""Image coordinates in camera 1 of positions given in millimetres."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.errors import RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import steps_px
from stereorig.core.gauge.sampling import sample

_ROUNDS = 20
_REFINED = 5  # each round corrects for the bend of a cell in the next digits
_ON_THE_EDGE = 1e-9
_SAME = 1e-6  # share of a cell: two cells that meet there


def positions_from_mm(field: Field, xy_mm: ArrayLike) -> Float:
    """Return (m, 2) pixels of camera 1's reference image at which the reference shape has these X and Y.

    Parameters
    ----------
    field
        Gives the reference shape, in the frame of ``xy_mm``.
    xy_mm
        (m, 2) X and Y.

    Raises
    ------
    RegionError
        ``gauge_outside`` if no cell of four valid points contains a position; ``gauge_ambiguous`` if two parts of a
        surface that folds over do.
    """
    wanted = np.atleast_2d(np.asarray(xy_mm, dtype=np.float64))
    if wanted.ndim != 2 or wanted.shape[1] != 2 or not np.isfinite(wanted).all():
        raise RegionError(
            f"Positions are (n, 2) finite millimetres, got an array of shape {wanted.shape}.", code="gauge_unusable"
        )
    steps = np.array(steps_px(field))
    xy = field.xyz_mm[..., :2]
    valid = field.valid
    whole = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    row, col = np.nonzero(whole)
    corners = np.stack([xy[row, col], xy[row, col + 1], xy[row + 1, col], xy[row + 1, col + 1]], axis=1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    out, slopes = np.empty_like(wanted), np.empty((len(wanted), 2, 2))
    for k, position in enumerate(wanted):
        near = np.flatnonzero(((low <= position) & (position <= high)).all(axis=1))
        t = _inside(corners[near], position)
        held = ((t >= -_ON_THE_EDGE) & (t <= 1.0 + _ON_THE_EDGE)).all(axis=1)
        if not held.any():
            reach = ""
            if valid.any():
                (x0, y0), (x1, y1) = xy[valid].min(axis=0), xy[valid].max(axis=0)
                reach = f"; X runs from {x0:.6g} to {x1:.6g} mm there, Y from {y0:.6g} to {y1:.6g} mm"
            raise RegionError(
                f"({position[0]:g}, {position[1]:g}) mm does not lie between measured points of the reference{reach}.",
                code="gauge_outside",
                remedy="Give a position on the measured surface, in the frame requested.",
            )
        cell = near[held]
        px = np.stack([field.x_px[row[cell], col[cell]], field.y_px[row[cell], col[cell]]], axis=1) + t[held] * steps
        if np.abs(px - px[0]).max() > _SAME * steps.max():
            raise RegionError(
                f"The surface has ({position[0]:g}, {position[1]:g}) mm at more than one pixel.",
                code="gauge_ambiguous",
                remedy="Give the position in pixels, or a frame in which the surface does not fold over.",
            )
        out[k] = px[0]
        slopes[k] = _slope(corners[near[held][:1]], t[held][:1])[0] / steps
    return _refined(field, wanted, out, slopes)


def _refined(field: Field, wanted: Float, xy_px: Float, slopes: Float) -> Float:
    """Return positions (m, 2) at which :func:`sample` gives the X and Y wanted, starting from bilinear positions."""
    first, last = np.array([v[[0, -1], [0, -1]] for v in (field.x_px, field.y_px)]).T
    for _ in range(_REFINED):
        off = wanted - sample(field, xy_px).of(field.xyz_mm)[:, :2]
        step = np.linalg.solve(slopes, off[..., None])[..., 0]
        xy_px = np.clip(np.where(np.isfinite(step), xy_px + step, xy_px), first, last)
    return xy_px


def _slope(corners: Float, t: Float) -> Float:
    """Return d(X, Y) / d(across, down) (n, 2, 2) of bilinear cells."""
    a, b, c, d = (corners[:, k] for k in range(4))
    u, v = t[:, :1], t[:, 1:]
    return np.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], axis=-1)


def _inside(corners: Float, position: Float) -> Float:
    """Solve bilinear cells (n, 4, 2) for a position by Newton's method; (n, 2) across and down, NaN if it fails."""
    a, b, c, d = (corners[:, k] for k in range(4))
    t = np.full((len(corners), 2), 0.5)
    for _ in range(_ROUNDS):
        u, v = t[:, :1], t[:, 1:]
        r = (1 - u) * (1 - v) * a + u * (1 - v) * b + (1 - u) * v * c + u * v * d - position
        du, dv = (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)
        det = _cross(du, dv)
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.stack(
                [r[:, 0] * dv[:, 1] - r[:, 1] * dv[:, 0], du[:, 0] * r[:, 1] - du[:, 1] * r[:, 0]], axis=1
            )
            t = t - change / det[:, None]
        # far outside its cell the map may fold over: that position is not in this cell
        t = np.where(np.abs(t) < 10.0, t, np.nan)
    return t


def _cross(a: Float, b: Float) -> Float:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
