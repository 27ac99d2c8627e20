"""Search along the epipolar line: a start for one point without feature matches nearby.

For every depth with the point inside camera 2's image, and for a few tilts about the bisector of the viewing
directions, camera 1's subset is compared with camera 2's grey levels by zero-mean normalised correlation.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32
from stereorig.core.cameras.stereo import StereoPair

_TILTS_RAD = (0.0, -0.35, 0.35, -0.7, 0.7)
_SAMPLES = 17  # per side: enough to distinguish matches, a quarter of the work of all pixels
DEPTH_SPAN = 8.0
"""Depths from an eighth of the nominal one to eight times it are searched."""
_BLOCK = 512


def visible_depths(pair: StereoPair, xy_px: Float, image2_shape: tuple[int, int], *, spacing_px: float = 1.0) -> Float:
    """Return inverse depths (m,) on camera 1's ray of ``xy_px`` (2,), every ``spacing_px`` inside camera 2's image."""
    ray = pair.cam1.rays_cam(xy_px[None]).xyz_mm[0]
    if not np.isfinite(ray).all():
        return np.zeros(0)
    nominal = nominal_depth(pair)
    w = np.geomspace(1.0 / (nominal * DEPTH_SPAN), DEPTH_SPAN / nominal, 4000)
    xy2 = pair.image2_at_depth(np.broadcast_to(xy_px, (len(w), 2)), 1.0 / w)
    rows, cols = image2_shape
    with np.errstate(invalid="ignore"):
        seen = (xy2[:, 0] >= 0) & (xy2[:, 1] >= 0) & (xy2[:, 0] <= cols - 1) & (xy2[:, 1] <= rows - 1)
    if seen.sum() < 2:
        return np.zeros(0)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy2[seen], axis=0), axis=1))])
    count = max(int(length[-1] / spacing_px), 2)
    return np.interp(np.linspace(0.0, length[-1], count), length, w[seen])


def sweep(
    pair: StereoPair, image1: NDArray[Any], image2: NDArray[Any], xy_px: Float, *, subset_px: int, candidates: int = 6
) -> tuple[Float, Float]:
    """Search the depth of one point.

    Parameters
    ----------
    pair
        The calibrated cameras.
    image1, image2
        (rows, cols) grey levels.
    xy_px
        (2,) the point in camera 1.
    subset_px
        Width of the patch that is compared.
    candidates
        Number of distinct depths returned.

    Returns
    -------
    w
        (m, 3) start values, best first; m may be 0.
    zncc
        (m,) their correlations.
    """
    depths = visible_depths(pair, xy_px, (image2.shape[0], image2.shape[1]))
    half = subset_px // 2
    offsets = np.linspace(-half, half, _SAMPLES)
    ox, oy = (a.ravel() for a in np.meshgrid(offsets, offsets))
    pixels = xy_px + np.stack([ox, oy], axis=-1)
    rows, cols = image1.shape
    inside = (pixels.min() >= 0) and pixels[:, 0].max() <= cols - 1 and pixels[:, 1].max() <= rows - 1
    if len(depths) == 0 or not inside:
        return np.zeros((0, 3)), np.zeros(0)
    smooth1, smooth2 = (
        np.asarray(cv2.GaussianBlur(i.astype(np.float32), (0, 0), 1.0), np.float32) for i in (image1, image2)
    )
    ref = normalise(sample(smooth1, pixels[None]))[0]
    across = np.array([(0.0, np.sin(tilt), np.cos(tilt)) for tilt in _TILTS_RAD])
    ray = pair.cam1.rays_cam(xy_px[None]).xyz_mm[0]
    rays = pair.cam1.rays_cam(pixels).xyz_mm
    d = rays[:, :2] - ray[:2]
    pose = pair.cam2_from_cam1
    all_w: list[Float] = []
    all_z: list[Float] = []
    for w in tilted(pair, ray, depths, across):
        zncc = np.full(len(w), -1.0)
        for start in range(0, len(w), _BLOCK):
            part = w[start : start + _BLOCK]
            inverse = part[:, :1] + part[:, 1:] @ d.T  # (b, s)
            with np.errstate(divide="ignore", invalid="ignore"):
                p = (
                    pose.rotation @ rays.T + pose.translation_mm[:, None] * inverse[:, None, :]
                )  # (b, 3, s), scaled by w
                n = np.moveaxis(p[:, :2] / p[:, 2:], 1, -1)
            xy2 = pair.cam2.lens.image_from_normalised(n).xy
            with np.errstate(invalid="ignore"):
                whole = (inverse > 0).all(axis=1) & (p[:, 2] > 0).all(axis=1) & np.isfinite(xy2).all(axis=(1, 2))
            whole[whole] &= (
                (xy2[whole].min(axis=(1, 2)) >= 0)
                & (xy2[whole, :, 0].max(axis=1) <= image2.shape[1] - 1)
                & (xy2[whole, :, 1].max(axis=1) <= image2.shape[0] - 1)
            )
            if whole.any():
                block = zncc[start : start + _BLOCK]
                block[whole] = normalise(sample(smooth2, xy2[whole])) @ ref
        all_w.append(w)
        all_z.append(zncc)
    w, z = np.concatenate(all_w), np.concatenate(all_z)
    return distinct(w, z, depths, candidates)


def distinct(w: Float, zncc: Float, depths: Float, candidates: int) -> tuple[Float, Float]:
    """Return starts (k, 3) and their correlations, best first, without those within three steps of a better one."""
    order = np.argsort(-zncc)
    rank = np.searchsorted(depths, w[:, 0]) if depths[0] < depths[-1] else np.searchsorted(-depths, -w[:, 0])
    taken: list[int] = []
    for i in order[: 40 * candidates]:
        if zncc[i] > 0.0 and all(abs(int(rank[i]) - int(rank[j])) > 3 for j in taken):
            taken.append(int(i))
            if len(taken) == candidates:
                break
    return w[taken], zncc[taken]


def tilted(pair: StereoPair, ray: Float, depths: Float, normals: Float) -> list[Float]:
    """Return start values (m, 3) at inverse depths (m,), for each of several normals.

    ``normals`` (k, 3): components along the epipolar plane's normal, within that plane across the bisector of the two
    viewing directions, and along the bisector.
    """
    pose = pair.cam2_from_cam1
    centre2 = pose.inverse().translation_mm
    axis = np.cross(centre2, ray)  # normal of the epipolar plane: tilts that change the foreshortening
    axis /= np.linalg.norm(axis)
    out = []
    view1 = ray / np.linalg.norm(ray)
    for along, over, upright in normals:
        point = ray[None] / depths[:, None]
        view2 = point - centre2
        view2 /= np.linalg.norm(view2, axis=1, keepdims=True)
        normal = view1 + view2
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        across = np.cross(axis, normal)
        normal = upright * normal + over * across + along * axis
        # plane n . P = n . point gives 1/Z = n . (x, y, 1) / (n . point)
        constant = np.sum(normal * point, axis=1)
        good = (constant > 0.05 * np.linalg.norm(point, axis=1)) & (np.sum(normal * view2, axis=1) > 0.05)
        out.append(np.stack([depths, normal[:, 0] / constant, normal[:, 1] / constant], axis=1)[good])
    return out


def nominal_depth(pair: StereoPair) -> float:
    """Depth in camera 1 where the two optical axes come closest, or ten baselines if they diverge."""
    back = pair.cam2_from_cam1.inverse()
    c, a = back.translation_mm, back.rotation[:, 2]
    b = a[2]
    det = 1.0 - b * b
    if det > 1e-6:
        s = (c[2] - b * float(c @ a)) / det
        if s > 0.0:
            return float(s)
    return 10.0 * pair.baseline_mm


def sample(image: Float32, xy: Float) -> Float:
    """Return bilinear grey levels (b, s) at (b, s, 2)."""
    maps = xy.astype(np.float32)
    return np.asarray(
        cv2.remap(image, np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1]), cv2.INTER_LINEAR),
        dtype=np.float64,
    )


def normalise(values: Float) -> Float:
    """Return rows (b, s) of mean zero and length one."""
    v = values - values.mean(axis=1, keepdims=True)
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9))
