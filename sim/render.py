"""The renderer: what light falls on each pixel, from formulas alone.

No image is ever warped or interpolated. For every sample point of the sensor, a regular lattice of ``samples`` x
``samples`` in a pixel, the ray is solved with the deformed surface (`sim.ray`) and the texture's formula is evaluated
at the material point found.

Pixel and lens blur: a pixel's value is the integral of the radiance over the sensor with the weight box * Gaussian (the
pixel's square, blurred by the lens). The integral is the sum over the lattice with that weight, normalised, and each
sample serves all the pixels in whose weight it lies. The lattice sum of a smooth function is spectrally accurate: its
error is the radiance's content near ``samples`` cycles a pixel, which the textures' soft rims keep below 1e-4 of the
contrast.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import ceil
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from core.camera import Camera
from sim.ray import hit, normalised
from sim.scene import Scene
from sim.texture import GRID, texture_value

Float = NDArray[np.float64]

_BLUR_REACH: Final = 5.0  # the Gaussian is cut at five sd, where 6e-7 of it is left
_BAND_ROWS: Final = 64  # rows of one piece of work; small against the image, large against the blur


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How to integrate.

    Parameters
    ----------
    blur_px
        Standard deviation of the lens's Gaussian blur.
    samples
        Sample points across a pixel; None takes 4, and 8 for line grids, whose edges are finer.
    threads
        Threads to use; the kernel holds no lock.
    """

    blur_px: float = 0.55
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
        What is to be seen.
    camera
        By whom, at its present place.
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
    samples = opts.samples if opts.samples is not None else (8 if scene.texture.kind == GRID else 4)
    if samples < 4:
        raise ValueError(f"samples must be at least 4, got {samples}")
    x0, y0, x1, y1 = window if window is not None else (0, 0, size_px[0], size_px[1])
    if not (0 <= x0 < x1 <= size_px[0] and 0 <= y0 < y1 <= size_px[1]):
        raise ValueError(f"window {window} does not lie in an image of {size_px} px")
    weights = pixel_weights(samples, opts.blur_px)
    pose = cam_from_body(scene, camera)
    out = np.zeros((y1 - y0, x1 - x0))
    arguments = (
        samples, weights, camera.lens.kernel_parameters(), pose,
        scene.surface.kind, scene.surface.parameters, scene.surface.coarse, scene.surface.fine,
        scene.texture.kind, scene.texture.parameters, scene.texture.nodes_mm,
        np.array(scene.half_size_mm), scene.background,
    )  # fmt: skip
    bands = [(a, min(a + _BAND_ROWS, y1)) for a in range(y0, y1, _BAND_ROWS)]
    if opts.threads > 1:
        with ThreadPoolExecutor(opts.threads) as pool:
            list(pool.map(lambda band: _render_band(out, x0, y0, band[0], band[1], *arguments), bands))
    else:
        for a, b in bands:
            _render_band(out, x0, y0, a, b, *arguments)
    return out


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
    """Material points (..., 2) that pixels (..., 2) see, NaN where they see none, and the crack's lip (...), +-1."""
    xy = np.asarray(xy_px, dtype=np.float64)
    n = camera.lens.normalised_from_image(xy).xy.reshape(-1, 2)
    st = np.empty_like(n)
    side = np.empty(len(n))
    surface = scene.surface
    _material_points(
        n, cam_from_body(scene, camera), surface.kind, surface.parameters, surface.coarse, surface.fine,
        np.array(scene.half_size_mm), st, side,
    )  # fmt: skip
    return st.reshape(xy.shape), side.reshape(xy.shape[:-1])


@njit(cache=True, nogil=True)
def _material_points(
    n: Float,
    pose: Float,
    kind: int,
    par: Float,
    coarse: Float,
    fine: Float,
    half_size: Float,
    st: Float,
    side: Float,
) -> None:
    for k in range(n.shape[0]):
        st[k, 0] = np.nan
        st[k, 1] = np.nan
        side[k] = 1.0
        if np.isfinite(n[k, 0]):
            s, t, lip, ok = hit(kind, par, coarse, fine, pose, n[k, 0], n[k, 1], 0.0, 0.0, False, 1.0)
            if ok and abs(s) <= half_size[0] and abs(t) <= half_size[1]:
                st[k, 0] = s
                st[k, 1] = t
                side[k] = lip


@njit(cache=True, nogil=True)
def _render_band(
    out: Float,
    x0: int,
    y0: int,
    row0: int,
    row1: int,
    samples: int,
    weights: Float,
    lens: Float,
    pose: Float,
    surface_kind: int,
    surface_par: Float,
    coarse: Float,
    fine: Float,
    texture_kind: int,
    texture_par: Float,
    nodes: Float,
    half_size: Float,
    background: float,
) -> None:
    """Render rows [row0, row1) into ``out``, whose first pixel is (x0, y0)."""
    n_col = out.shape[1]
    n_w = weights.shape[0]
    pad = (n_w - samples) // 2
    line = np.empty(n_col * samples + 2 * pad)
    summed = np.empty(n_col)
    cell_index = np.full(2, np.iinfo(np.int64).min, dtype=np.int64)
    discs = np.empty((9, 3))
    # the start of each row's search, and the two last points of the row for extrapolation
    row_s, row_t, row_side, row_known = 0.0, 0.0, 1.0, False
    for j in range(-pad, (row1 - row0) * samples + pad):
        y = row0 - 0.5 + (j + 0.5) / samples
        s1, t1, side, known = row_s, row_t, row_side, row_known
        ds, dt = 0.0, 0.0
        nx, ny = 0.0, 0.0
        for i in range(line.shape[0]):
            x = x0 - 0.5 + (i - pad + 0.5) / samples
            nx, ny, ok = normalised(lens, x, y, nx, ny)
            value = background
            if ok:
                s, t, side, ok = hit(
                    surface_kind, surface_par, coarse, fine, pose, nx, ny, s1 + ds, t1 + dt, known, side
                )
                if ok:
                    if abs(s) <= half_size[0] and abs(t) <= half_size[1]:
                        value = texture_value(texture_kind, texture_par, nodes, s, t, cell_index, discs)
                    if known and i > 0:
                        ds, dt = s - s1, t - t1
                    else:
                        ds, dt = 0.0, 0.0
                    s1, t1 = s, t
                    if i == 0:
                        row_s, row_t, row_side, row_known = s, t, side, True
                known = ok
            else:
                known = False
            line[i] = value
        for c in range(n_col):
            total = 0.0
            base = c * samples
            for k in range(n_w):
                total += weights[k] * line[base + k]
            summed[c] = total
        # this row of samples lies k rows below the first one that pixel row r uses
        for r in range(row0, row1):
            k = j + pad - (r - row0) * samples
            if 0 <= k < n_w:
                w = weights[k]
                for c in range(n_col):
                    out[r - y0, c] += w * summed[c]
