"""Strain over the grid of measurement points of one step."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Floats
from stereorig.core.strain.options import StrainOptions


class StrainStatus(IntEnum):
    """Status of the strain at a point; every status but ``OK`` means that there is none."""

    OK = 0
    NO_POINT = 1
    TOO_FEW = 2
    ONE_SIDED = 3


STRAIN_STATUS_MEANINGS: dict[StrainStatus, str] = {
    StrainStatus.OK: "computed",
    StrainStatus.NO_POINT: "the point itself was not measured",
    StrainStatus.TOO_FEW: "edges, holes or cuts leave too few points in the window",
    StrainStatus.ONE_SIDED: "the window's points lie too much on one side or on one line",
}

_NO_DIRECTION_RAD = 0.25


@dataclass(frozen=True, eq=False)
class StrainField:
    """Strain at (r, c) points, in each point's tangent frame; NaN where ``status`` is not ``OK``.

    Axis 1 is X_sys projected on the reference surface (Y_sys where the surface is normal to X_sys), axis 2 completes
    it with the normal. Strain has no unit; shear is the tensor's, half the engineering shear.

    Attributes
    ----------
    options
        Options of its computation.
    spacing_px
        Distance of neighbouring points.
    subset_px
        Width of the subset that the displacements were measured with.
    gauge_px
        Width of the virtual gauge, (window - 1) step + subset; of displacements that were smoothed over a window of w
        points (w - 1) step more.
    gauge_mm
        The same on the surface, median of the field; NaN if no strain was computed.
    status
        (r, c) int8, :class:`StrainStatus`.
    strain
        (r, c, 3) exx, eyy, exy of the gauge.
    covariance
        (r, c, 3, 3) of these, from the points' own covariances.
    common
        (r, c, 3, k) common factor of these, from the points' factor; None if it is not known.
    patch
        (r, c, 3) exx, eyy, exy of each point's own stretch patch, the same tensor; NaN where the point is not valid,
        None for rigid patches.
    raised
        (r, c) True at points whose one-sided window has quadratics in place of planes; None if no such choice was made
        or it is not known.
    """

    options: StrainOptions
    spacing_px: float
    subset_px: int
    gauge_px: float
    gauge_mm: float
    status: NDArray[np.int8]
    strain: Float
    covariance: Float
    patch: Float | None = None
    common: Floats | None = None
    raised: Bool | None = None

    @property
    def valid(self) -> Bool:
        """(r, c) True at points with a strain."""
        return np.asarray(self.status == StrainStatus.OK)

    @cached_property
    def total_covariance(self) -> Float:
        """(r, c, 3, 3) of exx, eyy, exy: own and common."""
        if self.common is None:
            return self.covariance
        return np.asarray(self.covariance + self.common @ np.swapaxes(self.common, -1, -2))

    @cached_property
    def sigma(self) -> Float:
        """(r, c, 3) standard deviations of exx, eyy, exy."""
        return np.sqrt(np.diagonal(self.total_covariance, axis1=-2, axis2=-1))

    @cached_property
    def principal(self) -> Float:
        """(r, c, 2) principal strains, the larger first."""
        return principal_of(self.strain)

    @cached_property
    def angle_rad(self) -> Float:
        """(r, c) from axis 1 to the direction of the larger principal strain, towards axis 2; -pi/2 to pi/2."""
        e = self.strain
        return np.asarray(0.5 * np.arctan2(2.0 * e[..., 2], e[..., 0] - e[..., 1]))

    @property
    def max_shear(self) -> Float:
        """(r, c) largest in-plane shear of the tensor, (e1 - e2) / 2; half the engineering shear."""
        e = self.principal
        return np.asarray(0.5 * (e[..., 0] - e[..., 1]))

    @property
    def von_mises(self) -> Float:
        """(r, c) sqrt(e1^2 - e1 e2 + e2^2). Noise alone makes it positive."""
        one, two = np.moveaxis(self.principal, -1, 0)
        return np.asarray(np.sqrt(one**2 - one * two + two**2))

    @property
    def direction_rad(self) -> Float:
        """(r, c) ``angle_rad``; NaN where it has no ``sigma_direction_rad``."""
        return np.where(np.isnan(self.sigma_direction_rad), np.nan, self.angle_rad)

    @cached_property
    def sigma_direction_rad(self) -> Float:
        """(r, c) standard deviation of ``angle_rad``, linearised; NaN above 0.25 rad: noise sets it."""
        c, s = self._double_angle
        across, shear = self._deviation(-0.5 * s, 0.5 * s, c), 2.0 * self.max_shear
        known = (across <= _NO_DIRECTION_RAD * shear) & (shear > 0.0)
        return np.where(known, across / np.where(known, shear, 1.0), np.nan)

    @property
    def sigma_max_shear(self) -> Float:
        """(r, c) standard deviation of ``max_shear``, linearised."""
        c, s = self._double_angle
        return self._deviation(0.5 * c, -0.5 * c, s)

    @property
    def sigma_von_mises(self) -> Float:
        """(r, c) standard deviation of ``von_mises``, linearised; NaN where it is zero."""
        mean = 0.25 * (self.strain[..., 0] + self.strain[..., 1])
        half = 0.75 * (self.strain[..., 0] - self.strain[..., 1])
        with np.errstate(invalid="ignore", divide="ignore"):
            return self._deviation(mean + half, mean - half, 3.0 * self.strain[..., 2]) / self.von_mises

    @property
    def _double_angle(self) -> tuple[Float, Float]:
        return np.cos(2.0 * self.angle_rad), np.sin(2.0 * self.angle_rad)

    def _deviation(self, *by: Float) -> Float:
        """(r, c) standard deviation of a quantity with these derivatives by exx, eyy, exy."""
        gradient = np.stack(by, axis=-1)
        variance = np.einsum("...i,...ij,...j", gradient, self.total_covariance, gradient)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    @property
    def sigma_principal(self) -> Float:
        """(r, c, 2) standard deviations of the principal strains, linearised: they hold where e1 - e2 exceeds these."""
        c, s = np.cos(self.angle_rad), np.sin(self.angle_rad)
        along = self._deviation(c**2, s**2, 2.0 * c * s)
        return np.stack([along, self._deviation(s**2, c**2, -2.0 * c * s)], axis=-1)


def principal_of(strain: Float) -> Float:
    """Return the principal values (..., 2), the larger first, of exx, eyy, exy (..., 3)."""
    mean = 0.5 * (strain[..., 0] + strain[..., 1])
    half_difference = np.hypot(0.5 * (strain[..., 0] - strain[..., 1]), strain[..., 2])
    return np.stack([mean + half_difference, mean - half_difference], axis=-1)
