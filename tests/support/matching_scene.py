"""A small independent image generator for the matching tests.

A plane carries a texture of Gaussian blobs in material coordinates. Each pixel's ray is met with the (moved) plane in
closed form, 4 x 4 rays a pixel; nothing is warped or interpolated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.opencv_full import opencv_lens_of
from stereorig.core.cameras.stereo import StereoPair

SIZE = 160


def paper_pair(*, size: int = SIZE, kappa: float = 1e-9, cy2_error: float = 0.0) -> StereoPair:
    """The paper's rig (60 degrees, 400 mm, 33 um a pixel) behind a window about its images' centres."""

    def camera(gamma_deg: float, beta: float, dcy: float, x0: float) -> Camera:
        return Camera.from_paper(
            phd_px=12000.0,
            cx_px=0.5 * size + 3.0,
            cy_px=0.5 * size - 2.0 + dcy,
            kappa_per_px2=kappa,
            aspect=0.9617,
            alpha_rad=np.deg2rad(45.0),
            beta_rad=beta,
            gamma_rad=np.deg2rad(gamma_deg),
            x0_mm=x0,
            y0_mm=0.03,
            z0_mm=400.0,
        )

    return StereoPair(camera(-30.0, 0.004, 0.0, 0.02), camera(30.0, -0.003, cy2_error, -0.05))


def opencv_pair(size: int = SIZE) -> StereoPair:
    """Two strongly distorting lenses off their axes, skewed, 19 degrees apart, 390 mm."""
    lens1 = OpenCVLens(5400.0, 5380.0, 700.0, -420.0, 1.5, 0.16, -2.1, 4e-4, -7e-4, 11.0)
    lens2 = OpenCVLens(5350.0, 5390.0, -650.0, 510.0, -0.8, -0.21, 1.7, -5e-4, 3e-4, -9.0)
    return _turned_pair(lens1, lens2, size)


def rational_pair(size: int = SIZE, **bent: float) -> StereoPair:
    """Corners of two wide lenses of OpenCV's eight terms, 25 degrees off their axes; no skew, as OpenCV has none.

    What k4, k5 and k6 do there is hundreds of pixels, and their slopes across a subset are percents.
    """
    lens1 = OpenCVLens(5400.0, 5380.0, 2300.0, -1300.0, 0.0, 0.62, 0.21, 4e-4, -7e-4, 0.012, 0.94, 0.38, 0.05)
    lens2 = OpenCVLens(5350.0, 5390.0, -1900.0, 1200.0, 0.0, -0.35, 0.14, -5e-4, 3e-4, -0.05, 0.11, 0.52, -0.21)
    return _turned_pair(*(opencv_lens_of(asdict(lens) | bent) for lens in (lens1, lens2)), size)


def _turned_pair(lens1: OpenCVLens, lens2: OpenCVLens, size: int) -> StereoPair:
    c, s = np.cos(np.deg2rad(19.0)), np.sin(np.deg2rad(19.0))
    # point both cameras so that the window's centre sees the origin
    poses = []
    for lens, turn in ((lens1, 0.0), (lens2, 1.0)):
        ray = lens.normalised_from_image([[0.5 * size, 0.5 * size]]).xy[0]
        R = np.eye(3) if turn == 0.0 else np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        poses.append(RigidTransform(R, 390.0 * np.array([ray[0], ray[1], 1.0])))
    return StereoPair(Camera(lens1, poses[0]), Camera(lens2, poses[1]))


@dataclass(frozen=True)
class Texture:
    """Random Gaussian blobs on the plane, sorted into cells."""

    blob_mm: float = 0.05
    per_blob: float = 4.0
    seed: int = 1
    extent_mm: float = 9.0
    cells: tuple[NDArray, NDArray, float] = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        cell = 4.0 * self.blob_mm
        m = int(2 * self.extent_mm / cell)
        k = max(1, round(cell**2 / (self.per_blob * self.blob_mm**2)))
        blobs = np.empty((m, m, k, 3))
        corner = np.stack(np.meshgrid(np.arange(m), np.arange(m), indexing="ij"), -1) * cell - self.extent_mm
        blobs[..., :2] = corner[:, :, None] + cell * rng.random((m, m, k, 2))
        blobs[..., 2] = rng.normal(size=(m, m, k))
        object.__setattr__(
            self, "cells", (blobs, np.array([self.blob_mm, cell, self.extent_mm]), 1.0 / np.sqrt(0.8 * k))
        )

    def __call__(self, ab: NDArray) -> NDArray:
        blobs, scale, level = self.cells
        return 120.0 + 95.0 * np.tanh(
            0.9 * level * 2.0 * _blob_sum(np.ascontiguousarray(ab.reshape(-1, 2)), blobs, scale)
        ).reshape(ab.shape[:-1])


@njit(cache=True, nogil=True)
def _blob_sum(ab, blobs, scale):
    sigma, cell, extent = scale
    m = blobs.shape[0]
    out = np.zeros(ab.shape[0])
    c = 0.5 / sigma**2
    for i in range(ab.shape[0]):
        x, y = ab[i, 0], ab[i, 1]
        ix, iy = int(np.floor((x + extent) / cell)), int(np.floor((y + extent) / cell))
        s = 0.0
        for jx in range(max(ix - 1, 0), min(ix + 2, m)):
            for jy in range(max(iy - 1, 0), min(iy + 2, m)):
                for k in range(blobs.shape[2]):
                    dx, dy = x - blobs[jx, jy, k, 0], y - blobs[jx, jy, k, 1]
                    r2 = (dx * dx + dy * dy) * c
                    if r2 < 12.0:
                        s += blobs[jx, jy, k, 2] * np.exp(-r2)
        out[i] = s
    return out


@dataclass(frozen=True)
class Plane:
    """Material point (a, b) lies at ``origin + basis (a, b)`` in sys; basis (3, 2) may turn and stretch."""

    origin: NDArray = field(default_factory=lambda: np.zeros(3))
    basis: NDArray = field(default_factory=lambda: np.eye(3)[:, :2])

    def material(self, camera: Camera, xy: NDArray) -> NDArray:
        """Material coordinates that a pixel position sees."""
        normal = np.cross(self.basis[:, 0], self.basis[:, 1])
        point = camera.back_project_to_plane(xy, point_sys_mm=self.origin, normal_sys=normal).xyz_mm
        return (point - self.origin) @ np.linalg.pinv(self.basis).T

    def position(self, ab: NDArray) -> NDArray:
        """System coordinates of material points."""
        return self.origin + ab @ self.basis.T


def render(camera: Camera, plane: Plane | Bent, texture: Texture, *, size: int = SIZE, samples: int = 4) -> NDArray:
    """Grey levels (size, size) without noise."""
    offset = (np.arange(samples) + 0.5) / samples - 0.5
    px = (np.arange(size)[:, None] + offset).ravel()
    x, y = np.meshgrid(px, px)
    value = texture(plane.material(camera, np.stack([x, y], -1)))
    return value.reshape(size, samples, size, samples).mean(axis=(1, 3))


def digitise(image: NDArray, *, noise: float, rng: np.random.Generator) -> NDArray:
    """Noise and 8-bit rounding."""
    return np.clip(np.rint(image + noise * rng.normal(size=image.shape)), 0, 255).astype(np.uint8)


def true_w(camera: Camera, plane: Plane, xy: NDArray) -> NDArray:
    """Inverse depth and its slopes (N, 3) of a plane at pixels of a camera."""
    normal = np.cross(plane.basis[:, 0], plane.basis[:, 1])
    n = camera.cam_from_sys.rotation @ normal
    d = n @ camera.cam_from_sys.apply(plane.origin)
    rays = camera.rays_cam(xy).xyz_mm
    return np.stack([rays @ n / d, np.full(len(rays), n[0] / d), np.full(len(rays), n[1] / d)], -1)


def true_g(camera: Camera, before: Plane, after: Plane, xy: NDArray) -> NDArray:
    """G (N, 3, 3) of the motion from one plane to the other."""
    w = true_w(camera, before, xy)
    rays = camera.rays_cam(xy).xyz_mm
    # G (1, X, Y) / w(X, Y) = moved point: linear in (1, X, Y); found from three offsets of the ray
    G = np.empty((len(xy), 3, 3))
    for k, d in enumerate(((0.0, 0.0), (1e-3, 0.0), (0.0, 1e-3))):
        ray = rays + np.array([d[0], d[1], 0.0])
        wk = w[:, 0] + w[:, 1] * d[0] + w[:, 2] * d[1]
        p = camera.sys_from_cam.apply(ray / wk[:, None])
        ab = (p - before.origin) @ np.linalg.pinv(before.basis).T
        G[..., k] = camera.cam_from_sys.apply(after.position(ab)) * wk[:, None]
    G[..., 1:] = (G[..., 1:] - G[..., :1]) / 1e-3
    return G


def grid(size: int = SIZE, *, margin: int = 30, count: int = 12) -> NDArray:
    """Points (count^2, 2) at whole pixels."""
    v = np.linspace(margin, size - 1 - margin, count).round()
    x, y = np.meshgrid(v, v)
    return np.stack([x.ravel(), y.ravel()], -1)


@dataclass(frozen=True)
class Bent:
    """Material point (a, b) lies at ``origin + basis (a, b) + normal (k11 a^2 + 2 k12 a b + k22 b^2) / 2`` in sys.

    ``normal`` is the unit cross product of the basis, so that ``bend`` (k11, k12, k22), 1/mm, are the curvatures in the
    origin if the basis is orthonormal. A ray meets it where a quadratic equation says: nothing is iterated.
    """

    bend: tuple[float, float, float] = (0.0, 0.0, 0.0)
    origin: NDArray = field(default_factory=lambda: np.zeros(3))
    basis: NDArray = field(default_factory=lambda: np.eye(3)[:, :2])

    @property
    def normal(self) -> NDArray:
        n = np.cross(self.basis[:, 0], self.basis[:, 1])
        return n / np.linalg.norm(n)

    def height(self, a: NDArray, b: NDArray) -> NDArray:
        k11, k12, k22 = self.bend
        return 0.5 * (k11 * a * a + 2.0 * k12 * a * b + k22 * b * b)

    def material(self, camera: Camera, xy: NDArray) -> NDArray:
        """Material coordinates that a pixel position sees."""
        rays = camera.rays_cam(xy).xyz_mm
        return self.met(camera.centre_sys_mm, rays @ camera.cam_from_sys.rotation)

    def met(self, centre: NDArray, directions: NDArray) -> NDArray:
        """Material coordinates (..., 2) where rays from ``centre`` along ``directions`` (..., 3) meet the surface."""
        frame = np.linalg.inv(np.column_stack([self.basis, self.normal]))
        c, d = frame @ (centre - self.origin), directions @ frame.T
        k11, k12, k22 = self.bend
        a, b = d[..., 0], d[..., 1]
        # from where the ray meets the tangent plane: of the two positions on the bent surface the near one
        p = c[:2] - (c[2] / d[..., 2])[..., None] * d[..., :2]
        p1, p2 = p[..., 0], p[..., 1]
        # height(p + t d) = t d2, as A t^2 - B t + C = 0
        A, C = self.height(a, b), self.height(p1, p2)
        B = d[..., 2] - (k11 * p1 * a + k12 * (p1 * b + p2 * a) + k22 * p2 * b)
        t = 2.0 * C / (B + np.copysign(np.sqrt(B * B - 4.0 * A * C), B))
        return p + t[..., None] * d[..., :2]

    def position(self, ab: NDArray) -> NDArray:
        """System coordinates of material points."""
        return self.origin + ab @ self.basis.T + self.height(ab[..., 0], ab[..., 1])[..., None] * self.normal


def true_w6(camera: Camera, surface: Bent, xy: NDArray) -> NDArray:
    """Inverse depth as a second-order polynomial (N, 6) about the rays of pixels, by differences along the surface."""
    return _second_order(lambda ray: 1.0 / _seen(camera, surface, surface, ray)[..., 2:], camera, xy)[..., 0]


def true_g6(camera: Camera, before: Bent, after: Bent, xy: NDArray) -> NDArray:
    """G (N, 3, 6) of the motion from one bent surface to the other, by differences along the surface."""

    def homogeneous(ray: NDArray) -> NDArray:
        return _seen(camera, before, after, ray) / _seen(camera, before, before, ray)[..., 2:]

    return np.moveaxis(_second_order(homogeneous, camera, xy), 1, 2)


def _seen(camera: Camera, before: Bent, after: Bent, ray: NDArray) -> NDArray:
    """Where the material that camera rays (..., 3) meet on ``before`` lies on ``after``, camera frame."""
    ab = before.met(camera.centre_sys_mm, ray @ camera.cam_from_sys.rotation)
    return camera.cam_from_sys.apply(after.position(ab))


def _second_order(function: Callable[[NDArray], NDArray], camera: Camera, xy: NDArray, h: float = 1e-3) -> NDArray:
    """(N, 6, d) coefficients over 1, X, Y, X^2, X Y, Y^2 of a function of the ray, by central differences."""
    rays = camera.rays_cam(xy).xyz_mm

    def at(i: int, j: int) -> NDArray:
        return function(rays + h * np.array([i, j, 0.0]))

    f = at(0, 0)
    return np.stack(
        [
            f,
            (at(1, 0) - at(-1, 0)) / (2 * h),
            (at(0, 1) - at(0, -1)) / (2 * h),
            (at(1, 0) + at(-1, 0) - 2 * f) / (2 * h * h),
            (at(1, 1) + at(-1, -1) - at(1, -1) - at(-1, 1)) / (4 * h * h),
            (at(0, 1) + at(0, -1) - 2 * f) / (2 * h * h),
        ],
        1,
    )
