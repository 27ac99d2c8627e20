"""Grid images from a renderer of their own: the truth that the detection is held against.

Each sensor sample's ray is met with the grid's plane through the camera's formulas and the line there is looked up;
the pixel is the sum over the samples with the exact weight of a pixel square blurred by a Gaussian. It shares no
code with the detection, nor with the simulated rig.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import erf

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.target import GridTarget

PAPER_TARGET = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03, node_tolerance_mm=0.0)


def paper_camera(
    gamma_deg: float = -30.0,
    *,
    alpha_deg: float = 45.0,
    beta_deg: float = 0.0,
    size_px: tuple[int, int] = (512, 480),
    phd_px: float = 12100.0,
    z0_mm: float = 400.0,
    kappa_per_px2: float = 2e-9,
    aspect: float = 0.9617,
    centre_offset_px: tuple[float, float] = (4.0, -7.0),
    offset_mm: tuple[float, float] = (0.0, 0.0),
) -> Camera:
    """Build a camera like the paper's, 33 um a pixel, turned about the grid."""
    return Camera.from_paper(
        phd_px=phd_px,
        cx_px=0.5 * (size_px[0] - 1) + centre_offset_px[0],
        cy_px=0.5 * (size_px[1] - 1) + centre_offset_px[1],
        kappa_per_px2=kappa_per_px2,
        aspect=aspect,
        alpha_rad=np.radians(alpha_deg),
        beta_rad=np.radians(beta_deg),
        gamma_rad=np.radians(gamma_deg),
        x0_mm=offset_mm[0] - centre_offset_px[0] * z0_mm / phd_px,
        y0_mm=offset_mm[1] - centre_offset_px[1] * z0_mm / phd_px / aspect,
        z0_mm=z0_mm,
    )


def node_positions(target: GridTarget, tolerance_mm: float, seed: int) -> Float:
    """Nodes (n_a, n_b, 2), each off by a uniform error within the tolerance on both axes."""
    positions = target.all_points_mm()
    return positions + np.random.default_rng(seed).uniform(-tolerance_mm, tolerance_mm, positions.shape)


def truth_px(camera: Camera, target: GridTarget, nodes_mm: Float | None = None) -> Float:
    """Inner intersections in the image, (n_a - 2, n_b - 2, 2)."""
    nodes = target.all_points_mm() if nodes_mm is None else nodes_mm
    inner = nodes[1:-1, 1:-1]
    return camera.project(np.concatenate([inner, np.zeros((*inner.shape[:-1], 1))], axis=-1)).xy


def render_cover(
    camera: Camera,
    target: GridTarget,
    size_px: tuple[int, int] = (512, 480),
    *,
    blur_px: float = 0.55,
    samples: int = 8,
    nodes_mm: Float | None = None,
    overhang_mm: float = 0.0,
    extra_lines: Sequence[tuple[int, float, float, float]] = (),
) -> Float:
    """Cover (rows, columns) in [0, 1] of each pixel by lines.

    ``overhang_mm``: how far lines run on beyond the outermost crossings. ``extra_lines``: further straight lines
    (family, position, from, to) in mm, family 0 lying at constant X.
    """
    nodes = target.all_points_mm() if nodes_mm is None else nodes_mm
    pad = int(np.ceil(5.0 * blur_px * samples))
    offset = (np.arange(samples + 2 * pad) + 0.5) / samples - 0.5 - pad / samples
    if blur_px > 0.0:
        r = 1.0 / (np.sqrt(2.0) * blur_px)
        weight = erf((0.5 - offset) * r) + erf((0.5 + offset) * r)
    else:
        weight = np.ones_like(offset)
    weight /= weight.sum()
    lens = camera.lens.kernel_parameters()
    if lens[0] != 0.0:
        raise ValueError("this renderer knows the Seidel lens only")
    T = camera.cam_from_sys
    h_cam = np.column_stack([T.rotation[:, 0], T.rotation[:, 1], T.translation_mm])
    extra = np.array(extra_lines, dtype=np.float64).reshape(-1, 4)
    return _render(
        size_px[0],
        size_px[1],
        samples,
        pad,
        weight,
        lens,
        np.linalg.inv(h_cam),
        nodes,
        target.pitch_mm,
        0.5 * target.line_width_mm,
        overhang_mm,
        extra,
    )


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """From cover to grey levels."""

    ground: float = 200.0
    line: float = 40.0
    noise: float = 2.0
    bits: int = 8
    seed: int = 0
    lighting: Callable[[Float, Float], Float] | None = None  # factor, of x and y in px


def expose(cover: Float, exposure: Exposure | None = None) -> NDArray[Any]:
    """Light, noise and digitise a cover image."""
    e = Exposure() if exposure is None else exposure
    grey = e.ground + (e.line - e.ground) * cover
    if e.lighting is not None:
        y, x = np.mgrid[0 : cover.shape[0], 0 : cover.shape[1]].astype(np.float64)
        grey = grey * e.lighting(x, y)
    full = 2**e.bits - 1
    scale = full / 255.0
    noisy = grey * scale + np.random.default_rng(e.seed).normal(0.0, e.noise * scale, grey.shape)
    return np.clip(np.rint(noisy), 0, full).astype(np.uint8 if e.bits <= 8 else np.uint16)


