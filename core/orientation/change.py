"""Change of the relative orientation of two cameras, in five numbers; the baseline's length is kept.

``rotation`` is a rotation vector in camera 2's frame: camera 2 turns about its pinhole by it. ``direction`` turns the
baseline, seen from camera 1: first towards the specimen, in the plane that holds the baseline and camera 1's optical
axis, then out of that plane. A turn of camera 1 is a change of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import Rays, StereoPair, some_rays

CHANGE_NAMES = ("rotation_x_rad", "rotation_y_rad", "rotation_z_rad", "baseline_forward_rad", "baseline_sideways_rad")
LEVER = 0.3
"""Shift of a pinhole over baseline and turn: cameras turn about their mounts, some tenths of a baseline away."""
_STEP_RAD = 1e-5


def changed(pair: StereoPair, change: Float) -> StereoPair:
    """Return the pair with camera 2 moved by a change (5,), :data:`CHANGE_NAMES`; camera 1 keeps its pose."""
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    change = np.asarray(change, dtype=np.float64)
    relative = pair.cam2_from_cam1
    rotation = Rotation.from_rotvec(change[:3]).as_matrix() @ relative.rotation
    centre, axes = _baseline(pair)
    turned = Rotation.from_rotvec(np.cross(centre / np.linalg.norm(centre), change[3:] @ axes)).apply(centre)
    moved = RigidTransform(rotation, -rotation @ turned)
    return StereoPair(pair.cam1, Camera(pair.cam2.lens, moved @ pair.cam1.cam_from_sys))


def changes_between(before: StereoPair, after: StereoPair) -> Float:
    """Return the change (5,) from one pair to another; a difference of the baselines' lengths is left out."""
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    turn = after.cam2_from_cam1.rotation @ before.cam2_from_cam1.rotation.T
    centre, axes = _baseline(before)
    unit = centre / np.linalg.norm(centre)
    now = after.cam2_from_cam1.inverse().translation_mm
    now = now / np.linalg.norm(now)
    along, across = float(unit @ now), axes @ now
    sine = float(np.linalg.norm(across))
    angle = np.arctan2(sine, along) / sine if sine > 0.0 else 1.0
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), across * angle])


Ends = tuple[tuple[StereoPair, StereoPair], ...]


def ends_of(pair: StereoPair, change: Float) -> Ends:
    """Return for each number of a change the pair a little further along it and a little back, for differences."""
    return tuple((changed(pair, change + s), changed(pair, change - s)) for s in np.eye(5) * _STEP_RAD)


def offset_slopes(pair: StereoPair, change: Float, rays: Rays, ends: Ends | None = None) -> Float:
    """Return d(epipolar offset of matched points, px) / d(change), (n, 5), at a change of the pair.

    ``rays`` are the points' rays in both cameras; ``ends`` is :func:`ends_of` of pair and change, if it is known.
    """
    one, two = rays
    jacobian = pair.cam2.lens.image_jacobian(two.xyz_mm[..., :2])
    offsets = (
        [side.epipolar_residual_at(one, two, jacobian) for side in sides] for sides in ends or ends_of(pair, change)
    )
    return np.stack([(ahead - back) / (2.0 * _STEP_RAD) for ahead, back in offsets], axis=-1)


def point_slopes(pair: StereoPair, rays: Rays, ends: Ends | None = None) -> Float:
    """Return d(triangulated points of the system frame, mm) / d(change), (n, 3, 5).

    ``rays`` are the points' rays in both cameras; ``ends`` is :func:`ends_of` of the pair at no change, if it is known.
    """
    points = ([side.triangulate_rays(*rays).xyz_mm for side in sides] for sides in ends or ends_of(pair, np.zeros(5)))
    return np.stack([(ahead - back) / (2.0 * _STEP_RAD) for ahead, back in points], axis=-1)


@dataclass(frozen=True, eq=False)
class ChangeSlopes:
    """Derivatives of matched points over a change of the pair, computed once for several questions.

    Attributes
    ----------
    pair
        The cameras before a change.
    rays
        The points' rays in both cameras.
    ends
        :func:`ends_of` of the pair at no change, if it is known.
    """

    pair: StereoPair
    rays: Rays
    ends: Ends | None = None

    def at(self, which: NDArray[np.int64]) -> ChangeSlopes:
        """Return the derivatives of some of the points, by their indices."""
        return ChangeSlopes(self.pair, some_rays(self.rays, which), self.ends)

    @cached_property
    def offset(self) -> Float:
        """(n, 5) :func:`offset_slopes` at no change."""
        return offset_slopes(self.pair, np.zeros(5), self.rays, self.ends)

    @cached_property
    def position(self) -> Float:
        """(n, 3, 5) :func:`point_slopes`."""
        return point_slopes(self.pair, self.rays, self.ends)


def plausible_bump(pair: StereoPair) -> Float:
    """Return the covariance (5, 5) of the changes by bumps of 1 rad: either camera turns about some axis.

    Each camera's turn has one variance about each axis, and pinholes shift by :data:`LEVER` times the turn over the
    baseline. Epipolar offsets leave some changes nearly undetermined; those are then no larger than the ones that they
    determine.
    """
    centre, axes = _baseline(pair)
    unit = centre / np.linalg.norm(centre)
    of_camera1 = np.zeros((5, 3))
    of_camera1[:3] = -pair.cam2_from_cam1.rotation
    of_camera1[3:] = axes @ np.cross(np.eye(3), unit).T
    of_camera2 = np.zeros((5, 3))
    of_camera2[:3] = np.eye(3)
    of_shift = np.zeros((5, 2))
    of_shift[3:] = LEVER * np.eye(2)
    return np.asarray(sum(J @ J.T for J in (of_camera1, of_camera2, of_shift)))


def pinhole_shift(pair: StereoPair, change: Float) -> tuple[Float, Float]:
    """Return the shift (2,) of a pinhole across the baseline, over its length, and its derivatives (2, 5).

    The smaller one of two: camera 2 alone was bumped, or camera 1 alone, whose turn turns the baseline's direction.
    """
    centre, axes = _baseline(pair)
    unit = centre / np.linalg.norm(centre)
    of_2 = np.zeros((2, 5))
    of_2[:, 3:] = np.eye(2)
    of_1 = of_2.copy()
    back = -pair.cam2_from_cam1.rotation.T  # camera 1's turn, in its own frame, that looks like camera 2's
    of_1[:, :3] = -axes @ np.cross(np.eye(3), unit).T @ back
    ways = [(J @ change, J) for J in (of_2, of_1)]
    return min(ways, key=lambda way: float(np.linalg.norm(way[0])))


def _baseline(pair: StereoPair) -> tuple[Float, Float]:
    """Camera 2's pinhole in camera 1's frame (3,), and the unit vectors (2, 3) of its two turns."""
    centre = np.array(pair.cam2_from_cam1.inverse().translation_mm)
    unit = centre / np.linalg.norm(centre)
    ahead = np.array([0.0, 0.0, 1.0]) if abs(unit[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    forward = ahead - (ahead @ unit) * unit
    forward /= np.linalg.norm(forward)
    return centre, np.stack([forward, np.cross(unit, forward)])
