"""The centre-cracked panel in tension: it straightens under load, then buckles above and below the crack.

Body frame: x along the crack, y along the load, z away from the cameras; the crack is |x| < a, y = 0. With load P,
thickness t and width W the remote stress is S = P / (W t).

In the plane: the exact field of a crack in an infinite sheet under uniaxial tension (Westergaard, plane stress),

    2 G u = (kappa-1)/2 Re F - y Im F' - (kappa+1)/4 S x,   F = S sqrt(z^2 - a^2),  z = x + i y,
    2 G v = (kappa+1)/2 Im F - y Re F' + (3-kappa)/4 S y,   kappa = (3-nu)/(1+nu),

whose lips open to the ellipse 4 S sqrt(a^2 - x^2) / E. Between the lips is the dark gap.

Out of the plane: a plausible model, made of closed formulas (no claim to be the paper's plate):

    z = -bow(P) cos(pi x / Lx) cos(pi y / Ly)                               bow(P) = bow0 / (1 + P / Ps): straightens
        -A(P) (c0 + (y/ly)^2) exp(-(y/ly)^2 - (x/lx)^2) / peak              one crest above, one below the crack +lip
        A(P) Im sqrt(z^2 - a^2) / a exp(-(y/ly)^2 - (x/lx)^2)          the lips separate, each to its own side

with A(P) = A1 (f(P/Pc - 1) - f(-1)), f(x) = sqrt((x + sqrt(x^2 + 0.1^2)) / 2): the pitchfork of a slightly imperfect
panel, next to nothing below Pc and growing with the square root above. At P = 0 only the bow is there: the reference
state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.sim.surface import PANEL, Surface

PAPER_LOADS_KN = (4.45, 35.6, 44.5, 48.95)
_IMPERFECTION = 0.1


@dataclass(frozen=True, kw_only=True)
class CrackedPanel:
    """Dimensions, material and out-of-plane model; a 2024-T3 sheet of 305 x 2.3 mm with a crack of 102 mm by default.

    Attributes
    ----------
    half_crack_mm, width_mm, thickness_mm
        a, W, t.
    youngs_modulus_mpa, poisson
        E in N/mm^2, nu.
    bow_mm, bow_length_mm, straightening_kn
        Initial bow, its half waves along the crack and along the load, and the load that halves it.
    buckling_kn, buckle_mm
        Load where buckling sets in and amplitude at twice that load.
    buckle_reach_mm
        lx, ly of the buckles.
    lip_share
        Opening of the lips out of plane, as a share of the buckles' amplitude.
    """

    half_crack_mm: float = 50.8
    width_mm: float = 304.8
    thickness_mm: float = 2.29
    youngs_modulus_mpa: float = 73.1e3
    poisson: float = 0.33
    bow_mm: float = 1.2
    bow_length_mm: tuple[float, float] = (900.0, 508.0)
    straightening_kn: float = 8.0
    buckling_kn: float = 22.24
    buckle_mm: float = 1.0
    buckle_reach_mm: tuple[float, float] = (55.0, 32.0)
    lip_share: float = 0.12

    def stress_mpa(self, load_kn: float) -> float:
        """Remote stress."""
        return load_kn * 1e3 / (self.width_mm * self.thickness_mm)

    def bow_at_mm(self, load_kn: float) -> float:
        """Height of the bow under the load."""
        return self.bow_mm / (1.0 + load_kn / self.straightening_kn)

    def buckle_at_mm(self, load_kn: float) -> float:
        """Amplitude A of the buckles."""

        def branch(x: float) -> float:
            return float(np.sqrt(0.5 * (x + np.hypot(x, _IMPERFECTION))))

        return self.buckle_mm * (branch(load_kn / self.buckling_kn - 1.0) - branch(-1.0))

    def surface(self, load_kn: float) -> Surface:
        """Return the panel's face at a load of 0 kN or more."""
        if not load_kn >= 0.0:
            raise ValueError(f"the panel's load must be 0 kN or more, got {load_kn}")
        nu = self.poisson
        c0 = 0.45
        peak = float(np.exp(c0 - 1.0))  # maximum of (c0 + q) exp(-q), at q = 1 - c0
        amplitude = self.buckle_at_mm(load_kn)
        return Surface(
            kind=PANEL,
            parameters=np.array(
                [
                    self.half_crack_mm,
                    self.stress_mpa(load_kn),
                    self.youngs_modulus_mpa / (1.0 + nu),
                    (3.0 - nu) / (1.0 + nu),
                    -self.bow_at_mm(load_kn),
                    *self.bow_length_mm,
                    -amplitude,
                    self.lip_share * amplitude,
                    *self.buckle_reach_mm,
                    c0,
                    peak,
                ]
            ),
        )
