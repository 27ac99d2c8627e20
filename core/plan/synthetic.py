"""Fields of a planned measurement: points on the target's plane with the matching's expected noise.

They are fields as a measurement returns them, so that its own functions read lengths, means and strain off them. The
noise is stored separately for the pair of images that causes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import ParameterCovariance, factor_of
from stereorig.core.common.matches import match_gain, noise_covariances
from stereorig.core.field.points.result import Field
from stereorig.core.names import Cause
from stereorig.core.plan.settings import PlannedMeasurement
from stereorig.core.status import PointStatus

_NORMAL = np.array([0.0, 0.0, 1.0])
Sizes = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True, eq=False)
class PlannedField:
    """A field, and the noise of its two parts.

    Attributes
    ----------
    field
        Its covariance is the sum of both parts; without a common factor.
    reference, matching
        (r, c, n, n) covariance from the noise of the reference's pair of images and of the current one.
    points
        (m, 3) its valid points' positions, in the order of ``field.valid``.
    displaced
        (m, 3) the same at the current state; None for a shape.
    """

    field: Field
    reference: Float
    matching: Float
    points: Float
    displaced: Float | None

    def of_noise(self, covariance: Float) -> Field:
        """Return the field with one part of the noise alone."""
        return replace(self.field, covariance=covariance, common=None)

    def of_causes(self, source: ParameterCovariance) -> dict[Cause, Field]:
        """Return by cause the field with the common part alone that it makes; not those that make none."""
        found = factor_of(source, self.points, self.displaced)
        covariance = np.where(self.field.valid[..., None, None], np.zeros_like(self.field.covariance), np.nan)
        out = {}
        for cause in found.causes.separate:
            own = found.values[..., [name == cause for name in found.causes.columns]]
            if own.shape[-1] == 0:
                continue
            common = np.full((*self.field.shape, *own.shape[1:]), np.nan)
            common[self.field.valid] = own
            out[cause] = replace(self.field, covariance=covariance, common=common)
        return out


def laid_about(positions_px: Sequence[Float], step_px: float, reach: int) -> tuple[Float, Float, Bool]:
    """Return a grid of points x, y (r, c), and (r, c) True for the points about some positions.

    Parameters
    ----------
    positions_px
        (x, y) in camera 1's image; the first is on a point.
    step_px
        Distance of neighbouring points.
    reach
        Points on either side of each position's cell.
    """
    origin = np.asarray(positions_px[0])
    cells = np.floor((np.asarray(positions_px) - origin) / step_px + 1e-9).astype(np.int64)
    low, high = cells.min(axis=0) - reach, cells.max(axis=0) + reach + 1
    x, y = (origin[k] + step_px * np.arange(low[k], high[k] + 1) for k in range(2))
    wanted = np.zeros((len(y), len(x)), bool)
    for column, row in cells - low:
        wanted[row - reach : row + reach + 2, column - reach : column + reach + 2] = True
    return *np.meshgrid(x, y), wanted


def planned_field(
    pair: StereoPair,
    sizes: Sizes,
    plan: PlannedMeasurement,
    grid: tuple[Float, Float, Bool],
    translation_mm: Sequence[float] | None = None,
) -> PlannedField:
    """Return the field of points on the target's plane, a shape or after a translation.

    Parameters
    ----------
    pair, sizes
        The cameras and their images' (width, height).
    plan
        Subset, noise, pattern.
    grid
        Grid from :func:`laid_about`.
    translation_mm
        Translation of the body; None for the shape. Points whose subsets leave an image have the status OUTSIDE_IMAGE.
    """
    x, y, wanted = grid
    xy = np.stack([x, y], axis=-1)
    n = 3 if translation_mm is None else 6
    status = np.full(x.shape, PointStatus.MASKED, np.int8)
    where = wanted.copy()
    points = pair.cam1.back_project_to_plane(xy[where]).xyz_mm
    displaced = None if translation_mm is None else points + np.asarray(translation_mm, dtype=np.float64)
    half = 0.5 * plan.subset_px
    seen = np.isfinite(points).all(axis=1) & _inside(xy[where], sizes[0], half)
    seen &= _inside(pair.cam2.project(points).xy, sizes[1], half)
    if displaced is not None:
        for camera, size in zip((pair.cam1, pair.cam2), sizes, strict=True):
            seen &= _inside(camera.project(displaced).xy, size, half)
    status[where] = np.where(seen, PointStatus.OK, PointStatus.OUTSIDE_IMAGE)
    where[where] = seen
    points, displaced = points[seen], None if displaced is None else displaced[seen]
    found = match_gain(pair, points, np.broadcast_to(_NORMAL, points.shape), displaced)
    parts = noise_covariances(found.gain, found.laid, match_variance_px2(plan))

    def over_grid(values: Float, *tail: int) -> Float:
        out = np.full((*x.shape, *tail), np.nan)
        out[where] = values
        return out

    reference, matching = (over_grid(part, n, n) for part in parts)
    blank = np.full(x.shape, np.nan)
    field = Field(
        x_px=x,
        y_px=y,
        status=status,
        xyz_mm=over_grid(points, 3),
        normal_sys=over_grid(np.broadcast_to(_NORMAL, points.shape), 3),
        theta_rad=blank,
        phi_rad=blank,
        zp_mm=blank,
        zncc=np.full((*x.shape, 1 if displaced is None else 3), np.nan),
        epipolar_px=over_grid(np.zeros(len(points))),
        iterations=np.zeros(x.shape, np.int32),
        noise_grey=over_grid(np.full(len(points), plan.image_noise_grey)),
        covariance=reference + matching,
        uvw_mm=None if displaced is None else over_grid(displaced - points, 3),
    )
    return PlannedField(field, reference, matching, points, displaced)


def _inside(image_px: Float, size: tuple[int, int], half_px: float) -> Bool:
    with np.errstate(invalid="ignore"):
        inside = (image_px >= half_px - 0.5) & (image_px <= np.asarray(size) - 0.5 - half_px)
    return np.asarray(inside.all(axis=-1))


# The noise of a match from a pattern that is assumed: the Cramer-Rao bound with the matcher's own gradients.
#
# The pattern's autocorrelation is taken for a Gaussian of standard deviation s = speckle / 2.355, so that its mean
# squared gradient along one direction is (contrast / s)^2. The matcher takes gradients by a Wiener filter, i k S / (S +
# N) for a spectrum S under white noise N; the sum of their squares is the sensitivity to a shift.

_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
_STEPS = 2000


def match_variance_px2(plan: PlannedMeasurement) -> float:
    """Return the variance of a subset's shift by one image's noise, per direction, px^2.

    A comparison of two images has twice it.
    """
    contrast2, noise2 = plan.contrast_grey**2, plan.image_noise_grey**2
    return float(noise2 / (plan.subset_px**2 * _sensitivity(contrast2, correlation_px(plan), noise2)))


def correlation_px(plan: PlannedMeasurement) -> float:
    """Return the standard deviation of the Gaussian that the pattern's autocorrelation is taken for, px."""
    if plan.gradient_grey_per_px is not None:
        return plan.contrast_grey / plan.gradient_grey_per_px
    return float(plan.speckle_px / _FWHM)


def _sensitivity(contrast2: float, s_px: float, noise2: float) -> float:
    """Mean square of the filtered gradient along one direction: the integral of kx^2 S^2 / (S + N) over Nyquist's."""
    # polar, out to where the square of Nyquist frequencies ends; S falls off long before for any pattern that is seen
    k = (np.arange(_STEPS) + 0.5) * np.pi / _STEPS
    spectrum = contrast2 * 2.0 * np.pi * s_px**2 * np.exp(-0.5 * (k * s_px) ** 2)
    passed = spectrum**2 / (spectrum + noise2)
    return float((0.5 * k**2 * passed * k).sum() * (np.pi / _STEPS) / (2.0 * np.pi))
