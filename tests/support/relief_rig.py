"""Pictures of parts in relief by a renderer that shares nothing with `core` and `sim`: steps, ridges, wires, blur.

Every sample of a pixel is a ray that is traced to the first surface it meets. The texture is solid (a function of the
material point in space), so that faces of any slope, walls included, carry the same pattern. A body may move by any
affine map, under which rays stay straight, so that the true displacement is exact.

Frame: cameras look along +z from z < 0; a height is counted towards them, so a surface point is (x, y, -height).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import qmc

Array = NDArray[np.float64]

PLATEAU, RIDGE, VALLEY, CYLINDER, SPHERE, HOLE, WIRE, SHEET = range(8)
_MARCH_MM = 0.06  # lateral length of a step along a ray
_NO_FACE, _WIRE_FACE = -1, -2


@dataclass(frozen=True)
class Feature:
    """One form on a body's ground plane, within a rectangle about ``centre`` turned by ``turn`` rad.

    ``PLATEAU``: height ``a`` mm. ``RIDGE``, ``VALLEY``: two faces of slope ``b`` rad, ``a`` mm high or deep, along the
    turned y. ``CYLINDER``: radius ``a``, up to a slope of ``b``, along the turned y. ``SPHERE``: likewise, round.
    ``HOLE``: no surface within the radius ``a``. ``WIRE``: along the turned y at height ``a``, radius ``b``. ``SHEET``:
    a thin plate at height ``a`` that hides what is behind it.
    """

    kind: int
    centre: tuple[float, float]
    half: tuple[float, float]
    a: float
    b: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True)
class Texture:
    """Solid texture: many plane waves pressed towards black and white, or sharp balls of two diameters.

    ``hardness`` 1.6 is a soft speckle, 20 nearly black and white; ``balls`` of ``wavelength_mm`` distance.
    """

    wavelength_mm: float = 0.6
    seed: int = 0
    hardness: float = 1.6
    balls: bool = False

    def table(self) -> Array:
        rng = np.random.default_rng([77, self.seed])
        if self.balls:
            return rng.uniform(size=(4096, 4))
        direction = rng.normal(size=(64, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        k = 2 * np.pi / self.wavelength_mm * rng.uniform(0.3, 1.25, 64)
        return np.column_stack([direction * k[:, None], rng.uniform(0, 2 * np.pi, 64)])


@dataclass(frozen=True)
class Body:
    """A ground plate with features, its texture, and where it has moved: x' = A x + b.

    ``half``: half width and height of the ground plate, mm; zero: the features alone.
    """

    features: tuple[Feature, ...] = ()
    half: tuple[float, float] = (1e6, 1e6)
    texture: Texture = field(default_factory=Texture)
    A: Array = field(default_factory=lambda: np.eye(3))
    b: Array = field(default_factory=lambda: np.zeros(3))

    def moved(self, A: Array, b: Array) -> Body:
        """The same body after a further affine map."""
        return Body(self.features, self.half, self.texture, A @ self.A, A @ self.b + b)

    def rows(self) -> Array:
        return np.array(
            [[f.kind, *f.centre, *f.half, f.a, f.b, np.cos(f.turn), np.sin(f.turn)] for f in self.features]
        ).reshape(-1, 9)


@dataclass(frozen=True)
class ReliefCamera:
    """A pinhole with OpenCV's k1 k2 p1 p2 and a pose; ``misfit_px`` shifts what a calibration does not know.

    ``misfit_px``: coefficient m of a shift by m rho^5 px towards the corner, rho = 1 at the image's corner.
    """

    size: tuple[int, int]
    f_px: float
    centre_px: tuple[float, float]
    R: Array
    t: Array
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    misfit_px: float = 0.0

    def _distorted(self, n: Array) -> Array:
        k1, k2, p1, p2 = self.k
        x, y = n[..., 0], n[..., 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        return np.stack(
            [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
            -1,
        )

    def _misfit(self, px: Array) -> Array:
        if self.misfit_px == 0.0:
            return np.zeros_like(px)
        middle = 0.5 * (np.array(self.size) - 1)
        d = (px - middle) / np.linalg.norm(middle)
        return np.asarray(self.misfit_px * d * (d**2).sum(-1)[..., None] ** 2)

    def project(self, points: Array) -> Array:
        """(..., 2) px of points (..., 3), system frame, with the misfit."""
        p = points @ self.R.T + self.t
        px = self._distorted(p[..., :2] / p[..., 2:]) * self.f_px + np.array(self.centre_px)
        return np.asarray(px + self._misfit(px))

    def rays(self, px: Array) -> tuple[Array, Array]:
        """Centre (3,) and directions (..., 3) in the system frame, of unit depth, through pixels (..., 2)."""
        true = px.copy()
        if self.misfit_px:
            for _ in range(4):
                true = px - self._misfit(true)
        d = (true - np.array(self.centre_px)) / self.f_px
        n = d.copy()
        if any(self.k):
            for _ in range(12):
                n = n - (self._distorted(n) - d)
        direction = np.concatenate([n, np.ones((*n.shape[:-1], 1))], -1) @ self.R
        return -self.R.T @ self.t, direction


class Hits(NamedTuple):
    """What rays meet: depth in unit depths, face (unique over bodies and features; negative: none), body, normal."""

    t: Array
    face: NDArray[np.int64]
    body: NDArray[np.int64]
    normal: Array


@dataclass(frozen=True)
class Optics:
    """Blur and light of an exposure.

    Attributes
    ----------
    blur_px
        Sd of the Gaussian that a pixel sees besides its own square.
    defocus_px_mm, focus_mm
        Further sd, px a mm off the depth ``focus_mm`` from the camera.
    gloss, gloss_rad
        Height of the highlight over the diffuse white, and its width; the lamp stands beside camera 1.
    samples
        Rays a pixel.
    """

    blur_px: float = 0.6
    defocus_px_mm: float = 0.0
    focus_mm: float = 0.0
    gloss: float = 0.0
    gloss_rad: float = 0.1
    samples: int = 16


def two_cameras(
    size: tuple[int, int] = (640, 512),
    *,
    f_px: float = 3000.0,
    standoff_mm: float = 300.0,
    angle_rad: float = 0.4,
    k: tuple[tuple[float, float, float, float], tuple[float, float, float, float]] | None = None,
    misfit_px: tuple[float, float] = (0.0, 0.0),
    roll_rad: tuple[float, float] = (0.01, -0.015),
) -> tuple[ReliefCamera, ReliefCamera]:
    """Two unlike cameras, half the angle to each side of the normal."""
    out = []
    for sign, scale, kk, m, roll in zip(
        (-1.0, 1.0), (1.0, 1.03), k or ((0.0,) * 4, (0.0,) * 4), misfit_px, roll_rad, strict=True
    ):
        g = 0.5 * sign * angle_rad
        turn = np.array([[np.cos(g), 0.0, -np.sin(g)], [0.0, 1.0, 0.0], [np.sin(g), 0.0, np.cos(g)]])
        c, s = np.cos(roll), np.sin(roll)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ turn
        out.append(
            ReliefCamera(
                size,
                f_px * scale,
                (0.5 * size[0] - 3.0, 0.5 * size[1] + 4.0),
                R,
                np.array([0.3 * sign, -0.2, standoff_mm * scale]),
                kk,
                m,
            )
        )
    return out[0], out[1]


def trace(camera: ReliefCamera, bodies: tuple[Body, ...], px: Array) -> Hits:
    """What the rays through pixels (..., 2) meet first."""
    centre, direction = camera.rays(px.reshape(-1, 2))
    n = len(direction)
    t, face = np.full(n, np.inf), np.full(n, _NO_FACE, np.int64)
    body, normal = np.full(n, -1, np.int64), np.zeros((n, 3))
    for index, one in enumerate(bodies):
        back = np.linalg.inv(one.A)
        hit, where, n_here = _trace(
            back @ (centre - one.b), np.ascontiguousarray(direction @ back.T), one.rows(), np.array(one.half)
        )
        nearer = hit < t
        t[nearer], body[nearer] = hit[nearer], index
        face[nearer] = np.where(where[nearer] >= 0, 1000 * index + where[nearer], where[nearer])
        across = n_here[nearer] @ back
        normal[nearer] = across / np.linalg.norm(across, axis=1)[:, None]
    shape = px.shape[:-1]
    return Hits(t.reshape(shape), face.reshape(shape), body.reshape(shape), normal.reshape(*shape, 3))


def points_at(camera: ReliefCamera, hits: Hits, px: Array) -> Array:
    """(..., 3) mm, system frame; NaN where a ray meets nothing."""
    centre, direction = camera.rays(px)
    return np.where(
        np.isfinite(hits.t)[..., None],
        centre + np.where(np.isfinite(hits.t), hits.t, 0.0)[..., None] * direction,
        np.nan,
    )


def picture(
    camera: ReliefCamera,
    bodies: tuple[Body, ...],
    optics: Optics | None = None,
    *,
    lamp: Array | None = None,
    low: float = 35.0,
    high: float = 215.0,
) -> Array:
    """Grey levels of a camera without noise, not rounded; the background is dark."""
    optics = optics or Optics()
    w, h = camera.size
    draws = qmc.Sobol(4, seed=5).random(optics.samples)
    square, disc = draws[:, :2] - 0.5, ndtri(np.clip(draws[:, 2:], 1e-3, 1 - 1e-3))
    square -= square.mean(0)  # the mean of a pixel's rays is its centre
    disc = (disc - disc.mean(0)) / disc.std(0)
    out = np.zeros((h, w))
    for first in range(0, h, 32):
        yy, xx = np.mgrid[first : min(h, first + 32), :w].astype(float)
        middle = np.stack([xx, yy], -1)
        blur = np.full(xx.shape, optics.blur_px)
        if optics.defocus_px_mm:
            depth = trace(camera, bodies, middle).t
            off = np.where(np.isfinite(depth), depth, optics.focus_mm) - optics.focus_mm
            blur = np.hypot(blur, optics.defocus_px_mm * off)
        for a, b in zip(square, disc, strict=True):
            out[first : first + 32] += _light(camera, bodies, middle + a + b * blur[..., None], optics, lamp)
    yy, xx = np.mgrid[:h, :w]
    uneven = 1.0 - 0.08 * ((xx / w - 0.4) ** 2 + (yy / h - 0.6) ** 2)
    return np.asarray((low + (high - low) * out / optics.samples) * uneven)


def exposed(grey: Array, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Add noise and round to eight bits."""
    return np.clip(np.round(grey + rng.normal(0.0, noise, grey.shape)), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Seen:
    """The truth of points of camera 1's reference image.

    Attributes
    ----------
    xyz_mm, uvw_mm
        (..., 3) system frame; NaN where nothing is met.
    face
        (...) which smooth face; negative: none, or a wire.
    both
        (...) True where both cameras see the point, before and after the motion.
    one_face
        (...) True where both cameras see all of the subset, and it lies on one smooth face.
    """

    xyz_mm: Array
    uvw_mm: Array
    face: NDArray[np.int64]
    both: NDArray[np.bool_]
    one_face: NDArray[np.bool_]


def truth(
    cameras: tuple[ReliefCamera, ReliefCamera],
    bodies: tuple[Body, ...],
    xy_px: Array,
    *,
    subset_px: int,
    moved: tuple[Body, ...] | None = None,
) -> Seen:
    """The truth at pixels (..., 2) of camera 1, each body of ``moved`` being that of ``bodies`` after its motion."""
    moved = moved or bodies
    w, h = cameras[0].size
    every = np.stack(np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float)), -1)
    face, both, _, _ = _seen(cameras, bodies, moved, every)
    half = subset_px // 2
    whole = np.zeros(xy_px.shape[:-1], bool)
    for index in np.ndindex(whole.shape):
        x, y = np.round(xy_px[index]).astype(int)
        if half <= x < w - half and half <= y < h - half:
            part = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
            whole[index] = face[y, x] >= 0 and bool((face[part] == face[y, x]).all() and both[part].all())
    face, both, xyz, uvw = _seen(cameras, bodies, moved, xy_px)
    return Seen(xyz, uvw, face, both, whole)


