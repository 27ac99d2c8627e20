"""Poses of a target: as given, and a hand's, which are drawn from a seed and a number.

A pose is ``[rx_deg, ry_deg, rz_deg, x_mm, y_mm, z_mm]``: the rotation vector (axis times angle, in degrees) and the
place of the target's centre in the rig's system frame. At six zeros the target's frame is the system frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.sim.boards.target import SimTarget

_TILT_DEG: Final = 40.0
_ROLL_DEG: Final = 35.0
_DISTANCE: Final = 0.15
_INSIDE: Final = 0.01  # share of the image that a board keeps free at its borders
_DRAWS: Final = 200
_HALVINGS: Final = 12
_MOST: Final = 1_000_000
_FARTHEST: Final = 1e6


def transform_of(pose: Sequence[float]) -> RigidTransform:
    """Return sys_from_target of a pose; ValueError if it is not six numbers of less than a million."""
    numbers = np.asarray(pose, dtype=np.float64)
    if numbers.shape != (6,) or not (np.abs(numbers) < _FARTHEST).all():
        raise ValueError(f"pose must be [rx_deg, ry_deg, rz_deg, x_mm, y_mm, z_mm], got {pose}")
    return RigidTransform(Rotation.from_rotvec(numbers[:3], degrees=True).as_matrix(), numbers[3:])


def pose_of(sys_from_target: RigidTransform) -> tuple[float, ...]:
    """Return the six numbers of a transform."""
    turn = Rotation.from_matrix(sys_from_target.rotation).as_rotvec(degrees=True)
    return tuple(float(v) for v in (*turn, *sys_from_target.translation_mm))


def hand_pose(
    target: SimTarget, cameras: Sequence[Camera], size_px: Sequence[tuple[int, int]], number: int, *, seed: int
) -> tuple[float, ...]:
    """Return the pose in which a hand holds the target for the ``number``-th view.

    Tilts to 40 degrees in any direction, rolls to 35 degrees (every fourth view on its side, 90 degrees more),
    distances to 15 % about the place where the cameras look together, and places all over the images, every second at
    their borders, as long as both cameras see the field of points and most of its frame. A target too large for
    that is held as far inside as the draws find, amid the images.

    Parameters
    ----------
    target
        Gives the field of points.
    cameras, size_px
        The rig's cameras, and the columns and rows of their images.
    number
        0, 1, 2 ...; the same number is the same pose.
    seed
        Seed of the sequence.
    """
    if not 0 <= number <= _MOST:
        raise ValueError(f"hand must be a number from 0 to {_MOST}, got {number}")
    rng = np.random.default_rng([seed, number])
    centre, view = _common_view(cameras)
    border = target.pitch_mm * (0.6 if target.kind in ("checkerboard", "charuco") else 0.5)
    half_x, half_y = (half + border for half in target.half_field_mm())
    rim = np.array([[i * half_x, j * half_y, 0.0] for j in (-1, 0, 1) for i in (-1, 0, 1)])
    pinhole = np.mean([camera.centre_sys_mm for camera in cameras], axis=0)
    away = float(np.linalg.norm(centre - pinhole))

    def room(rotation: Float, at: Float) -> float:
        points = RigidTransform(rotation, at).apply(rim)
        return min(_room(camera, size, points) for camera, size in zip(cameras, size_px, strict=True))

    best: tuple[float, RigidTransform] = (-np.inf, RigidTransform(view, centre))
    for _ in range(_DRAWS):
        tilt, about = _TILT_DEG * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        roll = rng.uniform(-_ROLL_DEG, _ROLL_DEG) + (90.0 if number % 4 == 3 else 0.0)
        middle = centre + rng.uniform(-_DISTANCE, _DISTANCE) * away * view[:, 2]
        towards, share = rng.uniform(0.0, 2.0 * np.pi), 1.0 if number % 2 else np.sqrt(rng.uniform())
        turn = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]), degrees=True)
        rotation = view @ (turn * Rotation.from_rotvec([0.0, 0.0, roll], degrees=True)).as_matrix()
        inside = room(rotation, middle)
        if inside > best[0]:
            best = inside, RigidTransform(rotation, middle)
        if inside < _INSIDE:
            continue
        # sidewards as far as both cameras see it, and back by a share
        side = view[:, 0] * np.cos(towards) + view[:, 1] * np.sin(towards)
        near, far = 0.0, away
        for _ in range(_HALVINGS):
            half = 0.5 * (near + far)
            near, far = (half, far) if room(rotation, middle + half * side) >= _INSIDE else (near, half)
        return pose_of(RigidTransform(rotation, middle + share * near * side))
    return pose_of(best[1])


def _room(camera: Camera, size_px: tuple[int, int], points_mm: Float) -> float:
    """Distance of the points' images from the image's borders, as a share of its size; negative outside."""
    xy = camera.project(points_mm).xy
    if not np.isfinite(xy).all():
        return -np.inf
    last = np.asarray(size_px, dtype=np.float64) - 1.0
    return float(np.min(np.minimum(xy, last - xy) / last))


def _common_view(cameras: Sequence[Camera]) -> tuple[Float, Float]:
    """Return the point nearest to all optical axes (3,), and axes (3, 3): right, down, away of a viewer amid them."""
    normal_matrix, rhs = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        axis = camera.cam_from_sys.rotation[2]
        across = np.eye(3) - np.outer(axis, axis)
        normal_matrix += across
        rhs += across @ camera.centre_sys_mm
    mean = np.mean([camera.cam_from_sys.rotation for camera in cameras], axis=0)
    u, _, vt = np.linalg.svd(mean)
    nearest = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    centre = np.linalg.lstsq(normal_matrix, rhs, rcond=None)[0]
    return centre.astype(np.float64), np.asarray(nearest.T)
