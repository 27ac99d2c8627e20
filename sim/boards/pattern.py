"""Common parts of the prints of all boards: a white plate of finite size, soft edges, the field of points.

A printed pattern is ink on a plate. Its edges are softened by a Gaussian of ``edge_mm``, so that the textures have no
resolution, and their finest features are known.

Material coordinates: s along a row, t down the columns as printed, origin in the centre of the field of points.
"""

from __future__ import annotations

from math import erf
from typing import Final

import numpy as np
from numba import njit

from stereorig.core.arrays import Float

BOARD: Final = 3  # kind of texture, after those in `stereorig.sim.texture`
INK, PAPER, BEHIND = 0.06, 0.80, 0.25  # brightness of ink, plate and background
REACH_SD: Final = 5.0  # a soft edge ends here, with 3e-7 left
FAR_MM: Final = 1e9
ROOT_HALF: Final = 0.7071067811865476


def field_points(kind: str, size: tuple[int, int], pitch_mm: float) -> Float:
    """Exact positions (rows, columns, 2) of a board's corners or dots, origin in the centre of the field."""
    row, column = np.indices((size[1], size[0])).astype(np.float64)
    if kind == "circles_asymmetric":
        column = 2.0 * column + row % 2.0
    points = pitch_mm * np.stack([column, row], axis=-1)
    return np.asarray(points - 0.5 * (points.min(axis=(0, 1)) + points.max(axis=(0, 1))))


def check_margin(margin_mm: float) -> None:
    """Raise ValueError if a margin is no width."""
    if not 0.0 <= margin_mm < 1e4:
        raise ValueError(f"margin_mm must lie between 0 and 10000, got {margin_mm:g}")


@njit(cache=True, nogil=True, error_model="numpy")
def soft_step(distance: float, per_edge: float) -> float:
    """Gaussian's share beyond an edge: 0 far before it, 1 far behind; ``per_edge`` = 1 / (sqrt(2) sd)."""
    return float(0.5 * (1.0 + erf(distance * per_edge)))


@njit(cache=True, nogil=True, error_model="numpy")
def plate_share(par: Float, s: float, t: float) -> float:
    """Share of the plate, 1 on it and 0 beyond its rim."""
    reach = REACH_SD * par[1]
    in_s, in_t = par[5] - abs(s), par[6] - abs(t)
    if in_s > reach and in_t > reach:
        return 1.0
    if in_s < -reach or in_t < -reach:
        return 0.0
    root = ROOT_HALF / par[1]
    return float(soft_step(in_s, root) * soft_step(in_t, root))