def grid_image(
    camera: Camera,
    target: GridTarget = PAPER_TARGET,
    *,
    noise: float = 2.0,
    seed: int = 0,
    size_px: tuple[int, int] = (512, 480),
    **render_options: Any,
) -> NDArray[Any]:
    """Render and expose in one go, with the plain exposure."""
    line, ground = (40.0, 200.0) if target.dark_lines else (200.0, 40.0)
    cover = render_cover(camera, target, size_px, **render_options)
    return expose(cover, Exposure(ground=ground, line=line, noise=noise, seed=seed))


@njit(cache=True, nogil=True)
def _under_family(
    nodes: Float, axis: int, across: float, along: float, pitch: float, half: float, over: float, rim: float
) -> float:
    """Cover of one sample by one family; ``rim`` is the sample's own width, over which an edge is a ramp."""
    n = nodes.shape[axis]
    m = nodes.shape[1 - axis]
    k = int(np.floor(across / pitch + 0.5 * (n - 1) + 0.5))
    if k < 0 or k >= n:
        return 0.0
    seg = min(max(int(np.floor(along / pitch + 0.5 * (m - 1))), 0), m - 2)
    if axis == 0:
        c0, l0 = nodes[k, seg, 0], nodes[k, seg, 1]
        c1, l1 = nodes[k, seg + 1, 0], nodes[k, seg + 1, 1]
        first, last = nodes[k, 0, 1], nodes[k, m - 1, 1]
    else:
        c0, l0 = nodes[seg, k, 1], nodes[seg, k, 0]
        c1, l1 = nodes[seg + 1, k, 1], nodes[seg + 1, k, 0]
        first, last = nodes[0, k, 0], nodes[m - 1, k, 0]
    if along < first - over - half or along > last + over + half:
        return 0.0
    centre = c0 + (c1 - c0) * (along - l0) / (l1 - l0)
    return min(max((half - abs(across - centre)) / rim + 0.5, 0.0), 1.0)


# sums may be taken in any order
@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _render(
    width: int,
    height: int,
    samples: int,
    pad: int,
    weight: Float,
    lens: Float,
    h: Float,
    nodes: Float,
    pitch: float,
    half: float,
    over: float,
    extra: Float,
) -> Float:
    phd, phd_y, cx, cy = lens[1], lens[2], lens[4], lens[5]
    kappa = lens[6] / (phd * phd)
    aspect = phd_y / phd
    out = np.zeros((height, width))
    line = np.empty(width * samples + 2 * pad)
    summed = np.empty(width)
    n_w = weight.shape[0]
    for j in range(-pad, height * samples + pad):
        y = (j + 0.5) / samples - 0.5
        yb = (y - cy) / aspect
        for i in range(line.shape[0]):
            x = (i - pad + 0.5) / samples - 0.5
            xb = x - cx
            q = 4.0 * kappa * (xb * xb + yb * yb)
            value = 0.0
            if q < 1.0:
                f = 2.0 / (1.0 + np.sqrt(1.0 - q)) / phd
                u, v = xb * f, yb * f
                w = h[2, 0] * u + h[2, 1] * v + h[2, 2]
                X = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / w
                Y = (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / w
                # the samples' distance on the plane: without this ramp, edges at simple slopes beat with the lattice
                # `hypot` keeps from overflow, which takes half of the renderer's time
                x_right, x_down = h[0, 0] - X * h[2, 0], (h[0, 1] - X * h[2, 1]) / aspect
                y_right, y_down = h[1, 0] - Y * h[2, 0], (h[1, 1] - Y * h[2, 1]) / aspect
                dx = np.sqrt(x_right * x_right + x_down * x_down) * f / (samples * w)
                dy = np.sqrt(y_right * y_right + y_down * y_down) * f / (samples * w)
                a = _under_family(nodes, 0, X, Y, pitch, half, over, dx)
                b = _under_family(nodes, 1, Y, X, pitch, half, over, dy)
                value = 1.0 - (1.0 - a) * (1.0 - b)
                for e in range(extra.shape[0]):
                    p, q = (X, Y) if extra[e, 0] == 0.0 else (Y, X)
                    if abs(p - extra[e, 1]) <= half and extra[e, 2] <= q <= extra[e, 3]:
                        value = 1.0
            line[i] = value
        for c in range(width):
            total = 0.0
            for k in range(n_w):
                total += weight[k] * line[c * samples + k]
            summed[c] = total
        for r in range(max(0, (j + pad - n_w) // samples), min(height, (j + pad) // samples + 1)):
            k = j + pad - r * samples
            if 0 <= k < n_w:
                for c in range(width):
                    out[r, c] += weight[k] * summed[c]
    return out
