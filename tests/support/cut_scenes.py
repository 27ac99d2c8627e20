"""A flat body cut in two along any line of camera 1's reference image; each side then moves rigidly on its own way.

The images at t are put together from the two states' images: a pixel shows the side whose material it sees, and a dark
gap where neither is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stereorig.core.cameras.camera import Camera
from stereorig.sim.render import material_points
from tests.support import field_bench as bench

Motion = tuple[float, float, float, float, float, float]
Side = Callable[[NDArray[np.float64]], NDArray[np.bool_]]

STILL: Motion = (0.0,) * 6
UP: Motion = (0.010, -0.060, -0.080, 0.0030, 0.0, -0.0012)
DOWN: Motion = (-0.020, 0.060, 0.050, -0.0020, 0.0010, 0.0010)
_GAP = 12


def below(line_px: NDArray[np.float64]) -> Side:
    """Return True for positions below a line that runs from left to right through the whole image."""
    return lambda xy: xy[..., 1] > np.interp(xy[..., 0], line_px[:, 0], line_px[:, 1])


def reference(seed: int = 1) -> bench.Images:
    """Both cameras' images before anything moved."""
    return bench.take("block", 1.0, STILL, seed=seed)


def opened(side: Side, seed: int = 2) -> bench.Images:
    """Both cameras' images after the side for which ``side`` is False went UP and the other DOWN."""
    cameras = (bench.pair().cam1, bench.pair().cam2)
    up, down = bench.take("block", 1.0, UP, seed=seed), bench.take("block", 1.0, DOWN, seed=seed + 1)
    out = []
    for camera, first, second in zip(cameras, up, down, strict=True):
        image = np.full_like(first, _GAP)
        upper = ~_side_of(UP, camera, side, first.shape, outside=True)
        lower = _side_of(DOWN, camera, side, first.shape, outside=False)
        image[upper], image[lower] = first[upper], second[lower]
        out.append(image)
    return out[0], out[1]


def _side_of(motion: Motion, camera: Camera, side: Side, shape: tuple[int, int], *, outside: bool) -> NDArray[np.bool_]:
    x, y = np.meshgrid(np.arange(shape[1], dtype=float), np.arange(shape[0], dtype=float))
    st, lip = material_points(bench.scene("block", 1.0, motion), camera, np.stack([x, y], axis=-1))
    before = bench.scene("block", 1.0, STILL)
    seen = bench.pair().cam1.project(before.sys_from_body.apply(before.surface.positions(st, lip))).xy
    return np.where(np.isfinite(seen).all(axis=-1), side(np.nan_to_num(seen)), outside)


def true_uvw(points: NDArray[np.float64], side: Side) -> NDArray[np.float64]:
    """True displacement (r, c, 3) at positions (r, c, 2) of camera 1's reference image."""
    grid = bench.PointGrid(points[..., 0], points[..., 1], np.ones(points.shape[:2], bool), 1.0, (0.0, 0.0, 1.0, 1.0))
    before = bench.scene("block", 1.0, STILL)
    up, down = (bench.truth(grid, before, bench.scene("block", 1.0, motion)).uvw_mm for motion in (UP, DOWN))
    return np.where(side(points)[..., None], down, up)
