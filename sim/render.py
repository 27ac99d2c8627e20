"""The renderer: brightness of each pixel, from formulas alone.

No image is ever warped or interpolated. For every sample point of the sensor, a regular lattice of ``samples`` x
``samples`` in a pixel, the ray is solved with the deformed surface (`stereorig.sim.surface`) and the texture's formula
is evaluated at the material point found.

Pixel and lens blur: a pixel's value is the integral of the radiance over the sensor with the weight box * Gaussian (the
pixel's square, blurred by the lens). The integral is the sum over the lattice with that weight, normalised, and each
sample is used by all the pixels whose weight reaches it. The lattice sum of a smooth function is spectrally accurate:
its error is the radiance's content near ``samples`` cycles a pixel, which the textures' soft rims keep below 1e-4 of
the contrast.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import ceil
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy.special import erf

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.sim.boards.pattern import BOARD
from stereorig.sim.optics.lens import flat_lens, normalised
from stereorig.sim.optics.ray import rays
from stereorig.sim.scene import Scene
from stereorig.sim.texture import GRID

_BLUR_REACH: Final = 5.0  # the Gaussian is cut at five sd, where 6e-7 of it is left
_EDGE_CYCLES: Final = 0.53  # exp(-2 (pi 0.53)^2) = 4e-3, of an edge's own content there, which is 1 / (2 pi cycles)
_MOST_SAMPLES: Final = 12
_SMEAR_NODES: Final = 4  # enough for a way of a few pixels
_BAND_ROWS: Final = 32  # rows of one piece of work: small enough for the cache, large against the blur


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Options of the integration.

    Attributes
    ----------
    blur_px
        Standard deviation of the lens's Gaussian blur.
    samples
        Sample points across a pixel; None takes 4, 8 for line grids, whose edges are finer, and for boards as many as
        their edges need at the board's distance.
    threads
        Threads to use; the kernel holds no lock.
    """

    blur_px: float = 0.7
    samples: int | None = None
    threads: int = 1


def render(
    scene: Scene,
    camera: Camera,
    size_px: tuple[int, int],
    *,
    options: RenderOptions | None = None,
    window: tuple[int, int, int, int] | None = None,
) -> Float:
    """Render the brightness of each pixel, without lighting and sensor.

    Parameters
    ----------
    scene
        The scene.
    camera
        The camera, at its present position.
    size_px
        Columns and rows of the image.
    options
        Sampling and blur.
    window
        (x0, y0, x1, y1), half open: render these pixels only.

    Returns
    -------
    Float
        (rows, columns) brightness in [0, 1]; the scene's background where a ray meets nothing.
    """
    opts = RenderOptions() if options is None else options
    if any(scene.smear_mm):
        return _smeared(scene, camera, size_px, opts, window)
    samples = opts.samples if opts.samples is not None else _samples_needed(scene, camera)
    if samples < 4:
        raise ValueError(f"samples must be at least 4, got {samples}")
    x0, y0, x1, y1 = window if window is not None else (0, 0, size_px[0], size_px[1])
    if not (0 <= x0 < x1 <= size_px[0] and 0 <= y0 < y1 <= size_px[1]):
        raise ValueError(f"window {window} does not lie in an image of {size_px} px")
    weights = pixel_weights(samples, opts.blur_px)
    out = np.empty((y1 - y0, x1 - x0))
    bands = [(a, min(a + _BAND_ROWS, y1)) for a in range(y0, y1, _BAND_ROWS)]

    def work(band: tuple[int, int]) -> None:
        value = _samples(scene, camera, samples, weights.size, x0, x1, *band)
        _integrate(weights, samples, value, out[band[0] - y0 : band[1] - y0])

    if opts.threads > 1:
        with ThreadPoolExecutor(opts.threads) as pool:
            list(pool.map(work, bands))
    else:
        for band in bands:
            work(band)
    return out


def _samples_needed(scene: Scene, camera: Camera) -> int:
    if scene.texture.kind != BOARD:
        return 8 if scene.texture.kind == GRID else 4
    # a Gaussian edge's content near that many cycles a pixel stays below 1e-4 of the contrast
    depth = float((camera.cam_from_sys @ scene.sys_from_body).translation_mm[2])
    edge_px = scene.texture.finest_mm * float(flat_lens(camera.lens)[1]) / max(depth, 1.0)
    return int(np.clip(ceil(0.5 + _EDGE_CYCLES / max(edge_px, 1e-6)), 4, _MOST_SAMPLES))


