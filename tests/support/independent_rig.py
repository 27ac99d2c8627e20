"""A second rig, written apart from the product's code: formulas typed from the method's page, pictures from rays.

It shares nothing with `core` or `sim`, so that what the command line finds in these pictures is checked independently.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlainCamera:
    """Eleven parameters, Eqs. (1) to (8), and an image size (width, height)."""

    size: tuple[int, int]
    phd: float
    cx: float
    cy: float
    kappa: float
    aspect: float
    alpha: float
    beta: float
    gamma: float
    x0: float
    y0: float
    z0: float

    def rotation(self) -> Array:
        sa, ca = np.sin(self.alpha), np.cos(self.alpha)
        sb, cb = np.sin(self.beta), np.cos(self.beta)
        sg, cg = np.sin(self.gamma), np.cos(self.gamma)
        return np.array(
            [
                [ca * cg, -sa * cg, sg],
                [sa * cb + ca * sg * sb, ca * cb - sa * sg * sb, -cg * sb],
                [sa * sb - ca * sg * cb, ca * sb + sa * sg * cb, cg * cb],
            ]
        )

    def project(self, points: Array, dz: float = 0.0) -> Array:
        p = points @ self.rotation().T + np.array([self.x0, self.y0, self.z0 + dz])
        s = self.phd * p[..., :2] / p[..., 2:]
        bar = s / (1 + self.kappa * (s**2).sum(-1))[..., None]
        return bar * np.array([1.0, self.aspect]) + np.array([self.cx, self.cy])

    def sub_pixel_rays(self, n: int, rows: slice | None = None) -> Array:
        """Ray directions in the system frame, (h, w, n*n, 3), for n x n points a pixel."""
        w, h = self.size
        offset = (np.arange(n) + 0.5) / n - 0.5
        y = np.arange(h)[rows or slice(None)]
        yy = (y[:, None] + offset).ravel()
        xx = (np.arange(w)[:, None] + offset).ravel()
        X, Y = np.meshgrid((xx - self.cx), (yy - self.cy) / self.aspect)
        scale = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * self.kappa * (X**2 + Y**2)))
        d = np.stack([X * scale / self.phd, Y * scale / self.phd, np.ones_like(X)], -1) @ self.rotation()
        return d.reshape(len(y), n, w, n, 3).transpose(0, 2, 1, 3, 4).reshape(len(y), w, n * n, 3)

    def centre(self, dz: float = 0.0) -> Array:
        return -self.rotation().T @ np.array([self.x0, self.y0, self.z0 + dz])


def material_points(camera: PlainCamera, rays: Array, *, frame: Array, origin: Array, dz: float = 0.0) -> Array:
    """Where the rays meet the plane ``origin + frame @ (a, b)``: the (a, b), for a (3, 2) ``frame``."""
    matrix = np.linalg.inv(np.column_stack([frame, np.cross(frame[:, 0], frame[:, 1])]))
    c = matrix @ (camera.centre(dz) - origin)
    d = rays @ matrix.T
    return (c + d * (-c[2] / d[..., 2])[..., None])[..., :2]


@dataclass(frozen=True)
class Waves:
    """A speckle-like texture: many plane waves of random direction, pressed towards black and white."""

    wavelength_mm: float
    seed: int = 0
    n: int = 48

    def __call__(self, ab: Array) -> Array:
        rng = np.random.default_rng(self.seed)
        k = 2 * np.pi / self.wavelength_mm * rng.uniform(0.55, 1.25, self.n)
        angle = rng.uniform(0, 2 * np.pi, self.n)
        phase = rng.uniform(0, 2 * np.pi, self.n)
        total = np.zeros(ab.shape[:-1])
        for ki, ai, pi in zip(k, angle, phase, strict=True):
            total += np.cos(ab[..., 0] * (ki * np.cos(ai)) + ab[..., 1] * (ki * np.sin(ai)) + pi)
        return 0.5 + 0.5 * np.tanh(1.6 * total / np.sqrt(self.n / 2))


@dataclass(frozen=True)
class LineGrid:
    """Lines of one width through straight nodes; 0 on a line, 1 beside it."""

    pitch_mm: float
    lines: tuple[int, int]
    width_mm: float

    def __call__(self, ab: Array) -> Array:
        on = np.zeros(ab.shape[:-1], dtype=bool)
        half = [(n - 1) / 2 * self.pitch_mm for n in self.lines]
        for axis in range(2):
            nearest = np.clip(
                np.round(ab[..., axis] / self.pitch_mm + (self.lines[axis] - 1) / 2), 0, self.lines[axis] - 1
            )
            distance = np.abs(ab[..., axis] - (nearest - (self.lines[axis] - 1) / 2) * self.pitch_mm)
            along = np.abs(ab[..., 1 - axis]) <= half[1 - axis] + self.width_mm / 2
            on |= (distance <= self.width_mm / 2) & along
        return np.where(on, 0.0, 1.0)


FLAT = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])


class Drawn(TypedDict, total=False):
    """How a pattern is drawn, see :func:`picture`."""

    frame: Array
    origin: Array | None
    dz: float
    n: int
    low: float
    high: float
    blur_px: float


def fine_picture(
    camera: PlainCamera,
    pattern: Waves | LineGrid,
    *,
    frame: Array = FLAT,
    origin: Array | None = None,
    dz: float = 0.0,
    n: int = 4,
) -> NDArray[np.float32]:
    """The pattern at n x n points a pixel, (h n, w n), sharp."""
    w, h = camera.size
    fine = np.empty((h * n, w * n), dtype=np.float32)
    for start in range(0, h, 32):
        rows = slice(start, min(h, start + 32))
        rays = camera.sub_pixel_rays(n, rows)
        ab = material_points(camera, rays, frame=frame, origin=np.zeros(3) if origin is None else origin, dz=dz)
        samples = pattern(ab).reshape(-1, w, n, n).transpose(0, 2, 1, 3)
        fine[start * n : rows.stop * n] = samples.reshape(-1, w * n)
    return fine


def on_sensor(blurred: Array | NDArray[np.float32], n: int, *, low: float = 40.0, high: float = 210.0) -> Array:
    """Integrate a blurred fine picture over each pixel, light it unevenly: grey levels without noise, not rounded."""
    h, w = blurred.shape[0] // n, blurred.shape[1] // n
    out = blurred.reshape(h, n, w, n).mean((1, 3))
    yy, xx = np.mgrid[:h, :w]
    light = 1.0 - 0.08 * ((xx / w - 0.4) ** 2 + (yy / h - 0.6) ** 2)
    return np.asarray((low + (high - low) * out) * light)


def picture(
    camera: PlainCamera,
    pattern: Waves | LineGrid,
    *,
    frame: Array = FLAT,
    origin: Array | None = None,
    dz: float = 0.0,
    n: int = 4,
    low: float = 40.0,
    high: float = 210.0,
    blur_px: float = 0.6,
) -> Array:
    """Blur the pattern, integrate it over each pixel, light it unevenly: grey levels without noise, not rounded."""
    fine = fine_picture(camera, pattern, frame=frame, origin=origin, dz=dz, n=n)
    return on_sensor(gaussian_filter(fine, blur_px * n), n, low=low, high=high)


def defocused(fine: NDArray[np.float32], radius: float, blur: float) -> NDArray[np.float32]:
    """Blur a fine picture by the disc of an open aperture and a little diffraction; both in samples."""
    k = int(np.ceil(radius)) + 1
    y, x = np.mgrid[-k : k + 1, -k : k + 1]
    disc = np.clip(radius - np.hypot(x, y) + 0.5, 0.0, 1.0)
    wide = np.pad(gaussian_filter(fine, blur), k, mode="edge")
    return np.asarray(fftconvolve(wide, (disc / disc.sum()).astype(np.float32), mode="valid"), dtype=np.float32)


def with_stray_light(fine: NDArray[np.float32], blur: float, wide: float, share: float) -> NDArray[np.float32]:
    """Blur a fine picture by a Gaussian of ``blur`` samples, and ``share`` of its light by one of ``wide`` samples."""
    return np.asarray((1.0 - share) * gaussian_filter(fine, blur) + share * gaussian_filter(fine, wide))


def exposed(grey: Array, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Add noise and round to eight bits."""
    return np.clip(np.round(grey + rng.normal(0.0, noise, grey.shape)), 0, 255).astype(np.uint8)


def render(
    camera: PlainCamera, pattern: Waves | LineGrid, *, noise: float = 2.0, seed: int = 0, **drawn: Unpack[Drawn]
) -> NDArray[np.uint8]:
    """A picture of the pattern with noise, in eight bits; ``drawn`` as of :func:`picture`."""
    return exposed(picture(camera, pattern, **drawn), noise, np.random.default_rng(seed))
