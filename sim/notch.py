"""A thin sheet in tension with a notch in its middle: Inglis's ellipse, by Kolosov's and Muskhelishvili's potentials.

Body frame: x along the notch, y along the load; the notch is (x / a)^2 + (y / b)^2 < 1, in a sheet that is large beside
it, under the stress S along y, in plane stress. With z = x + i y = R (zeta + m / zeta), R = (a + b) / 2 and
m = (a - b) / (a + b),

    2 G (u + i v) = kappa phi - z conj(phi') - conj(psi),   kappa = (3 - nu) / (1 + nu),
    phi = S R / 4 (zeta - (2 + m) / zeta),
    psi = S R / 2 (zeta - ((1 + m + m^2) zeta^2 + 1) / (zeta (zeta^2 - m))),

where ' is the derivative by z. The stress at the notch's ends is S (1 + 2 a / b). (Muskhelishvili, Some Basic Problems
of the Mathematical Theory of Elasticity, paragraph 82a, tension across the longer axis.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.sim.surface import NOTCH, Surface


@dataclass(frozen=True, kw_only=True)
class NotchedSheet:
    """Notch and material; a sheet of 7075-T6 by default.

    Attributes
    ----------
    half_length_mm, half_width_mm
        a, b of the notch: across the load and along it.
    youngs_modulus_mpa, poisson
        E in N/mm^2, nu.
    """

    half_length_mm: float = 4.0
    half_width_mm: float = 2.5
    youngs_modulus_mpa: float = 71.7e3
    poisson: float = 0.33

    def surface(self, stress_mpa: float) -> Surface:
        """Return the sheet's face under a remote stress; rays that meet the notch meet nothing."""
        a, b, nu = self.half_length_mm, self.half_width_mm, self.poisson
        if not (a >= b > 0.0):
            raise ValueError(f"the notch's half length {a:g} mm must not be less than its half width {b:g} mm")
        shear_mpa = self.youngs_modulus_mpa / (2.0 * (1.0 + nu))
        kappa = (3.0 - nu) / (1.0 + nu)
        radius, m = 0.5 * (a + b), (a - b) / (a + b)
        return Surface(kind=NOTCH, parameters=np.array([radius, m, stress_mpa / (2.0 * shear_mpa), kappa]))
