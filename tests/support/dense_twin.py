"""Plain numpy twin of the dense windows: sums over each window's own pixels, without haste.

It shares nothing with the kernels: splines by ``ndimage``, the prediction as the polynomials that it was made of, the
cameras through their own functions with derivatives by differences, and the geometry of the ordinary fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.matching import prepare
from stereorig.core.matching.geometry import covariance_xyz, covariance_xyzuvw, motion_geometry, shape_geometry

_STEPS = np.array([1e-8, 1e-6, 1e-6, 1e-6, 1e-3])


@dataclass(frozen=True)
class Bent:
    """Image coordinates (m,) as polynomials over a pixel's place: 1, x, y, x^2, x y, y^2 about ``middle``."""

    coefficients: NDArray
    middle: NDArray

    @staticmethod
    def of(xy: NDArray, positions: NDArray) -> Bent:
        """Fit positions (n, m) at places (n, 2)."""
        middle = xy.mean(axis=0)
        return Bent(np.linalg.lstsq(_terms(xy - middle), positions, rcond=None)[0], middle)

    def at(self, xy: NDArray) -> NDArray:
        """Positions (n, m)."""
        return _terms(xy - self.middle) @ self.coefficients

    def slopes(self, xy: NDArray) -> NDArray:
        """Derivatives (n, m, 2)."""
        h = 1e-3
        return np.stack([(self.at(xy + d) - self.at(xy - d)) / (2 * h) for d in np.eye(2) * h], axis=-1)


def _terms(d: NDArray) -> NDArray:
    x, y = d[:, 0], d[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


@dataclass(frozen=True)
class Vector:
    """One vector: position and displacement, their covariance for noise of variance 1, and the correlations."""

    values: NDArray
    covariance: NDArray
    epipolar_px: float
    zncc: NDArray


class DenseTwin:
    """The images of a shape (2) or a motion (4), and the prediction."""

    def __init__(self, pair: StereoPair, images: list[NDArray], prediction: Bent, *, subset: int, order: int) -> None:
        self.pair, self.prediction, self.order, self.half = pair, prediction, order, subset // 2
        self.images = [np.asarray(image, float) for image in images]
        self.splines = [spline_filter(image, order, mode="mirror") for image in self.images]
        self.gradients = prepare(images[0], "cubic" if order == 3 else "quintic").gradients

    def project(self, xy: NDArray, state: NDArray) -> NDArray:
        """Pixels (2 m,) of a point with unknowns (w, G0, e) in the other images."""
        pair, count = self.pair, len(self.images) - 1
        ray = pair.cam1.rays_cam(xy).xyz_mm
        R, t = pair.cam2_from_cam1.rotation, pair.cam2_from_cam1.translation_mm
        a, b = (pair.image2_at_depth(xy, z) for z in (1.0001 / state[0], 0.9999 / state[0]))
        along = (a - b) / np.linalg.norm(a - b)
        across = np.array([-along[1], along[0]])
        if pair.epipolar_residual_px(xy, a + across) < 0:
            across = -across
        out = []
        for k in range(count):
            q = ray if k == 0 else state[1:4]
            if k != 1:
                q = R @ q + t * state[0]
            lens = pair.cam1.lens if k == 1 else pair.cam2.lens
            at = lens.image_from_normalised(q[None, :2] / q[2]).xy[0]
            out.append(at if k == 1 else at + state[4] * across)
        return np.concatenate(out)

    def vector(self, xy: NDArray, state: NDArray) -> Vector:
        """Measure one vector; ``state`` (5,) is near its solution."""
        count = len(self.images) - 1
        side = np.arange(-self.half, self.half + 1)
        x, y = np.meshgrid(np.floor(xy[0] + 0.5) + side, np.floor(xy[1] + 0.5) + side)
        pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
        cols, rows = pixels.astype(int).T
        f = self.images[0][rows, cols]
        f = f - f.mean()
        J = np.stack([g[rows, cols] for g in self.gradients], axis=-1).astype(float)
        J -= J.mean(axis=0)
        free = J - np.outer(f, f @ J) / (f @ f)  # gain taken out too
        N = free.T @ free
        C = np.linalg.inv(N)
        places = self.prediction.at(pixels)
        here, slopes = self.prediction.at(xy[None])[0], self.prediction.slopes(xy[None])[0]
        measured, contrast, density, zncc = [], [], [], []
        for k in range(count):
            g = map_coordinates(
                self.splines[k + 1], places[:, [2 * k + 1, 2 * k]].T, order=self.order, mode="mirror", prefilter=False
            )
            g = g - g.mean()
            scale = np.sqrt((g @ g) / (f @ f))
            left = g / scale - f
            moved = -C @ (J.T @ left)
            left = left @ left - moved @ N @ moved
            A = slopes[2 * k : 2 * k + 2]
            measured.append(here[2 * k : 2 * k + 2] + A @ moved)
            contrast.append(scale)
            density.append(abs(np.linalg.det(A)))
            zncc.append(1.0 - 0.5 * left / (f @ f))
        V = np.diag(1.0 / (np.array(contrast) ** 2 * density)) + 1.0
        A = np.zeros((2 * count, 2 * count))
        for k in range(count):
            A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = slopes[2 * k : 2 * k + 2]
        of_pixels = A @ np.kron(V, C) @ A.T
        unknowns = [0, 4] if count == 1 else [0, 1, 2, 3, 4]
        state = state.copy()
        for _ in range(3):
            B = np.stack(
                [
                    (self.project(xy, state + d) - self.project(xy, state - d)) / (2 * d.max())
                    for d in np.diag(_STEPS)[unknowns]
                ],
                axis=-1,
            )
            W = np.linalg.inv(of_pixels)
            cov = np.linalg.inv(B.T @ W @ B)
            state[unknowns] += cov @ (B.T @ W @ (np.concatenate(measured) - self.project(xy, state)))
        w = np.array([[state[0], 0.0, 0.0]])
        at = shape_geometry(self.pair, xy[None], w).xyz_mm[0]
        if count == 1:
            return Vector(at, covariance_xyz(self.pair, xy[None], w, cov[None])[0], state[4], np.array(zncc))
        G = np.zeros((1, 3, 3))
        G[0, :, 0], G[0, 0, 1], G[0, 1, 2] = state[1:4], 1.0, 1.0
        uvw = motion_geometry(self.pair, xy[None], w, G).uvw_mm[0]
        both = covariance_xyzuvw(self.pair, xy[None], w, G, cov[None])[0]
        return Vector(np.concatenate([at, uvw]), both, state[4], np.array(zncc))
