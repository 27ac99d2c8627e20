"""A projection written from the printed equations alone, to make observations with; uses nothing of core."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.core.calibration import CalibrationOptions, CalibrationView, NominalValues

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    pitch_mm: float = 1.0
    lines: tuple[int, int] = (11, 11)
    node_tolerance_mm: float = 0.0
    pitch_scale_sigma: float | None = None


PAPER: tuple[dict[str, float], dict[str, float]] = (
    {
        "phd": 12000.0,
        "cx": 262.0,
        "cy": 233.0,
        "kappa": 2.5e-9,
        "aspect": 0.9617,
        "alpha": math.radians(44.0),
        "beta": 0.01,
        "gamma": math.radians(-29.0),
        "x0": 0.3,
        "y0": -0.2,
        "z0": 398.0,
    },
    {
        "phd": 12100.0,
        "cx": 250.0,
        "cy": 246.0,
        "kappa": 2.0e-9,
        "aspect": 0.9617,
        "alpha": math.radians(46.0),
        "beta": -0.012,
        "gamma": math.radians(31.0),
        "x0": -0.25,
        "y0": 0.15,
        "z0": 403.0,
    },
)


def project(c: dict[str, float], X: Any, Y: Any, dz: float, Z: Any = 0.0, tilt: tuple[float, float] = (0, 0)) -> Array:
    """Eqs. (9), (10) term by term as printed, then (6) and (8)."""
    sa, ca, sb, cb = math.sin(c["alpha"]), math.cos(c["alpha"]), math.sin(c["beta"]), math.cos(c["beta"])
    sg, cg = math.sin(c["gamma"]), math.cos(c["gamma"])
    x = ca * cg * X - sa * cg * Y + sg * Z + c["x0"] + tilt[0] * dz
    y = (sa * cb + ca * sg * sb) * X + (ca * cb - sa * sg * sb) * Y - cg * sb * Z + c["y0"] + tilt[1] * dz
    z = (sa * sb - ca * sg * cb) * X + (ca * sb + sa * sg * cb) * Y + cg * cb * Z + c["z0"] + dz
    xs, ys = c["phd"] * x / z, c["phd"] * y / z
    d = 1.0 + c["kappa"] * (xs**2 + ys**2)
    return np.stack([xs / d + c["cx"], c["aspect"] * ys / d + c["cy"]], axis=-1)


def nodes(grid: Grid) -> tuple[Array, Array]:
    """Inner intersections, X and Y (n_a, n_b)."""
    n_a, n_b = grid.lines
    X = np.array([[(i - (n_a - 1) / 2) * grid.pitch_mm] * (n_b - 2) for i in range(1, n_a - 1)])
    Y = np.array([[(j - (n_b - 1) / 2) * grid.pitch_mm for j in range(1, n_b - 1)]] * (n_a - 2))
    return X, Y


NOISE_PX = 0.0022


NOMINAL = (
    NominalValues((512, 480), 12000.0, 400.0, -30.0, 0.9617),
    NominalValues((512, 480), 12000.0, 400.0, 30.0, 0.9617),
)


HELD = CalibrationOptions(held_out_mm=(2.0, 4.0))


def make_views(
    positions: Sequence[float] = (0.0, 2.0, 4.0, 5.0),
    *,
    grid: Grid | None = None,
    noise: float = NOISE_PX,
    seed: int = 0,
    error_mm: Array | None = None,
    tilt: tuple[float, float] = (0.0, 0.0),
    declared: Callable[[float], float] = lambda dz: dz,
    cameras: Sequence[dict[str, float]] = PAPER,
) -> list[CalibrationView]:
    rng = np.random.default_rng(seed)
    X, Y = nodes(grid or Grid())
    if error_mm is not None:
        X, Y = X + error_mm[..., 0], Y + error_mm[..., 1]
    views = []
    for name, camera in zip(("cam1", "cam2"), cameras, strict=True):
        for dz in positions:
            xy = project(camera, X, Y, dz, tilt=tilt)
            views.append(CalibrationView(name, declared(dz), xy + noise * rng.standard_normal(xy.shape)))  # type: ignore[arg-type]
    return views
