"""Pictures of line grids and checkerboards as they were made, their nodes off their places: each sample by its ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from tests.bench.coverage.render import Array, Light, _lit, _ray, _square
from tests.support.relief_rig import ReliefCamera

_SAMPLES = 6  # a pixel and side; an edge is a ramp of a sample's width, without which slopes beat with the lattice


@dataclass(frozen=True)
class Made:
    """A target as it was made.

    Attributes
    ----------
    nodes_mm
        (n_a, n_b, 2 or 3) all nodes, those of the rim too.
    pitch_mm
        Nominal.
    line_width_mm
        Of a line grid; 0: a checkerboard whose inner corners the nodes are.
    """

    nodes_mm: Array
    pitch_mm: float
    line_width_mm: float = 0.0


def drawn_target(camera: ReliefCamera, made: Made, light: Light) -> Array:
    """Grey levels of a target in the plane Z = 0 of the system frame, not rounded, without noise."""
    pad = int(np.ceil(_SAMPLES * 4.0 * light.blur_px))
    place = (np.arange(_SAMPLES + 2 * pad) + 0.5 - pad) / _SAMPLES - 0.5
    H = np.linalg.inv(np.column_stack([camera.R[:, 0], camera.R[:, 1], camera.t]))
    cover = _drawn(
        camera.size[0],
        camera.size[1],
        _SAMPLES,
        pad,
        _square(place, light.blur_px),
        np.array([camera.f_px, *camera.centre_px, *camera.k]),
        H,
        np.ascontiguousarray(made.nodes_mm[..., :2]),
        made.pitch_mm,
        0.5 * made.line_width_mm,
    )
    return np.asarray(_lit(light.high + (light.low - light.high) * cover))


@njit(cache=True)
def _line(nodes, axis, across, along, pitch, half, rim):  # type: ignore[no-untyped-def]
    """Share of a sample that a family's nearest line covers: straight from node to node."""
    n, m = nodes.shape[axis], nodes.shape[1 - axis]
    k = int(np.floor(across / pitch + 0.5 * (n - 1) + 0.5))
    if k < 0 or k >= n or abs(across - (k - 0.5 * (n - 1)) * pitch) > 2.0 * half + rim:
        return 0.0
    s = min(max(int(np.floor(along / pitch + 0.5 * (m - 1))), 0), m - 2)
    if axis == 0:
        c0, l0, c1, l1 = nodes[k, s, 0], nodes[k, s, 1], nodes[k, s + 1, 0], nodes[k, s + 1, 1]
        first, last = nodes[k, 0, 1], nodes[k, m - 1, 1]
    else:
        c0, l0, c1, l1 = nodes[s, k, 1], nodes[s, k, 0], nodes[s + 1, k, 1], nodes[s + 1, k, 0]
        first, last = nodes[0, k, 0], nodes[m - 1, k, 0]
    if along < first - half or along > last + half:
        return 0.0
    centre = c0 + (c1 - c0) * (along - l0) / (l1 - l0)
    return min(max((half - abs(across - centre)) / rim + 0.5, 0.0), 1.0)


@njit(cache=True)
def _square_of(nodes, x, y, pitch, rx, ry):  # type: ignore[no-untyped-def]
    """Black share of a sample of a checkerboard of one square more each way than corners."""
    n, m = nodes.shape[0], nodes.shape[1]
    gx, gy = x / pitch + 0.5 * (n - 1), y / pitch + 0.5 * (m - 1)
    if gx < -1.0 or gy < -1.0 or gx > n or gy > m:
        return 0.0
    i, j = min(max(int(np.floor(gx)), 0), n - 2), min(max(int(np.floor(gy)), 0), m - 2)
    f, g = min(max(gx - i, 0.0), 1.0), min(max(gy - j, 0.0), 1.0)
    ex, ey = 0.0, 0.0
    for a in range(2):
        for b in range(2):
            weight = (f if a else 1.0 - f) * (g if b else 1.0 - g)
            ex += weight * (nodes[i + a, j + b, 0] - (i + a - 0.5 * (n - 1)) * pitch)
            ey += weight * (nodes[i + a, j + b, 1] - (j + b - 0.5 * (m - 1)) * pitch)
    gx, gy = (x - ex) / pitch + 0.5 * (n - 1), (y - ey) / pitch + 0.5 * (m - 1)
    kx, ky = np.floor(gx + 0.5), np.floor(gy + 0.5)
    sx = min(max((gx - kx) * pitch / (0.5 * rx), -1.0), 1.0) * (1.0 if int(kx) % 2 == 0 else -1.0)
    sy = min(max((gy - ky) * pitch / (0.5 * ry), -1.0), 1.0) * (1.0 if int(ky) % 2 == 0 else -1.0)
    return 0.5 + 0.5 * sx * sy


@njit(cache=True)
def _drawn(w, h, samples, pad, weight, camera, H, nodes, pitch, half):  # type: ignore[no-untyped-def]
    out = np.zeros((h, w))
    fine = np.empty(w * samples + 2 * pad)
    summed = np.empty(w)
    for j in range(-pad, h * samples + pad):
        y = (j + 0.5) / samples - 0.5
        rx, ry = 1e-3, 1e-3
        for i in range(len(fine)):
            x = (i - pad + 0.5) / samples - 0.5
            u, v = _ray(x, y, camera)
            d = H[2, 0] * u + H[2, 1] * v + H[2, 2]
            X = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / d
            Y = (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / d
            if i % samples == 0:
                s = samples * camera[0] * d
                rx = np.hypot(H[0, 0] - X * H[2, 0], H[0, 1] - X * H[2, 1]) / s
                ry = np.hypot(H[1, 0] - Y * H[2, 0], H[1, 1] - Y * H[2, 1]) / s
            if half > 0.0:
                a = _line(nodes, 0, X, Y, pitch, half, rx)
                b = _line(nodes, 1, Y, X, pitch, half, ry)
                fine[i] = 1.0 - (1.0 - a) * (1.0 - b)
            else:
                fine[i] = _square_of(nodes, X, Y, pitch, rx, ry)
        for c in range(w):
            total = 0.0
            for k in range(len(weight)):
                total += weight[k] * fine[c * samples + k]
            summed[c] = total
        for r in range(max(0, (j + pad - len(weight)) // samples), min(h, (j + pad) // samples + 1)):
            k = j + pad - r * samples
            if 0 <= k < len(weight):
                for c in range(w):
                    out[r, c] += weight[k] * summed[c]
    return out
