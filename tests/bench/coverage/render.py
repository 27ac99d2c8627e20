"""Pictures of targets and of moving, speckled surfaces, made from rays: nothing of `core` or `sim` is used.

Cameras are those of `tests.support.relief_rig`, whose formulas are their own. A surface is z = a x + b y + k (x^2 + y^2)
/ 2 in the body's frame; the body moves by any affine map, under which rays stay straight: the true motion is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import erf

from tests.support.relief_rig import ReliefCamera

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Sheet:
    """A surface with its texture, and where it has moved: x' = A x + b.

    Attributes
    ----------
    slope, curvature_per_mm
        a, b and k of the surface.
    texture
        (n, n) numbers of a spline surface, n a power of two: black and white are pressed out of it. For discs (n, 3):
        offsets and size by cell.
    knot_mm
        Distance of the spline's knots, or of the discs.
    A, b
        The motion, system frame.
    neck_mm
        Before it each point has gone along x, on a plane, by the first times tanh(x over the second).
    """

    slope: tuple[float, float]
    curvature_per_mm: float
    texture: Array
    knot_mm: float
    A: Array = field(default_factory=lambda: np.eye(3))
    b: Array = field(default_factory=lambda: np.zeros(3))
    neck_mm: tuple[float, float] = (0.0, 1.0)

    def moved(self, A: Array, b: Array, neck_mm: tuple[float, float] = (0.0, 1.0)) -> Sheet:
        """The sheet after a motion from where it lies at the reference."""
        return replace(self, A=A, b=b, neck_mm=neck_mm)

    def necked(self, points_mm: Array, neck_mm: tuple[float, float]) -> Array:
        """Points (n, 3) of the plane sheet after the neck alone."""
        along = neck_mm[0] * np.tanh(points_mm[:, 0] / neck_mm[1])
        return np.asarray(points_mm + along[:, None] * np.array([1.0, 0.0, self.slope[0]]))

    @property
    def surface(self) -> Array:
        """a, b and k."""
        return np.array([*self.slope, self.curvature_per_mm])

    def seen_by(self, camera: ReliefCamera, px: Array) -> Array:
        """(n, 3) points of the sheet, where it lies now, that pixels (n, 2) show."""
        centre, direction = camera.rays(px)
        back = np.linalg.inv(self.A)
        o, d = back @ (centre - self.b), direction @ back.T
        return np.asarray((o + _depth(o, d, self.surface)[:, None] * d) @ self.A.T + self.b)

    def tangents(self, points_mm: Array) -> Array:
        """(n, 3, 2) derivatives of points of the reference over the body's x and y."""
        out = np.zeros((len(points_mm), 3, 2))
        out[:, 0, 0] = out[:, 1, 1] = 1.0
        out[:, 2] = np.array(self.slope) + self.curvature_per_mm * points_mm[:, :2]
        return out


def _depth(o: Array, d: Array, surface: Array) -> Array:
    """Along rays from o to where they meet the surface first, the cameras lying at z < 0."""
    a, b, k = surface
    C = o[2] - a * o[0] - b * o[1] - 0.5 * k * (o[0] ** 2 + o[1] ** 2)
    B = d[:, 2] - a * d[:, 0] - b * d[:, 1] - k * (o[0] * d[:, 0] + o[1] * d[:, 1])
    A = -0.5 * k * (d[:, 0] ** 2 + d[:, 1] ** 2)
    return np.asarray(-2.0 * C / (B + np.sqrt(B * B - 4.0 * A * C)))


def soft_texture(rng: np.random.Generator) -> Array:
    """Numbers of a spline surface: speckle of some five knots."""
    return rng.standard_normal((256, 256))


def discs(rng: np.random.Generator) -> Array:
    """Sharp discs: by cell two offsets and a size."""
    return rng.uniform(size=(4096, 3))


@dataclass(frozen=True)
class Light:
    """From a pattern to grey levels: levels of black and white, sd of the blur, and further weight along a motion."""

    low: float = 60.0
    high: float = 190.0
    blur_px: float = 0.55


def speckled(camera: ReliefCamera, sheet: Sheet, light: Light) -> Array:
    """Grey levels of a sheet, not rounded, without noise.

    A soft texture is sampled at three places a side, with the weights that have a blurred pixel's moments to the fifth
    degree (under a wide blur at places a pixel apart); discs at four a pixel and side.
    """
    sharp = sheet.texture.shape[1] == 3
    place, weight = _taps(light.blur_px, 4 if sharp else 3 if light.blur_px < _NARROW_PX else 1)
    back = np.linalg.inv(sheet.A)
    centre = -camera.R.T @ camera.t
    cover = _speckled(
        camera.size[0],
        camera.size[1],
        place,
        weight,
        np.array([camera.f_px, *camera.centre_px, *camera.k]),
        back @ (centre - sheet.b),
        back @ camera.R.T,
        sheet.surface,
        sheet.texture,
        sheet.knot_mm,
        sharp,
        np.array(sheet.neck_mm),
    )
    return np.asarray(_lit(light.low + (light.high - light.low) * cover))


_NARROW_PX = 0.7  # beyond, three places lie too far apart for the texture


def _taps(blur_px: float, n: int) -> tuple[Array, Array]:
    """Places and weights along one axis: a pixel's square blurred by a Gaussian."""
    if n == 3:
        reach = np.sqrt(3.0 * (blur_px**2 + 1.0 / 12.0))
        return np.array([-reach, 0.0, reach]), np.array([1.0, 4.0, 1.0]) / 6.0
    half = int(np.ceil(n * (0.5 + 3.0 * blur_px)))
    place = (np.arange(2 * half) - half + 0.5) / n
    return place, _square(place, blur_px)


