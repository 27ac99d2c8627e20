"""A rig whose cameras are bumped: the independent rig's cameras turned by formulas of their own, and its pictures."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions
from stereorig.core.orientation import RepairedPair, repair_orientation
from tests.support.independent_rig import Array, PlainCamera, Waves, render

#: a wide view, as of an 8 mm lens on a 2/3 inch sensor: over a narrow one, offsets do not determine the vergence
SIZE = (800, 640)
STANDOFF_MM = 500.0
SUBSET_PX, SPACING_PX = 25, 12


def plain_camera(sign: float, *, size: tuple[int, int] = SIZE) -> PlainCamera:
    """Camera 1 (-1) or 2 (+1): 25 degrees between them, lenses and rolls unlike."""
    scale = size[0] / SIZE[0]
    return PlainCamera(
        size=size,
        phd=(1300.0 + 7.0 * sign) * scale,
        cx=size[0] / 2 + 5.0,
        cy=size[1] / 2 - 4.0,
        kappa=-1e-8 / scale**2,
        aspect=1.0,
        alpha=0.01 * sign,
        beta=0.005,
        gamma=np.radians(12.5) * sign,
        x0=0.5,
        y0=-0.3,
        z0=STANDOFF_MM,
    )


def rotation(vector: Array) -> Array:
    """Rotation by a vector, axis times angle (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


def turned(camera: PlainCamera, degrees: tuple[float, float, float], *, lever_mm: float = 0.0) -> PlainCamera:
    """The camera turned about its own axes, about a point ``lever_mm`` behind its pinhole."""
    turn = rotation(np.radians(degrees))
    behind = np.array([0.0, 0.0, -lever_mm])
    R = turn @ camera.rotation()
    t = turn @ (np.array([camera.x0, camera.y0, camera.z0]) - behind) + behind
    # Eq. (1) taken apart: R[0] = (ca cg, -sa cg, sg), R[:, 2] = (sg, -cg sb, cg cb)
    return replace(
        camera,
        alpha=float(np.arctan2(-R[0, 1], R[0, 0])),
        beta=float(np.arctan2(-R[1, 2], R[2, 2])),
        gamma=float(np.arcsin(R[0, 2])),
        x0=float(t[0]),
        y0=float(t[1]),
        z0=float(t[2]),
    )


def core_camera(camera: PlainCamera) -> Camera:
    return Camera.from_paper(
        phd_px=camera.phd,
        cx_px=camera.cx,
        cy_px=camera.cy,
        kappa_per_px2=camera.kappa,
        aspect=camera.aspect,
        alpha_rad=camera.alpha,
        beta_rad=camera.beta,
        gamma_rad=camera.gamma,
        x0_mm=camera.x0,
        y0_mm=camera.y0,
        z0_mm=camera.z0,
    )


def core_pair(cam1: PlainCamera, cam2: PlainCamera) -> StereoPair:
    return StereoPair(core_camera(cam1), core_camera(cam2))


#: poses of a flat specimen: tilts about X and Y in rad, place in mm
POSES = (((0.0, 0.0), (0.0, 0.0, 0.0)), ((0.15, -0.1), (3.0, 2.0, 6.0)), ((-0.12, 0.14), (-2.0, 3.0, -8.0)))


def picture(camera: PlainCamera, pose: int, *, seed: int, noise: float = 2.0, n: int = 3) -> NDArray[np.uint8]:
    """The speckled specimen in one of its poses, as a camera sees it, from n x n rays a pixel."""
    (rx, ry), place = POSES[pose]
    frame = rotation(np.array([rx, ry, 0.0]))[:, :2]
    wavelength = 2.6 * SIZE[0] / camera.size[0]
    texture = Waves(wavelength, seed=3)
    return render(camera, texture, frame=frame, origin=np.array(place), n=n, noise=noise, seed=seed)


#: as they were calibrated
CAM1, CAM2 = plain_camera(-1.0), plain_camera(1.0)


@lru_cache(maxsize=32)
def seen(camera: PlainCamera, pose: int, n: int = 3) -> NDArray[np.uint8]:
    """The picture of a pose, rendered once, with each camera's own noise."""
    return picture(camera, pose, seed=10 * pose + (camera.phd > 1300.0), n=n)


def repaired(one: PlainCamera, two: PlainCamera, poses: tuple[int, ...] = (0, 1), n: int = 3) -> RepairedPair:
    """The repair of the calibrated pair from pictures of the cameras as they are now."""
    images = [(seen(one, k, n), seen(two, k, n)) for k in poses]
    return repair_orientation(core_pair(CAM1, CAM2), images, grid(), MeasureOptions(subset_px=SUBSET_PX))


def pose_points(camera: PlainCamera, pose: int, xy_px: Array) -> Array:
    """Where the camera's pixels (n, 2) meet the specimen, system frame (n, 3)."""
    (rx, ry), place = POSES[pose]
    frame = rotation(np.array([rx, ry, 0.0]))
    X, Y = (xy_px[:, 0] - camera.cx), (xy_px[:, 1] - camera.cy) / camera.aspect
    scale = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * camera.kappa * (X**2 + Y**2)))
    d = np.stack([X * scale / camera.phd, Y * scale / camera.phd, np.ones_like(X)], -1) @ camera.rotation()
    c = camera.centre()
    normal = frame[:, 2]
    depth = ((np.array(place) - c) @ normal) / (d @ normal)
    return np.asarray(c + d * depth[:, None])


def grid(size: tuple[int, int] = SIZE) -> PointGrid:
    margin = 60.0 * size[0] / SIZE[0]
    return PointGrid.rectangle(margin, margin, size[0] - 1 - margin, size[1] - 1 - margin, spacing_px=float(SPACING_PX))


def false_strain(true_mm: Array, found_mm: Array) -> Array:
    """Largest in-plane strain over the points (n, 3) of a flat specimen: their map is fitted by a quadratic.

    Lengths along two directions of the plane before and after, by finite differences of the fitted map.
    """
    centred = true_mm - true_mm.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    ab = centred @ axes[:2].T
    half = np.abs(ab).max()

    def terms(p: Array) -> Array:
        x, y = p[:, 0] / half, p[:, 1] / half
        return np.column_stack([np.ones(len(p)), x, y, x * x, x * y, y * y])

    coefficients = np.linalg.lstsq(terms(ab), found_mm, rcond=None)[0]
    h = 1e-3 * half
    tangents = np.stack([(terms(ab + d) - terms(ab - d)) @ coefficients / (2 * h) for d in np.eye(2) * h], axis=2)
    metric = np.swapaxes(tangents, 1, 2) @ tangents
    return np.asarray(np.abs(np.linalg.eigvalsh(0.5 * (metric - np.eye(2)))).max(axis=1))