def _seen(
    cameras: tuple[ReliefCamera, ReliefCamera], bodies: tuple[Body, ...], moved: tuple[Body, ...], px: Array
) -> tuple[NDArray[np.int64], NDArray[np.bool_], Array, Array]:
    hits = trace(cameras[0], bodies, px)
    xyz = points_at(cameras[0], hits, px)
    now = np.full_like(xyz, np.nan)
    for index, (before, after) in enumerate(zip(bodies, moved, strict=True)):
        here = hits.body == index
        material = (xyz[here] - before.b) @ np.linalg.inv(before.A).T
        now[here] = material @ after.A.T + after.b
    both = hits.face >= 0
    for camera, scene, points in ((cameras[1], bodies, xyz), (cameras[0], moved, now), (cameras[1], moved, now)):
        both &= _sees(camera, scene, np.where(both[..., None], points, 0.0))
    return hits.face, both, xyz, now - xyz


def _sees(camera: ReliefCamera, bodies: tuple[Body, ...], points: Array) -> NDArray[np.bool_]:
    px = camera.project(points)
    w, h = camera.size
    inside = (px >= 0.0).all(-1) & (px[..., 0] <= w - 1) & (px[..., 1] <= h - 1)
    met = points_at(camera, trace(camera, bodies, px), px)
    with np.errstate(invalid="ignore"):
        return np.asarray(inside & (np.linalg.norm(met - points, axis=-1) < 0.05))


