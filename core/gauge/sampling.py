"""Values between the points of the grid, never over a missing point or a cut.

Between four points along a line a cubic goes through the inner two with the slopes of their neighbours (Keys 1981,
doi:10.1109/TASSP.1981.1163711); quadratics are reproduced exactly. If one of the 4 x 4 points about a position is
missing, its cell's corners alone are used: the error between them is then up to an eighth of the curvature times the
squared spacing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereorig.core.arrays import Bool, Float, Floats
from stereorig.core.errors import RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, roots_of, steps_px
from stereorig.core.field.region.cuts import crosses
from stereorig.core.status import PointStatus

_ON_A_POINT = 1e-9
_CUT = "cut"
_ABOUT = np.arange(-1, 3)  # nodes about a position along each axis, from the lower corner of its cell
_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples at positions between points, as weighted sums of the points about them.

    Attributes
    ----------
    field
        The sampled field.
    xy_px
        (m, 2) the positions in camera 1's reference image.
    index
        (m, 16) flat indices of the points about each position.
    weight
        (m, 16) their weights, sum 1, most of them zero where the cell's corners alone are used; NaN where the position
        has no value.
    missing
        m texts: empty, or why the position has no value: the status of a point that it needs, or ``cut``.
    """

    field: Field
    xy_px: Float
    index: NDArray[np.int64]
    weight: Float
    missing: tuple[str, ...]

    @property
    def found(self) -> Bool:
        """(m,) True where the position has values."""
        return np.isfinite(self.weight[:, 0])

    def of(self, values: Floats) -> Float:
        """Interpolate values (r, c, ...) of the grid; (m, ...), NaN where missing."""
        flat = values.reshape(-1, *values.shape[2:])[self.index]
        weight = self.weight.reshape(self.weight.shape + (1,) * (values.ndim - 2))
        # a corner of no weight may be a failed point
        return np.asarray(np.where(weight == 0.0, 0.0, weight * flat).sum(axis=1))

    def common(self) -> Float | None:
        """Return the positions' common factor (m, n, k); None if the field has none."""
        return None if self.field.common is None else self.of(self.field.common)

    def reference_alone(self) -> Samples | None:
        """Return the samples with only the reference pair's noise; None if it is not known separately."""
        field = self.field.reference_alone
        return None if field is None else replace(self, field=field)

    def covariance(self, shared: SharedPixels, first: ArrayLike, second: ArrayLike) -> Float:
        """Return the own covariance between pairs of positions: from the points' and their subsets' common pixels.

        Parameters
        ----------
        shared
            The correlation of neighbouring points.
        first, second
            (k,) indices of the positions of each pair; equal ones give the position's own covariance.

        Returns
        -------
        NDArray
            (k, n, n), mm^2, n = 3 (X, Y, Z) or 6 (and U, V, W); NaN where a position has no value.
        """
        a, b = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
        n = self.field.covariance.shape[-1]
        used = np.zeros(self.field.status.size, bool)
        used[self.index[np.nan_to_num(self.weight) != 0.0]] = True
        roots = np.zeros((used.size, n, n))
        roots[used] = roots_of(self.field.covariance.reshape(-1, n, n)[used])
        x, y = self.field.x_px.ravel()[self.index], self.field.y_px.ravel()[self.index]
        out = np.empty((len(a), n, n))
        for k in range(0, len(a), _AT_ONCE):
            i, j = a[k : k + _AT_ONCE], b[k : k + _AT_ONCE]
            lag = x[i][:, :, None] - x[j][:, None, :], y[i][:, :, None] - y[j][:, None, :]
            w = self.weight[i][:, :, None] * self.weight[j][:, None, :]
            one, two = roots[self.index[i]], roots[self.index[j]]
            if shared.smoothing is None:
                w *= shared.correlation(*lag)
                second = (w @ two.reshape(len(j), -1, n * n)).reshape(len(j), -1, n, n)
                out[k : k + _AT_ONCE] = np.einsum("kiab,kicb->kac", one, second, optimize=True)
            else:  # positions and displacements decorrelate over different distances
                each = np.einsum("kiab,kjcb->kijac", one, two, optimize=True)
                out[k : k + _AT_ONCE] = np.einsum("kij,kijac,kijac->kac", w, shared.factors(*lag, n), each)
        return out

    def position_covariance(self, shared: SharedPixels) -> Float:
        """Return (3 m, 3 m) mm^2: :meth:`covariance` of X, Y, Z of all m positions together."""
        m = len(self.xy_px)
        first, second = (i.ravel() for i in np.meshgrid(np.arange(m), np.arange(m), indexing="ij"))
        blocks = self.covariance(shared, first, second)[:, :3, :3].reshape(m, m, 3, 3)
        return np.swapaxes(blocks, 1, 2).reshape(3 * m, 3 * m)


