"""Values between the points of the grid: inside one cell, never over a missing point or a cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.errors import RegionError
from core.field.cuts import crosses
from core.field.result import Field
from core.field.shared_pixels import SharedPixels, roots_of, steps_px
from core.status import PointStatus

Float = NDArray[np.float64]

_ON_A_POINT = 1e-9
_CUT = "cut"


@dataclass(frozen=True, eq=False)
class Samples:
    """Places between points, as weighted sums of the points about them.

    Attributes
    ----------
    field
        Where they were sampled.
    xy_px
        (m, 2) the places in camera 1's reference image.
    index
        (m, 4) flat indices of the corners of each place's cell.
    weight
        (m, 4) their weights, sum 1; NaN where the place is missing.
    missing
        m texts: empty, or why the place has no value: the status of a point that it needs, or ``cut``.
    """

    field: Field
    xy_px: Float
    index: NDArray[np.int64]
    weight: Float
    missing: tuple[str, ...]

    @property
    def found(self) -> NDArray[np.bool_]:
        """(m,) True where the place has values."""
        return np.isfinite(self.weight[:, 0])

    def of(self, values: Float) -> Float:
        """Interpolate values (r, c, ...) of the grid; (m, ...), NaN where missing."""
        flat = values.reshape(-1, *values.shape[2:])[self.index]
        weight = self.weight.reshape(self.weight.shape + (1,) * (values.ndim - 2))
        # a corner of no weight may be a failed point
        return np.asarray(np.where(weight == 0.0, 0.0, weight * flat).sum(axis=1))

    def covariance(self, shared: SharedPixels, first: ArrayLike, second: ArrayLike) -> Float:
        """Return the covariance between pairs of places, from the points' own and their subsets' common pixels.

        Parameters
        ----------
        shared
            The correlation of neighbouring points.
        first, second
            (k,) numbers of the places of each pair; equal ones give the place's own covariance.

        Returns
        -------
        NDArray
            (k, n, n), mm^2, n = 3 (X, Y, Z) or 6 (and U, V, W); NaN where a place is missing.
        """
        a, b = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
        n = self.field.covariance.shape[-1]
        own = self.field.covariance.reshape(-1, n, n)[self.index]
        roots = roots_of(np.where((self.weight > 0.0)[..., None, None], own, 0.0))
        x, y = self.field.x_px.ravel()[self.index], self.field.y_px.ravel()[self.index]
        r = shared.correlation(x[a][:, :, None] - x[b][:, None, :], y[a][:, :, None] - y[b][:, None, :])
        w = self.weight[a][:, :, None] * self.weight[b][:, None, :] * r
        return np.asarray(np.einsum("kij,kiab,kjcb->kac", w, roots[a], roots[b], optimize=True))


def sample(field: Field, xy_px: ArrayLike) -> Samples:
    """Lay places into the grid's cells.

    A place takes its values from the four corners of its cell, bilinearly; from three if the fourth failed or lies
    beyond a cut and the place lies inside their triangle; from two or one where it lies on the grid's lines. Else it is
    missing.

    Parameters
    ----------
    field
        Any field on a regular grid, with its cuts.
    xy_px
        (m, 2) places in camera 1's reference image.

    Raises
    ------
    RegionError
        ``gauge_outside`` for a place outside the grid of points.
    """
    xy = np.atleast_2d(np.asarray(xy_px, dtype=np.float64))
    if xy.ndim != 2 or xy.shape[1] != 2 or not np.isfinite(xy).all():
        raise RegionError(f"Places are (n, 2) finite pixels, got an array of shape {xy.shape}.", code="gauge_unusable")
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
    ox, oy = np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1])  # of the corners
    index = np.where(oy, high[:, 1:], low[:, 1:]) * cols + np.where(ox, high[:, :1], low[:, :1])
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
    return Samples(field, xy, index.astype(np.int64), weight, tuple(missing))
