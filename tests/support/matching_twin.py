"""Plain numpy and scipy twin of the matching kernels, for one point at a time and without haste.

It shares nothing with them: rays and images through the cameras' own functions, splines by ``ndimage``, all derivatives
by central differences, and the solution is where the weighted sums vanish, found by Newton's method.

Unknowns are (w, e) for a shape and (w, e, G row by row) for a motion: w and each row of G have 3 numbers for a plane
patch, over (1, X, Y), and 6 for a curved one, over (1, X, Y, X^2, X Y, Y^2). How many there are tells which.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.matching import prepare

_W_STEPS = [1e-7, 1e-5, 1e-5, 1e-2, 1e-2, 1e-2]
_G_STEPS = [1e-6, 1e-5, 1e-5, 1e-2, 1e-2, 1e-2]


def monomials(XY: NDArray, terms: int) -> NDArray:
    """(n, 3) of a plane patch or (n, 6) of a curved one."""
    X, Y = XY[:, 0], XY[:, 1]
    return np.stack([np.ones_like(X), X, Y, X * X, X * Y, Y * Y][:terms], -1)


def pack(w: NDArray, e: float, G: NDArray | None = None) -> NDArray:
    """The twin's unknowns from a fit's numbers at one point."""
    return np.array([*w, e, *([] if G is None else G.ravel())])


class Twin:
    """One subset and its images."""

    def __init__(self, pair: StereoPair, images: list[NDArray], xy: NDArray, *, subset: int, order: int) -> None:
        self.pair, self.order = pair, order
        self.splines = [spline_filter(np.asarray(image, float), order, mode="mirror") for image in images]
        offset = np.arange(subset) - (subset - 1) // 2
        x, y = np.meshgrid(np.round(xy[0]) + offset, np.round(xy[1]) + offset)
        self.pixels = np.stack([x.ravel(), y.ravel()], -1)
        self.centre = pair.cam1.rays_cam(xy).xyz_mm
        self.XY = pair.cam1.rays_cam(self.pixels).xyz_mm[:, :2] - self.centre[:2]
        self.f = self._grey(0, self.pixels)
        self.f -= self.f.mean()
        # the derivatives that the matching takes are its own choice (test_slopes.py); their use is tested here
        kind = "cubic" if order == 3 else "quintic"
        columns, rows = self.pixels.astype(int).T
        gradient = np.stack([g[rows, columns] for g in prepare(images[0], kind).gradients], -1).astype(float)
        # over normalised offsets: pixel per normalised unit by differences of the back-projection
        h = 1e-2
        ray = [pair.cam1.rays_cam(xy + np.array(d)).xyz_mm[:2] for d in ((h, 0), (-h, 0), (0, h), (0, -h))]
        self.to_px = np.linalg.inv(np.stack([ray[0] - ray[1], ray[2] - ray[3]], -1) / (2 * h))
        self.gradient = gradient @ self.to_px
        w0 = 1.0 / 400.0
        a, b = (pair.image2_at_depth(xy, 1.0 / (w0 * s)) for s in (1.0001, 0.9999))
        along = (a - b) / np.linalg.norm(a - b)
        self.across = np.array([-along[1], along[0]])
        at = pair.image2_at_depth(xy, 1.0 / w0)
        if pair.epipolar_residual_px(xy, at + self.across) < 0:
            self.across = -self.across

    def _grey(self, image: int, xy: NDArray) -> NDArray:
        return map_coordinates(
            self.splines[image], [xy[:, 1], xy[:, 0]], order=self.order, mode="mirror", prefilter=False
        )

    def terms(self, unknowns: NDArray) -> int:
        """3 for plane, 6 for curved patches."""
        return (len(unknowns) - 1) // (1 if len(self.splines) == 2 else 4)

    def position(self, k: int, unknowns: NDArray, XY: NDArray) -> NDArray:
        """Image points of comparison k for unknowns (w, e, G)."""
        terms = self.terms(unknowns)
        m = monomials(XY, terms)
        w, e = unknowns[:terms], unknowns[terms]
        R, t = self.pair.cam2_from_cam1.rotation, self.pair.cam2_from_cam1.translation_mm
        if k == 0:
            q = np.concatenate([self.centre[:2] + XY, np.ones((len(XY), 1))], 1)
        else:
            q = m @ unknowns[terms + 1 :].reshape(3, terms).T
        if k == 1:
            return self.pair.cam1.lens.image_from_normalised(q[:, :2] / q[:, 2:]).xy
        q = q @ R.T + (m @ w)[:, None] * t
        return self.pair.cam2.lens.image_from_normalised(q[:, :2] / q[:, 2:]).xy + e * self.across

    def residual(self, k: int, unknowns: NDArray) -> tuple[NDArray, float, float]:
        """Zero-mean normalised residual in reference grey levels, contrast, zncc."""
        g = self._grey(k + 1, self.position(k, unknowns, self.XY))
        g = g - g.mean()
        contrast = np.sqrt((g @ g) / (self.f @ self.f))
        return g / contrast - self.f, contrast, g @ self.f / np.sqrt((g @ g) * (self.f @ self.f))

    def jacobian(self, k: int, unknowns: NDArray, steps: NDArray) -> NDArray:
        """Reference gradients carried through the warp, (pixels, unknowns)."""
        h = 1e-6
        by_x, by_y = (
            (self.position(k, unknowns, self.XY + d) - self.position(k, unknowns, self.XY - d)) / (2 * h)
            for d in np.eye(2) * h
        )
        inverse = np.linalg.inv(np.stack([by_x, by_y], -1))
        columns = []
        for i, step in enumerate(steps):
            d = np.zeros(len(steps))
            d[i] = step
            moved = (self.position(k, unknowns + d, self.XY) - self.position(k, unknowns - d, self.XY)) / (2 * step)
            columns.append((self.gradient * np.einsum("nij,nj->ni", inverse, moved)).sum(-1))
        return np.stack(columns, -1)

    def density(self, k: int, unknowns: NDArray) -> float:
        """Pixels of comparison k that show what one pixel of the reference shows."""
        h = 1e-6
        by_x, by_y = (
            (self.position(k, unknowns, h * d[None]) - self.position(k, unknowns, -h * d[None]))[0] / (2 * h)
            for d in np.eye(2)
        )
        return abs(np.linalg.det(np.stack([by_x, by_y]))) / abs(np.linalg.det(self.to_px))

    def equations(self, unknowns: NDArray, free: NDArray) -> tuple[NDArray, NDArray]:
        """The weighted sums that vanish at the solution, and their Gauss-Newton matrix; ``free`` spans the steps."""
        count = len(self.splines) - 1
        terms = self.terms(unknowns)
        steps = np.array([*_W_STEPS[:terms], 1e-3, *(_G_STEPS[:terms] * 3)])[: len(unknowns)]
        residuals, contrasts, _ = zip(*(self.residual(k, unknowns) for k in range(count)), strict=True)
        s2 = np.array(contrasts) ** 2 * [self.density(k, unknowns) for k in range(count)]
        W = np.diag(s2) - np.outer(s2, s2) / (1.0 + s2.sum())
        J = [self.jacobian(k, unknowns, steps) @ free for k in range(count)]
        g = sum(W[k, o] * J[k].T @ residuals[o] for k in range(count) for o in range(count))
        n = len(self.f)
        project = np.stack([np.ones(n) / np.sqrt(n), self.f / np.linalg.norm(self.f)])
        J = [j - project.T @ (project @ j) for j in J]
        N = sum(W[k, o] * J[k].T @ J[o] for k in range(count) for o in range(count))
        return g, N

    def solve(self, unknowns: NDArray) -> NDArray:
        """Newton to where nothing moves."""
        unknowns = unknowns.copy()
        free = np.eye(len(unknowns))
        for _ in range(40):
            g, N = self.equations(unknowns, free)
            scale = 1.0 / np.sqrt(np.diag(N))
            step = -scale * np.linalg.solve(N * np.outer(scale, scale), scale * g)
            unknowns += free @ step
            if np.abs(step / scale).max() < 1e-9 * np.linalg.norm(self.f):
                return unknowns
        raise AssertionError("the twin did not settle")