def _smeared(
    scene: Scene,
    camera: Camera,
    size_px: tuple[int, int],
    options: RenderOptions,
    window: tuple[int, int, int, int] | None,
) -> Float:
    """Mean over the body's way during the exposure, by Gauss's rule, about its pose."""
    places, weights = np.polynomial.legendre.leggauss(_SMEAR_NODES)
    way, pose = 0.5 * np.asarray(scene.smear_mm), scene.sys_from_body
    views = []
    for place, weight in zip(places, weights, strict=True):
        there = RigidTransform(pose.rotation, pose.translation_mm + place * way)
        still = replace(scene, sys_from_body=there, smear_mm=(0.0, 0.0, 0.0))
        views.append(0.5 * weight * render(still, camera, size_px, options=options, window=window))
    return np.asarray(np.sum(views, axis=0))


def _samples(
    scene: Scene, camera: Camera, samples: int, n_weights: int, x0: int, x1: int, row0: int, row1: int
) -> Float:
    """Brightness at the sample points of the pixels [x0, x1) x [row0, row1) and of their surroundings."""
    pad = (n_weights - samples) // 2
    step = 1.0 / samples
    first = (0.5 - pad) * step - 0.5
    nx = np.empty(((row1 - row0) * samples + 2 * pad, (x1 - x0) * samples + 2 * pad))
    ny = np.empty_like(nx)
    rays(flat_lens(camera.lens), x0 + first, row0 + first, step, nx, ny)
    s, t, _ = scene.surface.hit(cam_from_body(scene, camera), nx.reshape(-1), ny.reshape(-1))
    for coordinate, half in zip((s, t), scene.half_size_mm, strict=True):
        if np.isfinite(half):
            coordinate[np.abs(coordinate) > half] = np.nan
    value = np.full(nx.shape, scene.background)
    scene.texture.paint(s, t, value.reshape(-1))
    return value


def cam_from_body(scene: Scene, camera: Camera) -> Float:
    """Pose (3, 4) of the scene's body in the camera's frame."""
    transform = camera.cam_from_sys @ scene.sys_from_body
    return np.hstack([transform.rotation, transform.translation_mm[:, None]])


def pixel_weights(samples: int, blur_px: float) -> Float:
    """Weights (k,) of the sample points around a pixel's centre along one axis: box times Gaussian, summing to 1."""
    pad = ceil(_BLUR_REACH * blur_px * samples)
    offset = (np.arange(samples + 2 * pad) + 0.5) / samples - 0.5 - pad / samples
    if blur_px == 0.0:
        return np.full(samples, 1.0 / samples)
    root = 1.0 / (np.sqrt(2.0) * blur_px)
    weight = erf((0.5 - offset) * root) + erf((0.5 + offset) * root)
    return np.asarray(weight / weight.sum())


def material_points(scene: Scene, camera: Camera, xy_px: ArrayLike) -> tuple[Float, Float]:
    """Return material points (..., 2) at pixels (..., 2), NaN if there is none, and the crack's lip (...), +-1."""
    xy = np.asarray(xy_px, dtype=np.float64)
    n = normalised(camera.lens, xy).xy.reshape(-1, 2)
    s, t, lip = scene.surface.hit(
        cam_from_body(scene, camera), np.ascontiguousarray(n[:, 0]), np.ascontiguousarray(n[:, 1])
    )
    s[(np.abs(s) > scene.half_size_mm[0]) | (np.abs(t) > scene.half_size_mm[1])] = np.nan
    t[np.isnan(s)] = np.nan
    return np.stack([s, t], axis=-1).reshape(xy.shape), lip.reshape(xy.shape[:-1])


# sums may be taken in any order: reassociation moves them by 1e-16 of the brightness
@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _integrate(weights: Float, samples: int, value: Float, out: Float) -> None:
    """Weigh the sample points of each pixel and its surroundings, along the row and then down the columns."""
    n_row, n_col = out.shape
    n_w = weights.shape[0]
    summed = np.empty(n_col)
    out[:] = 0.0
    for j in range(value.shape[0]):
        for c in range(n_col):
            total = 0.0
            for k in range(n_w):
                total += weights[k] * value[j, c * samples + k]
            summed[c] = total
        first = max(0, (j - n_w + samples) // samples)
        for r in range(first, min(n_row, j // samples + 1)):
            w = weights[j - r * samples]
            for c in range(n_col):
                out[r, c] += w * summed[c]
