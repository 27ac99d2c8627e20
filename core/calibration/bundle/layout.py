"""The unknowns of the adjustment and their places in one vector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from core.arrays import Float
from core.cameras.camera import POSE_NAMES, Camera, RigidTransform, angles_from_rotation, rotation_from_angles
from core.cameras.lens import LensModel, OpenCVLens, SeidelLens
from core.errors import CalibrationInputError

Moves = Literal["cameras", "both_cameras", "target", "free"]
LensName = Literal["paper", "opencv5", "opencv8"]
N_POSE = 6

_OPENCV5 = ("k1", "k2", "p1", "p2", "k3")
_OPENCV8 = (*_OPENCV5, "k4", "k5", "k6")
DISTORTION: dict[LensName, tuple[str, ...]] = {
    "paper": ("kappa_per_px2",),
    "opencv5": _OPENCV5,
    "opencv8": _OPENCV8,
}


def start_lens(name: LensName, *, phd_px: float, centre_px: tuple[float, float], aspect: float) -> LensModel:
    """Return a lens without distortion."""
    if name == "paper":
        return SeidelLens(phd_px, *centre_px, 0.0, aspect)
    return OpenCVLens(phd_px, phd_px * aspect, *centre_px)


@dataclass(frozen=True)
class LensUnknowns:
    """The unknowns of a camera's lens.

    Attributes
    ----------
    name
        The model.
    aspect_free
        True where the aspect ratio is an unknown; else the rows' focal length follows the columns'.
    """

    name: LensName
    aspect_free: bool

    @cached_property
    def count(self) -> int:
        """Number of unknowns."""
        return 3 + int(self.aspect_free) + len(DISTORTION[self.name])

    def names_in(self, lens: LensModel) -> tuple[str, ...]:
        """Return the lens's parameters that the unknowns move, in the order of :meth:`spread`'s rows."""
        if isinstance(lens, SeidelLens):
            return lens.parameter_names
        return ("fx_px", "fy_px", "cx_px", "cy_px", *DISTORTION[self.name])

    def spread(self, lens: LensModel) -> Float:
        """Return d(parameters of the lens) / d(unknowns), (all of ``lens.parameter_names``, count)."""
        names = lens.parameter_names
        out = np.zeros((len(names), self.count))
        if isinstance(lens, SeidelLens):
            for k, name in enumerate(("phd_px", "cx_px", "cy_px", "kappa_per_px2")):
                out[names.index(name), k] = 1.0
            if self.aspect_free:
                out[names.index("aspect"), 4] = 1.0
            return out
        assert isinstance(lens, OpenCVLens)
        out[names.index("fx_px"), 0] = 1.0
        out[names.index("fy_px"), 0] = lens.fy_px / lens.fx_px
        out[names.index("cx_px"), 1] = 1.0
        out[names.index("cy_px"), 2] = 1.0
        first = 3
        if self.aspect_free:
            out[names.index("fy_px"), 3] = lens.fx_px
            first = 4
        for k, name in enumerate(DISTORTION[self.name]):
            out[names.index(name), first + k] = 1.0
        return out

    def moved(self, lens: LensModel, step: Float) -> LensModel:
        """Return the lens after a step of its unknowns."""
        if isinstance(lens, SeidelLens):
            aspect = lens.aspect + (float(step[4]) if self.aspect_free else 0.0)
            return SeidelLens(
                lens.phd_px + float(step[0]),
                lens.cx_px + float(step[1]),
                lens.cy_px + float(step[2]),
                lens.kappa_per_px2 + float(step[3]),
                aspect,
            )
        assert isinstance(lens, OpenCVLens)
        aspect = lens.fy_px / lens.fx_px + (float(step[3]) if self.aspect_free else 0.0)
        fx = lens.fx_px + float(step[0])
        first = 4 if self.aspect_free else 3
        terms = {
            name: float(getattr(lens, name) + step[first + k]) for k, name in enumerate(DISTORTION[self.name])
        }
        return replace(
            lens,
            fx_px=fx,
            fy_px=fx * aspect,
            cx_px=lens.cx_px + float(step[1]),
            cy_px=lens.cy_px + float(step[2]),
            **terms,
        )


@dataclass(frozen=True)
class State:
    """Values of all unknowns.

    Attributes
    ----------
    cameras
        Both cameras at dZ = 0.
    axes
        (2, 2) tilt of each camera's own stage axis in its x and y; unused where one stage moves.
    direction
        (2,) X and Y of the single stage's direction over its Z, in the system frame.
    stage_scale
        True travel over read-back travel.
    poses
        ``sys_from_target`` of the free poses; the first is the identity where nothing else defines the system frame.
    points_mm
        (n, 3) corrections of the target's points.
    """

    cameras: tuple[Camera, Camera]
    axes: Float
    direction: Float
    stage_scale: float
    poses: tuple[RigidTransform, ...]
    points_mm: Float


@dataclass(frozen=True)
class Layout:
    """Places of the unknowns in one vector.

    Attributes
    ----------
    lens
        The lens's unknowns, of both cameras alike.
    moves
        What the stage moves; ``free`` without a stage.
    stage
        True if there are stage views.
    tilts, direction, scale
        True if these are unknowns.
    poses
        Number of free poses; ``held_pose`` True if the first is the system frame itself.
    """

    lens: LensUnknowns
    moves: Moves
    tilts: bool
    direction: bool
    scale: bool
    poses: int
    held_pose: bool

    @cached_property
    def per_camera(self) -> int:
        """Unknowns of a camera."""
        return self.lens.count + N_POSE

    def camera(self, c: int) -> slice:
        """Place of a camera's lens and pose."""
        return slice(c * self.per_camera, (c + 1) * self.per_camera)

    @cached_property
    def tilt_at(self) -> int:
        """Place of the first tilt."""
        return 2 * self.per_camera

    @cached_property
    def direction_at(self) -> int:
        """Place of the stage's direction."""
        return self.tilt_at + (4 if self.tilts else 0)

    @cached_property
    def scale_at(self) -> int:
        """Place of the stage's scale."""
        return self.direction_at + (2 if self.direction else 0)

    @cached_property
    def poses_at(self) -> int:
        """Place of the first free pose."""
        return self.scale_at + int(self.scale)

    def pose(self, k: int) -> slice | None:
        """Place of a pose; None where it is held."""
        j = k - int(self.held_pose)
        return None if j < 0 else slice(self.poses_at + N_POSE * j, self.poses_at + N_POSE * (j + 1))

    @cached_property
    def size(self) -> int:
        """Number of unknowns without the target's points."""
        return self.poses_at + N_POSE * (self.poses - int(self.held_pose))

    def moved(self, state: State, step: Float, points: Float) -> State:
        """Return the state after a step."""
        cameras = []
        for c, camera in enumerate(state.cameras):
            own = step[self.camera(c)]
            lens = self.lens.moved(camera.lens, own[: self.lens.count])
            angles = np.array(angles_from_rotation(camera.cam_from_sys.rotation)) + own[self.lens.count :][:3]
            shift = camera.cam_from_sys.translation_mm + own[self.lens.count + 3 :]
            cameras.append(Camera(lens, RigidTransform(rotation_from_angles(*angles), shift)))
        axes, direction, scale = state.axes, state.direction, state.stage_scale
        if self.tilts:
            axes = axes + step[self.tilt_at : self.tilt_at + 4].reshape(2, 2)
        if self.direction:
            direction = direction + step[self.direction_at : self.direction_at + 2]
        if self.scale:
            scale = scale + float(step[self.scale_at])
        poses = []
        for k, pose in enumerate(state.poses):
            at = self.pose(k)
            poses.append(pose if at is None else turned(pose, step[at]))
        return State((cameras[0], cameras[1]), axes, direction, scale, tuple(poses), state.points_mm + points)


def turned(pose: RigidTransform, step: Float) -> RigidTransform:
    """Turn a pose by the rotation vector ``step[:3]`` about its own origin, and shift it by ``step[3:]``."""
    return RigidTransform(rotation_of(step[:3]) @ pose.rotation, pose.translation_mm + step[3:])


def rotation_of(vector: Float) -> Float:
    """Return the rotation (3, 3) of a rotation vector."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        cross = cross_matrix(vector)
        return np.asarray(np.eye(3) + cross)
    cross = cross_matrix(vector / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def cross_matrix(v: Float) -> Float:
    """Return the matrix of the cross product with a vector."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def camera_parameter_names(lens: LensModel) -> tuple[str, ...]:
    """Names of the numbers of one camera in a covariance: its lens's, and the pose of Eq. (3)."""
    if isinstance(lens, SeidelLens):
        return ("phd_px", "cx_px", "cy_px", "kappa_per_px2", *POSE_NAMES)
    if isinstance(lens, OpenCVLens):
        terms = _OPENCV8 if lens.rational else _OPENCV5
        return ("fx_px", "fy_px", "cx_px", "cy_px", *terms, *POSE_NAMES)
    raise CalibrationInputError(f"a {type(lens).__name__} has no parameters of a calibration")
