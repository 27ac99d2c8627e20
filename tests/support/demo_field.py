"""Displacement fields of a known shape, for the demo's comparisons."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stereorig.core.field.points.result import Field


def field_of(w_of: Callable[[np.ndarray, np.ndarray], np.ndarray], *, noise_mm: float = 0.0, seed: int = 0) -> Field:
    """A displacement field on a flat face whose w is a given function of X_sys, Y_sys."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-7.0, 7.0, 29), np.linspace(-7.0, 7.0, 29))
    zero, shape = np.zeros_like(x), x.shape
    uvw = np.stack([zero, zero, w_of(x, y)], axis=-1) + rng.normal(0.0, noise_mm, (*shape, 3))
    return Field(
        x_px=256 + 30 * x,
        y_px=240 + 30 * y,
        status=np.zeros(shape, np.int8),
        xyz_mm=np.stack([x, y, zero], axis=-1),
        normal_sys=np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3)),
        theta_rad=zero,
        phi_rad=zero,
        zp_mm=zero,
        zncc=np.ones((*shape, 3)),
        epipolar_px=zero,
        iterations=np.zeros(shape, np.int32),
        noise_grey=zero,
        covariance=np.broadcast_to(np.eye(6) * max(noise_mm, 1e-9) ** 2, (*shape, 6, 6)),
        uvw_mm=uvw,
        rotation_rad=np.zeros((*shape, 3)),
        stretch=np.zeros((*shape, 3)),
    )