def _light(camera: ReliefCamera, bodies: tuple[Body, ...], px: Array, optics: Optics, lamp: Array | None) -> Array:
    hits = trace(camera, bodies, px)
    met = points_at(camera, hits, px)
    out = np.full(px.shape[:-1], 0.05)
    out[hits.face == _WIRE_FACE] = 0.5
    for index, body in enumerate(bodies):
        here = (hits.body == index) & (hits.face >= 0)
        if here.any():
            material = (met[here] - body.b) @ np.linalg.inv(body.A).T
            shade = _balls if body.texture.balls else _waves
            out[here] = shade(
                np.ascontiguousarray(material), body.texture.table(), body.texture.hardness, body.texture.wavelength_mm
            )
    if optics.gloss > 0.0:
        direction = camera.rays(px)[1]
        source = np.array([-40.0, -60.0, -250.0]) if lamp is None else lamp
        with np.errstate(invalid="ignore"):
            to_lamp = source - met
            to_lamp /= np.linalg.norm(to_lamp, axis=-1)[..., None]
            to_eye = -direction / np.linalg.norm(direction, axis=-1)[..., None]
            halfway = to_lamp + to_eye
            halfway /= np.linalg.norm(halfway, axis=-1)[..., None]
            angle = np.arccos(np.clip(np.abs((halfway * hits.normal).sum(-1)), 0.0, 1.0))
            out += np.where(hits.face >= 0, optics.gloss * np.exp(-0.5 * (angle / optics.gloss_rad) ** 2), 0.0)
    return out


