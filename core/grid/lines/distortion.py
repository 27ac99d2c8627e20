"""A smooth distortion that bends all straight lines of an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float


@dataclass(frozen=True)
class Distortion:
    """Distortion v = u + sum D_m f_m(u), in units of half the image's diagonal about its centre."""

    centre_px: Float
    scale_px: float
    D: Float

    def terms(self, u: Float) -> Float:
        """Return f_m(u), (..., 2, m)."""
        return distortion_terms(u, len(self.D))

    def correct(self, xy_px: Float) -> Float:
        """Return v of image positions (..., 2)."""
        u = (xy_px - self.centre_px) / self.scale_px
        return u + self.terms(u) @ self.D

    def gradient(self, xy_px: Float, normal: Float) -> Float:
        """Return unit vectors (..., 2) in the image across lines whose normals in corrected coordinates are given."""
        u = (xy_px - self.centre_px) / self.scale_px
        h = 1e-5
        steps = [(self.terms(u + d) - self.terms(u - d)) @ self.D / (2.0 * h) for d in h * np.eye(2)]
        across = normal + np.stack([np.sum(normal * step, axis=-1) for step in steps], axis=-1)
        return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))

    def distort(self, v: Float) -> Float:
        """Return image positions (..., 2), px, of v."""
        u = v.copy()
        for _ in range(12):
            u = v - self.terms(u) @ self.D
        return u * self.scale_px + self.centre_px


def distortion_terms(u: Float, n: int) -> Float:
    """Return the first n of f_m at u (..., 2), (..., 2, n)."""
    x, y = u[..., 0], u[..., 1]
    r2 = x * x + y * y
    zero = np.zeros_like(x)
    columns = [
        (r2 * x, r2 * y),
        ((x * x - y * y) * x, (x * x - y * y) * y),
        (r2 * r2 * x, r2 * r2 * y),
        (r2, zero),
        (zero, r2),
        (r2**3 * x, r2**3 * y),
        (r2**4 * x, r2**4 * y),
        (r2 * r2, zero),
        (zero, r2 * r2),
        (x**4 * x, x**4 * y),
    ][:n]
    return np.stack([np.stack(c, axis=-1) for c in columns], axis=-1)
