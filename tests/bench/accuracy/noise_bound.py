"""The Cramer-Rao bound of shape and motion at a point, all images noisy; apart from the product's kernels.

The texture under the subset is unknown, and so are gain and offset of every image. With the texture eliminated, the
differences of each image to the reference, carried through the true warp, are left: their covariance is that of the
image's noise, by the density of its pixels on the patch, plus the reference's, which all share. All derivatives of the warp are central differences through the
cameras' own functions; grey-level slopes are those of the noise-free picture.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from stereorig.core.arrays import Float
from tests.bench.accuracy.noise_scenes import Window

_STEPS = np.array([1e-7, 1e-5, 1e-5, 1e-3, *[1e-6] * 9])  # of w (1/mm), the epipolar offset (px), G


def bound(
    window: Window,
    clean: list[Float],
    xy: Float,
    w: Float,
    G: Float | None,
    subset_px: int,
    variances: list[Float] | None = None,
) -> Float:
    """Least covariance (N, n, n) of (w, e) or (w, e, G), for noise of variance 1 or of pixel ``variances``.

    Parameters
    ----------
    clean
        Noise-free images: two for a shape, four (camera 1 and 2, before and after) for a motion.
    xy
        (N, 2) points.
    w, G
        True unknowns; G None for a shape.
    variances
        Noise variance of every pixel, an image for each of ``clean``.
    """
    point = _Point(window, clean, subset_px, variances)
    return np.array([point.covariance(xy[i], w[i], None if G is None else G[i]) for i in range(len(xy))])


class _Point:
    def __init__(self, window: Window, clean: list[Float], subset_px: int, variances: list[Float] | None) -> None:
        self.window, self.clean, self.variances = window, clean, variances
        self.splines = [spline_filter(image, 5, mode="mirror") for image in clean]
        h = 1e-3
        y, x = np.mgrid[: clean[0].shape[0], : clean[0].shape[1]].astype(np.float64)
        self.slope = np.stack(
            [
                (self._grey(0, x + dx, y + dy) - self._grey(0, x - dx, y - dy)) / (2 * h)
                for dx, dy in ((h, 0.0), (0.0, h))
            ],
            -1,
        )
        offset = np.arange(subset_px) - subset_px // 2
        self.offsets = np.stack([v.ravel() for v in np.meshgrid(offset, offset)], -1)

    def _grey(self, k: int, x: Float, y: Float) -> Float:
        return np.asarray(map_coordinates(self.splines[k], [y, x], order=5, mode="mirror", prefilter=False))

    def covariance(self, xy: Float, w: Float, G: Float | None) -> Float:
        pixels = np.round(xy) + self.offsets
        unknowns = np.concatenate([w, [0.0], [] if G is None else G.ravel()])
        at = pixels.astype(int)
        f, slope = self.clean[0][at[:, 1], at[:, 0]], self.slope[at[:, 1], at[:, 0]]
        count = len(self.clean) - 1
        positions = [self._position(k, unknowns, pixels, xy) for k in range(count)]
        grey = [self._grey(k + 1, *p.T) for k, p in enumerate(positions)]
        contrast = np.array([np.std(g) / np.std(f) for g in grey])
        v = np.ones((count + 1, len(f)))
        if self.variances is not None:
            v[0] = self.variances[0][at[:, 1], at[:, 0]]
            for k, p in enumerate(positions):
                v[k + 1] = map_coordinates(self.variances[k + 1], p.T[::-1], order=1)
        # an image that sees the patch larger has more pixels on it, each with noise of its own
        scales = [np.abs(np.linalg.det(self._carried(k, unknowns, pixels, xy))) for k in range(count)]
        v[1:] /= np.stack(scales)
        # inverse covariance (n, count, count) of the differences at each pixel, in the reference's grey levels
        C = v[0][:, None, None] + np.einsum("kn,kj->nkj", v[1:] / contrast[:, None] ** 2, np.eye(count))
        W = np.linalg.inv(C)
        J = np.stack(
            [self._jacobian(k, unknowns, pixels, xy, slope) for k in range(count)], axis=1
        )  # (n, count, unknowns)
        # gain and offset of each image are unknown too
        nuisance = np.zeros((len(f), count, 2 * count))
        for k in range(count):
            nuisance[:, k, 2 * k], nuisance[:, k, 2 * k + 1] = f - f.mean(), f.std()
        A = np.concatenate([J, nuisance], axis=-1)
        N = np.einsum("nka,nkj,njb->ab", A, W, A)
        scale = 1.0 / np.sqrt(np.diag(N))
        inverse = np.linalg.inv(N * np.outer(scale, scale)) * np.outer(scale, scale)
        return np.asarray(inverse[: len(unknowns), : len(unknowns)])

    def _position(self, k: int, unknowns: Float, pixels: Float, xy: Float) -> Float:
        """Image points of comparison k."""
        pair = self.window.pair
        rays = pair.cam1.rays_cam(pixels).xyz_mm
        m = np.concatenate([np.ones((len(rays), 1)), rays[:, :2] - pair.cam1.rays_cam(xy).xyz_mm[:2]], axis=1)
        q = rays if k == 0 else m @ unknowns[4:].reshape(3, 3).T
        if k == 1:
            return np.asarray(pair.cam1.lens.image_from_normalised(q[:, :2] / q[:, 2:]).xy)
        pose = pair.cam2_from_cam1
        q = q @ pose.rotation.T + (m @ unknowns[:3])[:, None] * pose.translation_mm
        return np.asarray(
            pair.cam2.lens.image_from_normalised(q[:, :2] / q[:, 2:]).xy + unknowns[3] * self._across(xy, unknowns)
        )

    def _across(self, xy: Float, unknowns: Float) -> Float:
        """Unit vector across the epipolar line in camera 2."""
        depth = 1.0 / unknowns[0]
        near, far = (self.window.pair.image2_at_depth(xy, depth * s) for s in (0.9999, 1.0001))
        along = (far - near) / np.linalg.norm(far - near)
        return np.array([-along[1], along[0]])

    def _jacobian(self, k: int, unknowns: Float, pixels: Float, xy: Float, slope: Float) -> Float:
        """Reference slopes carried through the warp, (pixels, unknowns)."""
        inverse = np.linalg.inv(self._carried(k, unknowns, pixels, xy))
        columns = []
        for i, step in enumerate(_STEPS[: len(unknowns)]):
            d = np.zeros(len(unknowns))
            d[i] = step
            moved = (self._position(k, unknowns + d, pixels, xy) - self._position(k, unknowns - d, pixels, xy)) / (
                2 * step
            )
            columns.append(np.einsum("ni,nij,nj->n", slope, inverse, moved))
        return np.stack(columns, axis=-1)

    def _carried(self, k: int, unknowns: Float, pixels: Float, xy: Float) -> Float:
        """Derivative (pixels, 2, 2) of comparison k's image coordinates over the reference's."""
        h = 0.02
        by = [
            (self._position(k, unknowns, pixels + d, xy) - self._position(k, unknowns, pixels - d, xy)) / (2 * h)
            for d in np.eye(2) * h
        ]
        return np.stack(by, -1)


def displacement_bound(window: Window, xy: Float, w: Float, G: Float, covariance: Float) -> Float:
    """Least standard deviations (N, 3) of u, v, w in mm from the bound of the unknowns."""
    rays = window.pair.cam1.rays_cam(xy).xyz_mm
    T = np.zeros((len(xy), 3, covariance.shape[-1]))
    T[:, :, 0] = -(G[:, :, 0] - rays) / w[:, :1] ** 2
    for i in range(3):
        T[:, i, 4 + 3 * i] = 1.0 / w[:, 0]  # G's first column
    T = np.einsum("ji,njk->nik", window.pair.cam1.cam_from_sys.rotation, T)
    return np.sqrt(np.einsum("nik,nkl,nil->ni", T, covariance, T))


def height_bound(window: Window, xy: Float, w: Float, covariance: Float) -> Float:
    """Least standard deviation (N,) of Z_sys in mm."""
    rays = window.pair.cam1.rays_cam(xy).xyz_mm
    along = rays @ window.pair.cam1.cam_from_sys.rotation[:, 2]
    return np.asarray(np.abs(along) / w[:, 0] ** 2 * np.sqrt(covariance[:, 0, 0]))