def _square(place: Array, blur_px: float) -> Array:
    r = 1.0 / (np.sqrt(2.0) * blur_px)
    weight = erf((0.5 - place) * r) + erf((0.5 + place) * r)
    return np.asarray(weight / weight.sum())


def _lit(grey: Array) -> Array:
    h, w = grey.shape
    yy, xx = np.mgrid[:h, :w]
    return np.asarray(grey * (1.0 - 0.08 * ((xx / w - 0.4) ** 2 + (yy / h - 0.6) ** 2)))


def exposed(grey: Array, noise: float, rng: np.random.Generator, *, correlated_px: float = 0.0) -> Picture:
    """Add noise and round to eight bits; correlated from pixel to pixel where that is asked for."""
    drawn = rng.standard_normal(grey.shape)
    if correlated_px > 0.0:
        from scipy.ndimage import gaussian_filter

        drawn = gaussian_filter(drawn, correlated_px, mode="wrap")
        drawn /= drawn.std()
    return np.clip(np.round(grey + noise * drawn), 0, 255).astype(np.uint8)


@njit(cache=True)
def _ray(x, y, camera):  # type: ignore[no-untyped-def]
    """Undistorted normalised position of a pixel."""
    dx, dy = (x - camera[1]) / camera[0], (y - camera[2]) / camera[0]
    k1, k2, p1, p2 = camera[3], camera[4], camera[5], camera[6]
    if k1 == 0.0 and k2 == 0.0 and p1 == 0.0 and p2 == 0.0:
        return dx, dy
    u, v = dx, dy
    for _ in range(8):
        r2 = u * u + v * v
        radial = k1 * r2 + k2 * r2 * r2
        u, v = (
            dx - u * radial - 2.0 * p1 * u * v - p2 * (r2 + 2.0 * u * u),
            dy - v * radial - p1 * (r2 + 2.0 * v * v) - 2.0 * p2 * u * v,
        )
    return u, v


@njit(cache=True)
def _spline(x, y, table):  # type: ignore[no-untyped-def]
    """A periodic cubic spline surface, pressed towards black and white."""
    mask = table.shape[0] - 1
    i, j = int(np.floor(x)), int(np.floor(y))
    f, g = x - i, y - j
    a0, a1, a2, a3 = (1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, 3 * (1 - f) ** 3 - 6 * (1 - f) ** 2 + 4, f**3
    b0, b1, b2, b3 = (1 - g) ** 3, 3 * g**3 - 6 * g**2 + 4, 3 * (1 - g) ** 3 - 6 * (1 - g) ** 2 + 4, g**3
    j0, j1, j2, j3 = (j - 1) & mask, j & mask, (j + 1) & mask, (j + 2) & mask
    total = 0.0
    for m in range(4):
        row = (i - 1 + m) & mask
        a = a0 if m == 0 else a1 if m == 1 else a2 if m == 2 else a3
        total += a * (b0 * table[row, j0] + b1 * table[row, j1] + b2 * table[row, j2] + b3 * table[row, j3])
    return 0.5 + 0.5 * np.tanh(0.075 * total)


@njit(cache=True)
def _disc(x, y, table):  # type: ignore[no-untyped-def]
    """Black within a disc a cell, white beside."""
    i, j = int(np.floor(x)), int(np.floor(y))
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            k = (a * 73856093 ^ b * 19349663) & 4095
            r = 0.28 + 0.2 * table[k, 2]
            if (x - a - table[k, 0]) ** 2 + (y - b - table[k, 1]) ** 2 < r * r:
                return 0.0
    return 1.0


@njit(cache=True)
def _material(x, neck):  # type: ignore[no-untyped-def]
    """Where a point at x of a neck was: Newton's steps on X + amplitude tanh(X / width) = x, which rises everywhere."""
    if neck[0] == 0.0:
        return x
    start = x - neck[0] * np.tanh(x / neck[1])
    for _ in range(30):
        th = np.tanh(start / neck[1])
        step = (x - start - neck[0] * th) / (1.0 + neck[0] / neck[1] * (1.0 - th * th))
        start += step
        if abs(step) < 1e-10:
            break
    return start


@njit(cache=True)
def _speckled(w, h, place, weight, camera, o, turn, surface, table, knot, sharp, neck):  # type: ignore[no-untyped-def]
    out = np.empty((h, w))
    sa, sb, k = surface[0], surface[1], surface[2]
    C = o[2] - sa * o[0] - sb * o[1] - 0.5 * k * (o[0] ** 2 + o[1] ** 2)
    n = len(place)
    for row in range(h):
        for col in range(w):
            total = 0.0
            for p in range(n):
                for q in range(n):
                    u, v = _ray(col + place[q], row + place[p], camera)
                    dx = turn[0, 0] * u + turn[0, 1] * v + turn[0, 2]
                    dy = turn[1, 0] * u + turn[1, 1] * v + turn[1, 2]
                    dz = turn[2, 0] * u + turn[2, 1] * v + turn[2, 2]
                    B = dz - sa * dx - sb * dy - k * (o[0] * dx + o[1] * dy)
                    A = -0.5 * k * (dx * dx + dy * dy)
                    t = -2.0 * C / (B + np.sqrt(max(B * B - 4.0 * A * C, 0.0)))
                    x, y = _material(o[0] + t * dx, neck) / knot, (o[1] + t * dy) / knot
                    total += weight[p] * weight[q] * (_disc(x, y, table) if sharp else _spline(x, y, table))
            out[row, col] = total
    return out