@njit(cache=True)
def _height(x, y, rows, half):  # type: ignore[no-untyped-def]
    """Height over the ground plane and face there; face -1 where there is no surface."""
    height, face = 0.0, 0
    solid = abs(x) <= half[0] and abs(y) <= half[1]
    for i in range(len(rows)):
        kind = rows[i, 0]
        if kind >= 6:
            continue
        dx, dy = x - rows[i, 1], y - rows[i, 2]
        u, v = rows[i, 7] * dx + rows[i, 8] * dy, rows[i, 7] * dy - rows[i, 8] * dx
        if abs(u) > rows[i, 3] or abs(v) > rows[i, 4]:
            continue
        a, b = rows[i, 5], rows[i, 6]
        if kind == 0:
            if a > height:
                height, face = a, 2 * i + 2
            solid = True
        elif kind == 1:
            z = a - np.tan(b) * abs(u)
            if z > height:
                height, face = z, 2 * i + (2 if u < 0 else 3)
        elif kind == 2:
            z = -(a - np.tan(b) * abs(u))
            if z < 0.0 and height == 0.0:
                height, face = z, 2 * i + (2 if u < 0 else 3)
        elif kind == 3:
            if abs(u) < a * np.sin(b):
                z = np.sqrt(a * a - u * u) - a * np.cos(b)
                if z > height:
                    height, face = z, 2 * i + 2
        elif kind == 4:
            r2 = u * u + v * v
            if r2 < (a * np.sin(b)) ** 2:
                z = np.sqrt(a * a - r2) - a * np.cos(b)
                if z > height:
                    height, face = z, 2 * i + 2
        elif kind == 5 and u * u + v * v < a * a:
            return 0.0, -1
    if not solid:
        return 0.0, -1
    return height, face