def sample(field: Field, xy_px: ArrayLike) -> Samples:
    """Sample a field between its points.

    A position is interpolated from the 4 x 4 points about it, by cubics. If one of them is invalid, or is beyond a cut
    or the grid's edge, the four corners of its cell are used, bilinearly; three if the fourth is invalid or beyond a
    cut and the position is inside their triangle; two or one for a position on the grid's lines. Else it has no value.

    Parameters
    ----------
    field
        Any field on a regular grid, with its cuts.
    xy_px
        (m, 2) positions in camera 1's reference image.

    Raises
    ------
    RegionError
        ``gauge_outside`` for a position outside the grid of points.
    """
    xy = np.atleast_2d(np.asarray(xy_px, dtype=np.float64))
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise RegionError(
            f"Positions are (n, 2) finite pixels, got an array of shape {xy.shape}.", code="gauge_unusable"
        )
    rows, cols = field.shape
    step = steps_px(field)
    origin = np.array([field.x_px[0, 0], field.y_px[0, 0]])
    f = (xy - origin) / step
    f = np.where(np.abs(f - np.rint(f)) < _ON_A_POINT, np.rint(f), f)
    last = np.array([cols - 1, rows - 1])
    outside = ((f < 0.0) | (f > last)).any(axis=1)
    if outside.any():
        x, y = xy[np.argmax(outside)]
        x1, y1 = origin + last * step
        raise RegionError(
            f"({x:g}, {y:g}) px lies outside the field, which reaches from ({origin[0]:g}, {origin[1]:g}) to "
            f"({x1:g}, {y1:g}) px.",
            code="gauge_outside",
            remedy="Lay the gauge inside the measured region, in pixels of camera 1's reference image.",
        )
    low = np.minimum(np.floor(f).astype(np.int64), np.maximum(last - 1, 0))
    high = np.minimum(low + 1, last)
    t = f - low
    ox, oy = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])  # column and row offsets of the corners
    index = np.where(oy, high[:, 1:], low[:, 1:]) * cols + np.where(ox, high[:, :1], low[:, :1])
    wide, wide_weight = _by_cubics(field, xy, low, t)
    across, down = np.where(ox, t[:, :1], 1.0 - t[:, :1]), np.where(oy, t[:, 1:], 1.0 - t[:, 1:])
    weight = across * down
    status = field.status.ravel()[index]
    failed = ~np.isin(status, (PointStatus.OK, PointStatus.EXTRAPOLATED))
    corner = np.stack([field.x_px.ravel()[index], field.y_px.ravel()[index]], axis=-1)
    cut = crosses(xy[:, None, :], corner, field.cuts)
    needed = weight > 0.0
    bad = needed & (failed | cut)
    missing = [""] * len(xy)
    for i in np.flatnonzero(bad.any(axis=1)):
        if needed[i].all() and bad[i].sum() == 1:
            k = int(np.argmax(bad[i]))
            a, b = 1.0 - across[i, 3 - k], 1.0 - down[i, 3 - k]  # from the corner opposite the bad one
            if a + b <= 1.0:
                weight[i] = 0.0
                weight[i, [3 - k, (3 - k) ^ 1, (3 - k) ^ 2]] = 1.0 - a - b, a, b
                continue
        k = int(np.argmax(np.where(bad[i], weight[i], -1.0)))
        missing[i] = PointStatus(int(status[i, k])).name.lower() if failed[i, k] else _CUT
        weight[i] = np.nan
    whole = np.isfinite(wide_weight[:, 0])
    wide[~whole, :4], wide_weight[~whole] = index[~whole], 0.0
    wide_weight[~whole, :4] = weight[~whole]
    return Samples(field, xy, wide, wide_weight, tuple(missing))


