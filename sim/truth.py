"""True values of a measurement, from the scene's formulas and the true camera alone.

Independent of correlation. A pixel of camera 1 in the reference state identifies a material point; its position, normal
and later position follow from the surface's formulas.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.sim.render import material_points
from stereorig.sim.scene import Scene


@dataclass(frozen=True)
class Truth:
    """True values at pixels of camera 1, reference state; NaN where the pixel shows no surface.

    Attributes
    ----------
    st_mm
        (..., 2) material coordinates.
    xyz_mm
        (..., 3) position in the reference state, system frame.
    normal_sys
        (..., 3) unit normal in the reference state, pointing away from camera 1.
    uvw_mm
        (..., 3) displacement to the other state.
    rotation
        (..., 3, 3) rotation of the patch of surface (its tangents and normal), system frame.
    stretch
        (..., 3) e11, e22, e12 of the surface: Green's in-plane strain against body axes (s, t).
    """

    st_mm: Float
    xyz_mm: Float
    normal_sys: Float
    uvw_mm: Float
    rotation: Float
    stretch: Float


def truth_at(reference: Scene, camera1: Camera, xy_px: ArrayLike, *, now: Scene | None = None) -> Truth:
    """Return the truth at pixels (..., 2) of the true camera 1.

    Parameters
    ----------
    reference
        Scene in the reference state.
    camera1
        The true camera at its position (dz = 0 usually).
    xy_px
        Pixels, any real numbers.
    now
        The same specimen in the other state; the reference itself when left out.
    """
    later = reference if now is None else now
    st, side = material_points(reference, camera1, xy_px)
    before, after = reference.sys_from_body, later.sys_from_body
    xyz = before.apply(reference.surface.positions(st, side))
    tangents = before.rotation @ reference.surface.tangents(st, side)
    tangents_now = after.rotation @ later.surface.tangents(st, side)
    frame, metric = _frame(tangents)
    frame_now, metric_now = _frame(tangents_now)
    normal = frame[..., 2]
    away = np.sign(np.sum(normal * (xyz - camera1.centre_sys_mm), axis=-1, keepdims=True))
    # the metric's change, taken to unit tangents: exact for (s, t) orthonormal on the reference surface
    change = 0.5 * (metric_now - metric)
    e = np.stack([change[..., 0, 0], change[..., 1, 1], change[..., 0, 1]], axis=-1)
    length = np.sqrt(np.stack([metric[..., 0, 0], metric[..., 1, 1]], axis=-1))
    e = e / np.stack([length[..., 0] ** 2, length[..., 1] ** 2, length[..., 0] * length[..., 1]], axis=-1)
    return Truth(
        st_mm=st,
        xyz_mm=xyz,
        normal_sys=normal * away,
        uvw_mm=after.apply(later.surface.positions(st, side)) - xyz,
        rotation=frame_now @ np.swapaxes(frame, -1, -2),
        stretch=e,
    )


def _frame(tangents: Float) -> tuple[Float, Float]:
    """Orthonormal frame (..., 3, 3) that turns with the surface: polar factor of the tangents, and normal; metric."""
    metric = np.swapaxes(tangents, -1, -2) @ tangents
    # inverse square root of a symmetric 2 x 2, by Cayley and Hamilton
    det = metric[..., 0, 0] * metric[..., 1, 1] - metric[..., 0, 1] ** 2
    root_det = np.sqrt(det)
    trace = metric[..., 0, 0] + metric[..., 1, 1]
    root = (metric + root_det[..., None, None] * np.eye(2)) / np.sqrt(trace + 2.0 * root_det)[..., None, None]
    inverse = np.empty_like(root)
    inverse[..., 0, 0], inverse[..., 1, 1] = root[..., 1, 1], root[..., 0, 0]
    inverse[..., 0, 1], inverse[..., 1, 0] = -root[..., 0, 1], -root[..., 1, 0]
    inverse /= root_det[..., None, None]
    unit = tangents @ inverse
    return np.concatenate([unit, np.cross(unit[..., 0], unit[..., 1])[..., None]], axis=-1), metric


@dataclass(frozen=True)
class SubsetPlane:
    """Best plane of the surface over each subset, at its centre.

    Attributes
    ----------
    xyz_mm
        (n, 3) intersection of the subset's best plane with the centre pixel's ray, system frame.
    normal_sys
        (n, 3) its unit normal, pointing away from camera 1.
    """

    xyz_mm: Float
    normal_sys: Float


def subset_planes(
    scene: Scene, camera1: Camera, xy_px: ArrayLike, subset_px: int, *, weights: ArrayLike | None = None
) -> SubsetPlane:
    """Fit a plane to the true surface over each subset's pixels.

    A plane is linear in inverse depth over the undistorted image, so the inverse depth is fitted, by least squares over
    the subset's pixels, as a matching with a plane patch does to first order.

    Parameters
    ----------
    scene, camera1
        True scene and camera.
    xy_px
        (n, 2) subset centres, whole pixels.
    subset_px
        Width of the square subset, odd.
    weights
        (subset_px, subset_px) or (n, subset_px, subset_px) weights of the pixels (the squared grey-level gradient along
        the epipolar line, say); all alike when left out.
    """
    centre = np.asarray(xy_px, dtype=np.float64).reshape(-1, 2)
    if subset_px < 3 or subset_px % 2 == 0:
        raise ValueError(f"subset_px must be odd and at least 3, got {subset_px}")
    o = np.arange(subset_px) - subset_px // 2
    offset = np.stack(np.meshgrid(o, o), axis=-1).reshape(-1, 2)
    pixels = centre[:, None] + offset
    st, side = material_points(scene, camera1, pixels)
    p = camera1.cam_from_sys.apply(scene.sys_from_body.apply(scene.surface.positions(st, side)))
    rays = camera1.rays_cam(pixels).xyz_mm[..., :2]
    ray0 = camera1.rays_cam(centre).xyz_mm
    design = np.concatenate([np.ones_like(rays[..., :1]), rays - ray0[:, None, :2]], axis=-1)
    w = np.ones(subset_px**2) if weights is None else np.asarray(weights, dtype=np.float64).reshape(-1, subset_px**2)
    weighted = design * np.broadcast_to(w, pixels.shape[:-1])[..., None]
    normal_matrix = np.swapaxes(weighted, -1, -2) @ design
    rhs = np.swapaxes(weighted, -1, -2) @ (1.0 / p[..., 2])[..., None]
    seen = np.isfinite(rhs).all(axis=(-1, -2))
    fit = np.full((len(centre), 3), np.nan)
    fit[seen] = np.linalg.solve(normal_matrix[seen], rhs[seen])[..., 0]
    # 1/Z = w0 + w1 (X/Z - x0) + w2 (Y/Z - y0): w1 X + w2 Y + (w0 - w1 x0 - w2 y0) Z = 1
    normal = np.stack([fit[:, 1], fit[:, 2], fit[:, 0] - np.sum(fit[:, 1:] * ray0[:, :2], axis=-1)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    xyz = camera1.sys_from_cam.apply(ray0 / fit[:, :1])
    return SubsetPlane(xyz, normal @ camera1.cam_from_sys.rotation)
