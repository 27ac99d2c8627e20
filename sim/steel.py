"""The ground steel plate: a random analytic height field with the lay of grinding.

z(s, t) is the sum of two random cubic B-spline surfaces, coarse and fine, whose coefficients are independent Gaussian
numbers on lattices that are close across the lay (s) and wide along it (t). A B-spline surface with node spacing h
holds wavelengths from about 3 h up, most of its power near 4 to 6 h:

    coarse  h = 0.9 mm across, 4.0 mm along, 95 % of the variance: a subset 0.7 mm wide resolves most of it
    fine    h = 0.25 mm across, 1.5 mm along, 5 %: the marks themselves, which a subset averages away

The whole is scaled so that Ra, the mean departure from the best plane over the central 20 x 20 mm, is exactly as given.
The lattices repeat after 128 nodes (115 mm across in the coarse one).
"""

from __future__ import annotations

import numpy as np

from stereorig.sim.surface import HEIGHT, Surface

PAPER_RA_UM = 1.775
COARSE_MM = (0.9, 4.0)
FINE_MM = (0.25, 1.5)
FINE_SHARE = 0.05
_NODES = 128
_PATCH_MM = 10.0


def ground_steel(*, seed: int, ra_um: float = PAPER_RA_UM) -> Surface:
    """Height field with average roughness ``ra_um``."""
    rng = np.random.default_rng(seed)
    coarse, fine = rng.standard_normal((2, _NODES, _NODES))
    shape = np.array([np.sqrt(1.0 - FINE_SHARE), *COARSE_MM, np.sqrt(FINE_SHARE), *FINE_MM])
    unscaled = Surface(kind=HEIGHT, parameters=shape, coarse=coarse, fine=fine)
    scale = ra_um * 1e-3 / average_roughness_mm(unscaled)
    shape = shape.copy()
    shape[[0, 3]] *= scale
    return Surface(kind=HEIGHT, parameters=shape, coarse=coarse, fine=fine)


def average_roughness_mm(surface: Surface, *, half_size_mm: float = _PATCH_MM, n: int = 400) -> float:
    """Ra: mean departure from the best plane over the square |s|, |t| < ``half_size_mm``."""
    c = (np.arange(n) + 0.5) / n * 2.0 * half_size_mm - half_size_mm
    s, t = np.meshgrid(c, c)
    z = surface.positions(np.stack([s, t], axis=-1))[..., 2].ravel()
    design = np.column_stack([np.ones(z.size), s.ravel(), t.ravel()])
    return float(np.mean(np.abs(z - design @ np.linalg.lstsq(design, z, rcond=None)[0])))