def _by_cubics(field: Field, xy_px: Float, low: NDArray[np.int64], t: Float) -> tuple[NDArray[np.int64], Float]:
    """Return (m, 16) flat indices of the points about positions and their weights, NaN if one of them is missing.

    ``low`` (m, 2) column and row of the cell's first corner, ``t`` (m, 2) position in the cell, 0 to 1.
    """
    rows, cols = field.shape
    at = low[:, None, :] + _ABOUT[:, None]  # (m, 4, 2)
    u = t[:, None, :]
    each = np.concatenate(
        [
            u * (-0.5 + u * (1.0 - 0.5 * u)),
            1.0 + u * u * (1.5 * u - 2.5),
            u * (0.5 + u * (2.0 - 1.5 * u)),
            u * u * (0.5 * u - 0.5),
        ],
        axis=1,
    )
    weight = (each[:, :, None, 1] * each[:, None, :, 0]).reshape(-1, 16)
    row, col = np.broadcast_arrays(at[:, :, None, 1], at[:, None, :, 0])
    there = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    index = (np.clip(row, 0, rows - 1) * cols + np.clip(col, 0, cols - 1)).reshape(-1, 16)
    good = there.reshape(-1, 16) & np.isin(field.status.ravel()[index], (PointStatus.OK, PointStatus.EXTRAPOLATED))
    points = np.stack([field.x_px.ravel()[index], field.y_px.ravel()[index]], axis=-1)
    good &= ~crosses(xy_px[:, None, :], points, field.cuts)
    lost = ((weight != 0.0) & ~good).any(axis=1)
    return index.astype(np.int64), np.where(lost[:, None], np.nan, weight)


# Values along a line drawn in camera 1's reference image.

MAX_POSITIONS = 100_000


def positions_along(field: Field, vertices_px: ArrayLike, count: int | None = None) -> tuple[Float, Float]:
    """Return evenly spaced positions along a polyline, both ends included.

    Parameters
    ----------
    field
        Gives the grid.
    vertices_px
        (n, 2), n >= 2.
    count
        Number of positions; None for as many as the grid's finer spacing gives.

    Returns
    -------
    xy_px, distance_px
        (m, 2) the positions, (m,) their distances along the line.

    Raises
    ------
    RegionError
        ``gauge_unusable`` for a line without length or a count under 2.
    """
    v = np.asarray(vertices_px, dtype=np.float64)
    if v.ndim != 2 or v.shape[1:] != (2,) or len(v) < 2 or not np.isfinite(v).all():
        raise RegionError("A line needs two or more finite (x, y) positions.", code="gauge_unusable")
    reach = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(v, axis=0), axis=1))])
    if reach[-1] == 0.0:
        raise RegionError("The line has no length.", code="gauge_unusable", remedy="Give two different positions.")
    if count is None:
        count = min(int(np.floor(reach[-1] / min(steps_px(field)))) + 1, MAX_POSITIONS)
        count = max(count, 2)
    if not 2 <= count <= MAX_POSITIONS:
        raise RegionError(
            f"A line of {count} positions cannot be read.",
            code="gauge_unusable",
            remedy=f"Give 2 to {MAX_POSITIONS} positions.",
        )
    at = np.linspace(0.0, reach[-1], count)
    return np.column_stack([np.interp(at, reach, v[:, 0]), np.interp(at, reach, v[:, 1])]), at
