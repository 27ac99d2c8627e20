"""The clamped circular plate under pressure, Eq. (18), with the large-deflection term as an option.

Deflection w(r) = w0 (1 - (r/a)^2)^2 towards the cameras (-z). Linear theory: w0 = q a^4 / (64 D), D = E t^3 / (12 (1
- nu^2)).

The camera sees the face, half a thickness in front of the mid-plane. It moves in the plane by half the thickness
times the slope: u_r = (t/2) (-dw/dr), outwards where the plate bulges (Kirchhoff).

Large deflection: with w's shape kept, the mid-plane's radial displacement solves the in-plane equilibrium exactly,

    u = (w0^2 / a) (c1 p + c3 p^3 + c5 p^5 + c7 p^7),  p = r / a,
    c3 = -(3 - nu), c5 = (10 - 2 nu) / 3, c7 = -(7 - nu) / 6, c1 = (5 - 3 nu) / 6   (edge held),

and minimum energy gives w0 (1 + k (w0/t)^2) = q a^4 / (64 D), where k is 0.471 for nu = 0.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.sim.surface import PLATE, Surface

PAPER_PRESSURES_KPA = tuple(round(68.9 * n, 1) for n in range(1, 11))


@dataclass(frozen=True, kw_only=True)
class CircularPlate:
    """The plate's dimensions and material; the paper's by default.

    Attributes
    ----------
    radius_mm, thickness_mm
        Clamped radius a and thickness t.
    youngs_modulus_mpa, poisson
        E in N/mm^2, nu.
    large_deflection
        True to include the membrane's stiffness.
    """

    radius_mm: float = 13.385
    thickness_mm: float = 0.762
    youngs_modulus_mpa: float = 71.0e3
    poisson: float = 0.334
    large_deflection: bool = False

    @property
    def bending_stiffness_nmm(self) -> float:
        """D in N mm."""
        return self.youngs_modulus_mpa * self.thickness_mm**3 / (12.0 * (1.0 - self.poisson**2))

    @property
    def membrane_coefficients(self) -> tuple[float, float, float, float]:
        """(c1, c3, c5, c7) of the mid-plane's radial displacement."""
        nu = self.poisson
        return (5.0 - 3.0 * nu) / 6.0, -(3.0 - nu), (10.0 - 2.0 * nu) / 3.0, -(7.0 - nu) / 6.0

    @property
    def stiffening(self) -> float:
        """The factor k in ``w0 (1 + k (w0/t)^2)``, from the membrane's energy."""
        x, weight = leggauss(16)  # exact: the integrand is a polynomial of degree 15
        p, weight = 0.5 * (x + 1.0), 0.5 * weight
        c1, c3, c5, c7 = self.membrane_coefficients
        slope = -4.0 * p * (1.0 - p**2)
        radial = c1 + 3.0 * c3 * p**2 + 5.0 * c5 * p**4 + 7.0 * c7 * p**6 + 0.5 * slope**2
        hoop = c1 + c3 * p**2 + c5 * p**4 + c7 * p**6
        energy = np.sum(weight * p * (radial**2 + hoop**2 + 2.0 * self.poisson * radial * hoop))
        # d/dw0 of [membrane: pi E t / (1 - nu^2) energy w0^4 / a^2] against [bending: 32 pi D w0^2 / (3 a^2)]
        return float(4.0 * energy * 3.0 * 12.0 / 64.0)

    def centre_deflection_mm(self, pressure_kpa: float) -> float:
        """Return w0 at a pressure; negative pressures push the other way."""
        from scipy.optimize import brentq  # slow to load, and not every start needs it

        linear = pressure_kpa * 1e-3 * self.radius_mm**4 / (64.0 * self.bending_stiffness_nmm)
        if not self.large_deflection or linear == 0.0:
            return linear
        k = self.stiffening / self.thickness_mm**2
        size = brentq(lambda w: w * (1.0 + k * w * w) - abs(linear), 0.0, abs(linear), xtol=1e-15)
        return float(np.copysign(size, linear))

    def deflection_mm(self, r_mm: ArrayLike, pressure_kpa: float) -> Float:
        """Return w(r), towards the cameras, zero beyond the clamping."""
        q = np.minimum((np.asarray(r_mm, dtype=np.float64) / self.radius_mm) ** 2, 1.0)
        return np.asarray(self.centre_deflection_mm(pressure_kpa) * (1.0 - q) ** 2)

    def bending_strain(self, r_mm: ArrayLike, pressure_kpa: float) -> tuple[Float, Float]:
        """Radial and hoop strain of the face by linear bending, -(t/2) w'' and -(t/2) w'/r; 0 beyond the clamping."""
        q = (np.asarray(r_mm, dtype=np.float64) / self.radius_mm) ** 2
        scale = np.where(q < 1.0, 2.0 * self.thickness_mm * self._slope_per_mm(pressure_kpa), 0.0)
        return np.asarray(scale * (1.0 - 3.0 * q)), np.asarray(scale * (1.0 - q))

    def face_strain(self, r_mm: ArrayLike, pressure_kpa: float) -> tuple[Float, Float]:
        """Return the Green-Lagrange strain of the face, radial and hoop.

        With the face's u(r) and w(r),

        E_r = u' + (u'^2 + w'^2) / 2,  E_t = u/r + (u/r)^2 / 2.

        u holds bending, and the mid-plane's motion if the deflection is large. In linear theory, which does not move
        the mid-plane, the slope's part is no stretch of the material, but the described surface has it.
        """
        q = (np.asarray(r_mm, dtype=np.float64) / self.radius_mm) ** 2
        u_r, u_t = self.bending_strain(r_mm, pressure_kpa)
        if self.large_deflection:
            c1, c3, c5, c7 = self.membrane_coefficients
            scale = np.where(q < 1.0, (self.centre_deflection_mm(pressure_kpa) / self.radius_mm) ** 2, 0.0)
            u_r = u_r + scale * (c1 + q * (3.0 * c3 + q * (5.0 * c5 + q * 7.0 * c7)))
            u_t = u_t + scale * (c1 + q * (c3 + q * (c5 + q * c7)))
        slope = -4.0 * self._slope_per_mm(pressure_kpa) * np.asarray(r_mm) * np.maximum(1.0 - q, 0.0)
        return np.asarray(u_r + 0.5 * (u_r**2 + slope**2)), np.asarray(u_t + 0.5 * u_t**2)

    def _slope_per_mm(self, pressure_kpa: float) -> float:
        """Return w0 / a^2, to which all of the plate's curvatures are in proportion."""
        return self.centre_deflection_mm(pressure_kpa) / self.radius_mm**2

    def surface(self, pressure_kpa: float) -> Surface:
        """Return the face of the plate at a pressure; (s, t) are measured from its centre on the flat plate."""
        membrane = self.membrane_coefficients if self.large_deflection else (0.0, 0.0, 0.0, 0.0)
        w0 = self.centre_deflection_mm(pressure_kpa)
        return Surface(kind=PLATE, parameters=np.array([self.radius_mm, w0, 0.5 * self.thickness_mm, *membrane]))
