"""Analytic fields for the gauges' tests: known shape and motion, noise that neighbours share, holes on order."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.status import PointStatus

SUBSET, STEP = 21, 7
SIGMA = np.array([2e-4, 3e-4, 9e-4, 3e-4, 2.5e-4, 1.2e-3])


def covariance() -> Float:
    """6 x 6, with correlated components, larger in depth."""
    mixing = np.eye(6) + 0.3 * np.sin(np.arange(36).reshape(6, 6))
    c = mixing @ mixing.T
    d = np.sqrt(np.diag(c))
    return np.asarray(c / np.outer(d, d) * np.outer(SIGMA, SIGMA))


def surface(x_px: Float, y_px: Float) -> Float:
    """A bent, tilted surface, 0.02 mm a pixel, seen at right angles; Z away from the cameras."""
    x, y = 0.02 * (x_px - 200.0), 0.02 * (y_px - 150.0)
    return np.stack([x, y, 0.05 * x - 0.1 * y + 0.02 * x**2], axis=-1)


def make_field(
    motion: Callable[[Float], Float] | None,
    *,
    rows: int = 14,
    cols: int = 17,
    shape: Callable[[Float, Float], Float] = surface,
    failed: NDArray[np.bool_] | None = None,
    cuts: Cuts | None = None,
    growing: bool = True,
) -> Field:
    """A field without noise, with the covariance that it would have; ``motion`` maps X to its current position."""
    x, y = np.meshgrid(40.0 + STEP * np.arange(cols), 60.0 + STEP * np.arange(rows))
    xyz = shape(x, y)
    status = np.zeros(x.shape, np.int8)
    if failed is not None:
        status[failed] = PointStatus.LOW_CORRELATION
    n = 3 if motion is None else 6
    # noisier to the right, as in an image that gets out of focus
    factor = 1.0 + 0.5 * (x - x.min()) / np.ptp(x) if growing else np.ones(x.shape)
    cov = factor[..., None, None] ** 2 * covariance()[:n, :n]
    uvw = None if motion is None else motion(xyz) - xyz
    bad = status != 0

    def numbers(values: Float) -> Float:
        values = np.array(values, dtype=np.float64)
        values[bad] = np.nan
        return values

    flat = np.zeros(x.shape)
    return Field(
        x_px=x,
        y_px=y,
        status=status,
        xyz_mm=numbers(xyz),
        normal_sys=numbers(np.broadcast_to([0.0, 0.0, 1.0], xyz.shape)),  # away from camera 1
        theta_rad=numbers(flat),
        phi_rad=numbers(flat),
        zp_mm=numbers(flat),
        zncc=numbers(np.ones((*x.shape, 1 if motion is None else 3))),
        epipolar_px=numbers(flat),
        iterations=np.zeros(x.shape, np.int32),
        noise_grey=numbers(flat),
        covariance=numbers(cov),
        uvw_mm=None if uvw is None else numbers(uvw),
        rotation_rad=None if uvw is None else numbers(np.zeros(xyz.shape)),
        stretch=None if uvw is None else numbers(np.zeros(xyz.shape)),
        cuts=cuts,
    )


def pixel_noise(rng: np.random.Generator, field: Field, copies: int) -> Float:
    """(copies, r, c, n) errors as a patch makes them: means over each subset of white noise of the pixels."""
    n = field.covariance.shape[-1]
    half = SUBSET // 2
    x0, y0 = int(field.x_px[0, 0]) - half, int(field.y_px[0, 0]) - half
    height, width = int(field.y_px[-1, 0]) + half + 1 - y0, int(field.x_px[0, -1]) + half + 1 - x0
    roots = np.zeros(field.covariance.shape)
    roots[field.valid] = np.linalg.cholesky(field.covariance[field.valid])
    out = np.empty((copies, *field.shape, n))
    for k in range(copies):
        white = rng.normal(size=(height, width, n))
        total = np.zeros((height + 1, width + 1, n))
        total[1:, 1:] = white.cumsum(axis=0).cumsum(axis=1)
        c = (field.x_px.astype(int) - half - x0, field.y_px.astype(int) - half - y0)
        a, b, d, e = c[0], c[0] + SUBSET, c[1], c[1] + SUBSET
        mean = (total[e, b] - total[e, a] - total[d, b] + total[d, a]) / SUBSET
        out[k] = np.einsum("rcij,rcj->rci", roots, mean)
    return out