@njit(cache=True)
def _trace(origin, direction, rows, half):  # type: ignore[no-untyped-def]
    n = len(direction)
    t, face, normal = np.full(n, np.inf), np.full(n, -1, np.int64), np.zeros((n, 3))
    low, high = 0.0, 0.0
    for i in range(len(rows)):
        kind, a, b = rows[i, 0], rows[i, 5], rows[i, 6]
        if kind <= 1:
            high = max(high, a)
        elif kind == 2:
            low = min(low, -a)
        elif kind <= 4:
            high = max(high, a * (1 - np.cos(b)))
    high, low = high + 1e-6, low - 1e-6
    for k in range(n):
        dx, dy, dz = direction[k]
        if dz <= 0.0:
            continue
        for i in range(len(rows)):
            kind, a, b, c, s = rows[i, 0], rows[i, 5], rows[i, 6], rows[i, 7], rows[i, 8]
            if kind == 7:
                at = (-a - origin[2]) / dz
                x, y = origin[0] + at * dx - rows[i, 1], origin[1] + at * dy - rows[i, 2]
                u, v = c * x + s * y, c * y - s * x
                if abs(u) <= rows[i, 3] and abs(v) <= rows[i, 4] and at < t[k]:
                    t[k], face[k] = at, 2 * i + 2
                    normal[k, 0], normal[k, 1], normal[k, 2] = 0.0, 0.0, -1.0
            elif kind == 6:
                ox, oy, oz = origin[0] - rows[i, 1], origin[1] - rows[i, 2], origin[2] + a
                ou, du = c * ox + s * oy, c * dx + s * dy
                q, p = du * du + dz * dz, ou * du + oz * dz
                inside = p * p - q * (ou * ou + oz * oz - b * b)
                if inside > 0.0:
                    at = (-p - np.sqrt(inside)) / q
                    v = c * (oy + at * dy) - s * (ox + at * dx)
                    if abs(v) <= rows[i, 4] and at < t[k]:
                        t[k], face[k] = at, -2
                        normal[k, 2] = -1.0
        # march through the heights, then bisect the first crossing
        begin, end = (-high - origin[2]) / dz, (-low - origin[2]) / dz
        steps = max(2, int(np.ceil((end - begin) * np.hypot(dx, dy) / _MARCH_MM)) + 1)
        before = begin
        for j in range(steps + 1):
            now = begin + (end - begin) * j / steps
            if now >= t[k]:
                break
            z, which = _height(origin[0] + now * dx, origin[1] + now * dy, rows, half)
            if which >= 0 and origin[2] + now * dz >= -z:
                for _ in range(40):
                    mid = 0.5 * (before + now)
                    z, which = _height(origin[0] + mid * dx, origin[1] + mid * dy, rows, half)
                    if which >= 0 and origin[2] + mid * dz >= -z:
                        now = mid
                    else:
                        before = mid
                z, which = _height(origin[0] + now * dx, origin[1] + now * dy, rows, half)
                on_wall = origin[2] + now * dz > -z + 1e-4  # came in through a vertical wall
                t[k], face[k] = now, (500 if on_wall else 0) + which
                e = 1e-4
                x, y = origin[0] + now * dx, origin[1] + now * dy
                normal[k, 0] = -(_height(x + e, y, rows, half)[0] - _height(x - e, y, rows, half)[0]) / (2 * e)
                normal[k, 1] = -(_height(x, y + e, rows, half)[0] - _height(x, y - e, rows, half)[0]) / (2 * e)
                normal[k, 2] = -1.0
                break
            before = now
    return t, face, normal


@njit(cache=True, fastmath=True)
def _waves(points, table, hardness, wavelength):  # type: ignore[no-untyped-def]
    out = np.empty(len(points))
    level = np.sqrt(len(table) / 2.0)
    for i in range(len(points)):
        total = 0.0
        for j in range(len(table)):
            total += np.cos(
                points[i, 0] * table[j, 0] + points[i, 1] * table[j, 1] + points[i, 2] * table[j, 2] + table[j, 3]
            )
        out[i] = 0.5 + 0.5 * np.tanh(hardness * total / level)
    return out


@njit(cache=True)
def _balls(points, table, hardness, wavelength):  # type: ignore[no-untyped-def]
    out = np.ones(len(points))
    for i in range(len(points)):
        x, y, z = points[i, 0] / wavelength, points[i, 1] / wavelength, points[i, 2] / wavelength
        ix, iy, iz = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        for a in range(ix - 1, ix + 2):
            for b in range(iy - 1, iy + 2):
                for c in range(iz - 1, iz + 2):
                    row = table[(a * 73856093 ^ b * 19349663 ^ c * 83492791) & 4095]
                    r = 0.35 + 0.2 * row[3]
                    d = (x - a - row[0]) ** 2 + (y - b - row[1]) ** 2 + (z - c - row[2]) ** 2
                    if d < r * r:
                        out[i] = 0.0
    return out
