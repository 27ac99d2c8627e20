"""Fields of displacement made from formulas, as the measurement would return them; no camera, no image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import Cuts

Array = NDArray[np.float64]
MM_PER_PX = 0.033


def make_field(
    surface: Callable[[Array, Array], Array],
    motion: Callable[[Array], Array],
    *,
    shape: tuple[int, int] = (31, 35),
    spacing_px: float = 10.0,
    sigma_mm: tuple[float, float] = (2e-4, 3e-4),
    cuts: Cuts | None = None,
    stretch: Array | None = None,
    rotation_rad: Array | None = None,
) -> Field:
    """Points of ``surface(a, b)`` over the pixels in mm about the grid's middle, moved to ``motion(points)``."""
    rows, cols = shape
    x, y = np.meshgrid(100.0 + spacing_px * np.arange(cols), 80.0 + spacing_px * np.arange(rows))
    a, b = (x - x.mean()) * MM_PER_PX, (y - y.mean()) * MM_PER_PX
    xyz = surface(a, b)
    da, db = np.array([1e-6, 0.0]), np.array([0.0, 1e-6])
    normal = np.cross(*(surface(a + d[0], b + d[1]) - surface(a - d[0], b - d[1]) for d in (da, db)))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    covariance = np.zeros((*shape, 6, 6))
    covariance[..., range(6), range(6)] = np.array([sigma_mm[0]] * 3 + [sigma_mm[1]] * 3) ** 2
    plain = np.zeros(shape)
    return Field(
        x_px=x,
        y_px=y,
        status=np.zeros(shape, np.int8),
        xyz_mm=xyz,
        normal_sys=normal,
        theta_rad=plain,
        phi_rad=plain,
        zp_mm=plain,
        zncc=np.ones((*shape, 3)),
        epipolar_px=plain,
        iterations=np.ones(shape, np.int32),
        noise_grey=plain,
        covariance=covariance,
        uvw_mm=motion(xyz) - xyz,
        rotation_rad=np.zeros((*shape, 3)) if rotation_rad is None else np.broadcast_to(rotation_rad, (*shape, 3)),
        stretch=np.zeros((*shape, 3)) if stretch is None else np.broadcast_to(stretch, (*shape, 3)),
        cuts=cuts,
    )


def plane(a: Array, b: Array) -> Array:
    """A plane square to Z_sys, seen as by a camera under perspective."""
    scale = 1.0 + 0.004 * a + 0.006 * b
    return np.stack([a * scale, b * scale, np.zeros_like(a)], axis=-1)


def cylinder(radius_mm: float) -> Callable[[Array, Array], Array]:
    """A cylinder along Y_sys that bulges towards the cameras."""

    def position(a: Array, b: Array) -> Array:
        return np.stack([a, b, radius_mm - np.sqrt(radius_mm**2 - a**2)], axis=-1)

    return position


def sphere(radius_mm: float) -> Callable[[Array, Array], Array]:
    """A sphere that bulges towards the cameras."""

    def position(a: Array, b: Array) -> Array:
        return np.stack([a, b, radius_mm - np.sqrt(radius_mm**2 - a**2 - b**2)], axis=-1)

    return position


def turned(axis: tuple[float, float, float], angle_deg: float) -> Array:
    """Rotation matrix by Rodrigues' formula."""
    n = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    t = np.radians(angle_deg)
    return np.asarray(np.eye(3) + np.sin(t) * K + (1 - np.cos(t)) * K @ K)
