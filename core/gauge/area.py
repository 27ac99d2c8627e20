"""Statistics over an area, with the uncertainty of the mean of overlapping subsets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Bool, Float, Floats
from stereorig.core.common.factor import Causes
from stereorig.core.errors import RegionError
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.shared_pixels import SharedPixels, steps_px
from stereorig.core.field.region.region import PointGrid
from stereorig.core.gauge.reading import MISSING, Reading, reading_of


@dataclass(frozen=True)
class AreaStatistics:
    """Statistics of one variable over the measured points of an area.

    Attributes
    ----------
    count
        Points with a value.
    points
        Points of the grid in the area, valid or not.
    mean, sd, minimum, maximum, rms
        Statistics of the values; ``sd`` about the mean, with count - 1. NaN without values. NaN without values.
    mean_sigma
        Standard uncertainty of the mean, from the points' noise, their common pixels and their common factor; NaN if it
        is unknown.
    mean_sigma_calibration
        The common factor's part of it; NaN if that is not known and not included.
    mean_reading
        The mean with its budget.
    """

    count: int
    points: int
    mean: float
    sd: float
    minimum: float
    maximum: float
    rms: float
    mean_sigma: float
    mean_sigma_calibration: float = float("nan")
    mean_reading: Reading = MISSING

    def with_mean_variance(
        self, own: float, frozen: float | None, common: Float | None, causes: Causes | None
    ) -> AreaStatistics:
        """Return them with another uncertainty of the mean, from arguments as in :func:`reading_of`."""
        mean = reading_of(self.mean, own, frozen, common, causes)
        return replace(self, mean_sigma=mean.sigma, mean_sigma_calibration=mean.sigma_calibration, mean_reading=mean)


def points_within(field: Field, polygon_px: ArrayLike | None) -> Bool:
    """Return (r, c) True for points in a polygon (n, 2) of camera 1's reference image, its border included.

    Parameters
    ----------
    field
        Gives the grid.
    polygon_px
        Corners in order; None for the whole field.

    Raises
    ------
    RegionError
        ``gauge_outside`` if no point of the grid is inside; ``region_unusable`` or ``region_empty`` for no polygon.
    """
    if polygon_px is None:
        return np.ones(field.shape, bool)
    x0, y0, x1, y1 = field.x_px[0, 0], field.y_px[0, 0], field.x_px[-1, -1], field.y_px[-1, -1]
    grid = PointGrid(field.x_px, field.y_px, np.ones(field.shape, bool), max(steps_px(field)), (x0, y0, x1, y1))
    inside = grid.within_polygon(polygon_px).allowed
    if not inside.any():
        raise RegionError(
            f"No point of the field lies in the area; its points have a spacing of {steps_px(field)[0]:g} px from "
            f"({x0:g}, {y0:g}) to ({x1:g}, {y1:g}) px.",
            code="gauge_outside",
            remedy="Give an area that holds measurement points, in pixels of camera 1's reference image.",
        )
    return inside


def area_statistics(
    field: Field,
    values: Float,
    sigma: Float | None,
    inside: Bool,
    *,
    shared: SharedPixels,
    common: Floats | None = None,
    sigma_reference: Float | None = None,
) -> AreaStatistics:
    """Return the statistics of values over an area.

    Parameters
    ----------
    field
        Gives the grid and the valid points.
    values
        (r, c) any variable of the field.
    sigma
        (r, c) its own standard deviations; None if they are not known.
    inside
        (r, c) the area, see :func:`points_within`.
    shared
        The correlation of neighbouring points.
    common
        (r, c, k) the variable's common factor, which a mean does not reduce.
    sigma_reference
        (r, c) the reference pair's part of the own standard deviations; None if it is not known separately.
    """
    used = inside & field.valid & np.isfinite(values)
    v = values[used]
    n = int(v.size)
    mean = MISSING

    def variance(own: Float) -> float:
        s = np.where(used, own, 0.0)
        return float(np.sum(s * shared.summed(field, s))) / n**2

    if n:
        mean = Reading(float(v.mean()), float("nan"))
    if n and sigma is not None and np.isfinite(sigma[used]).all():
        frozen = None if sigma_reference is None else variance(sigma_reference)
        row = None if common is None else np.asarray(common[used].mean(axis=0, dtype=np.float64))
        mean = reading_of(mean.value, variance(sigma), frozen, row, field.causes)
    if not n:
        nan = float("nan")
        return AreaStatistics(0, int(inside.sum()), nan, nan, nan, nan, nan, nan)
    return AreaStatistics(
        count=n,
        points=int(inside.sum()),
        mean=mean.value,
        sd=float(v.std(ddof=1)) if n > 1 else float("nan"),
        minimum=float(v.min()),
        maximum=float(v.max()),
        rms=float(np.sqrt(np.mean(v**2))),
        mean_sigma=mean.sigma,
        mean_sigma_calibration=mean.sigma_calibration,
        mean_reading=mean,
    )
