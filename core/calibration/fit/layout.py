"""The unknowns of the adjustment: the list, the place of each in one vector, and their priors.

For each camera: its lens (:mod:`stereorig.core.calibration.fit.lens_form`), its pose at dZ = 0 (angles of Eq. (1) and
T) and the tilt of its own stage's axis; for a single stage its direction in the system frame; the stages' scales and
the error of each position that was read back; the scale of the target's pitch; and six unknowns for each free pose of
the target. (1) and T) and the tilt of its own stage's axis; of a single stage its direction in the system frame; the
stages' scales and the error of each position that was read back; the scale of the target's pitch; and six of each free
pose of the target. The nodes' corrections are not in the vector, since they are eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.calibration.fit.lens_form import LensForm
from stereorig.core.calibration.inputs import CalibrationOptions, Moves, NominalValues
from stereorig.core.cameras.camera import Camera, RigidTransform, rotation_from_angles

N_POSE = 6
#: of a measured aspect ratio whose standard deviation is not stated: section 3.2.2 repeats to some 1e-5, and a grid
#: tilted by a degree biases it by 1.5e-4; square pixels are exact
ASPECT_SIGMA = 1e-4
_LOOSE_ASPECT_SIGMA = 0.05  # where free poses show it: no sensor's pixels are further from the nominal ratio
_DIRECTION_SIGMA_RAD = 0.5  # direction of a single stage's axis relative to the target's normal


@dataclass(frozen=True)
class Layout:
    """Places of the unknowns in the vector.

    Attributes
    ----------
    form
        Lens model, the same for both cameras.
    moves
        Part of the rig that the stage moves.
    frames
        Numbers of the free poses that are unknowns.
    steps
        (axis, dZ) of each position that was read back, axis 0 or 1: the camera's own stage; 0 for a single stage.
    """

    form: LensForm
    moves: Moves
    frames: tuple[int, ...]
    steps: tuple[tuple[int, float], ...]

    @property
    def n_camera(self) -> int:
        """Unknowns of one camera."""
        return self.form.size + N_POSE + 2

    @property
    def motion(self) -> int:
        """Index of the single stage's direction, two; then two stage scales, and the pitch's scale."""
        return 2 * self.n_camera

    @property
    def size(self) -> int:
        """Number of unknowns without the nodes."""
        return self.motion + 5 + len(self.steps) + N_POSE * len(self.frames)

    @property
    def pitch_scale(self) -> int:
        """Index of the pitch's scale."""
        return self.motion + 4

    def lens(self, c: int) -> slice:
        """Lens of camera ``c``."""
        first = c * self.n_camera
        return slice(first, first + self.form.size)

    def pose(self, c: int) -> slice:
        """Pose of camera ``c``."""
        first = c * self.n_camera + self.form.size
        return slice(first, first + N_POSE)

    def tilt(self, c: int) -> slice:
        """Tilt of camera ``c``'s own stage axis."""
        first = c * self.n_camera + self.form.size + N_POSE
        return slice(first, first + 2)

    @property
    def direction(self) -> slice:
        """Direction of a single stage."""
        return slice(self.motion, self.motion + 2)

    def stage_scale(self, axis: int) -> int:
        """Index of a stage's scale."""
        return self.motion + 2 + axis

    def axis_of(self, c: int) -> int:
        """Stage axis whose travel camera ``c`` shows."""
        return c if self.moves == "cameras" else 0

    def step(self, axis: int, dz_mm: float) -> int | None:
        """Index of a position's error, None if the position is not among the steps."""
        try:
            return self.motion + 5 + self.steps.index((axis, dz_mm))
        except ValueError:
            return None

    @property
    def stage(self) -> tuple[int, ...]:
        """Indices of all that is unknown of the stage: tilts, direction, scales, steps."""
        tilts = [k for c in range(2) for k in range(self.tilt(c).start, self.tilt(c).stop)]
        first = self.motion + 5
        return (*tilts, *range(self.motion, self.motion + 4), *range(first, first + len(self.steps)))

    def frame(self, number: int) -> slice | None:
        """Pose of a free frame; None for the one that defines the system frame."""
        try:
            first = self.motion + 5 + len(self.steps) + N_POSE * self.frames.index(number)
        except ValueError:
            return None
        return slice(first, first + N_POSE)


@dataclass(frozen=True)
class State:
    """Values of all unknowns.

    Attributes
    ----------
    x
        (size,); the free poses' entries are zero, they are kept as transforms.
    sys_from_target
        Pose of the target in each free frame.
    nodes_mm
        (n, 3) corrections of the nodes.
    """

    x: Float
    sys_from_target: dict[int, RigidTransform]
    nodes_mm: Float

    def plus(self, layout: Layout, step: Float, nodes_step: Float) -> State:
        """Return the state after a step; turns of free poses are applied on the left."""
        x = self.x + step
        poses = dict(self.sys_from_target)
        for number in layout.frames:
            span = layout.frame(number)
            assert span is not None
            d = step[span]
            x[span] = 0.0
            pose = poses[number]
            poses[number] = RigidTransform(turned(d[:3]) @ pose.rotation, pose.translation_mm + d[3:])
        return State(x, poses, self.nodes_mm + nodes_step)


def turned(rotation_vector: Float) -> Float:
    """Rotation (3, 3) by a rotation vector, radians."""
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    return np.asarray(Rotation.from_rotvec(rotation_vector).as_matrix())


def camera_of(layout: Layout, x: Float, c: int) -> Camera:
    """Return camera ``c`` at dZ = 0."""
    alpha, beta, gamma, x0, y0, z0 = x[layout.pose(c)]
    pose = RigidTransform(rotation_from_angles(alpha, beta, gamma), np.array([x0, y0, z0]))
    return Camera(layout.form.lens(x[layout.lens(c)]), pose)


def travel_mm(layout: Layout, x: Float, c: int, dz_mm: float) -> float:
    """Return the stage's true travel at a position that was read back as ``dz_mm``."""
    axis = layout.axis_of(c)
    index = layout.step(axis, dz_mm)
    error = 0.0 if index is None else float(x[index])
    return (1.0 + float(x[layout.stage_scale(axis)])) * dz_mm + error


def shift_cam_mm(layout: Layout, x: Float, c: int, dz_mm: float, rotation: Float) -> Float:
    """Shift (3,) of the target in camera ``c``'s frame at a stage position."""
    travel = travel_mm(layout, x, c, dz_mm)
    if layout.moves == "cameras":
        return travel * direction(x[layout.tilt(c)])
    return np.asarray(travel * (rotation @ direction(x[layout.direction])))


def camera_seeing(layout: Layout, state: State, c: int, dz_mm: float | None, frame: int | None) -> Camera:
    """Return camera ``c`` with its pose towards the target itself, ``cam_from_target``, in one view."""
    camera = camera_of(layout, state.x, c)
    pose = camera.cam_from_sys
    if frame is not None and frame in state.sys_from_target:
        pose = pose @ state.sys_from_target[frame]
    if dz_mm is not None:
        shift = shift_cam_mm(layout, state.x, c, dz_mm, camera.cam_from_sys.rotation)
        pose = RigidTransform(pose.rotation, pose.translation_mm + shift)
    return Camera(camera.lens, pose)


@dataclass(frozen=True)
class Priors:
    """Priors of the unknowns, before the views.

    Attributes
    ----------
    mean, weight
        (size,); weight is 1 over the variance, 0 without a prior.
    free
        (size,) False for held unknowns.
    carried
        (size,) 1 over the variance of held unknowns whose uncertainty is propagated into the covariance; 0 elsewhere.
    node_weight
        (3,) 1 over the variance of a node's corrections along X, Y and Z; infinite for a held one.
    """

    mean: Float
    weight: Float
    free: Bool
    carried: Float
    node_weight: Float

    @property
    def opened(self) -> Priors:
        """Priors with all that is carried as unknowns."""
        return replace(self, free=self.free | (self.carried > 0.0), weight=self.weight + self.carried)

    @property
    def nodes_free(self) -> int:
        """Number of a node's corrections that are unknowns: 0, 2 or 3."""
        return int(np.isfinite(self.node_weight).sum())


def priors(
    layout: Layout,
    nominals: Sequence[NominalValues],
    options: CalibrationOptions,
    *,
    pitch_scale_sigma: float,
    node_sigma_mm: tuple[float, float],
) -> Priors:
    """Return the priors of all unknowns.

    Parameters
    ----------
    layout, nominals, options
        The unknowns, the nominal cameras and the settings.
    pitch_scale_sigma
        Relative standard deviation of the target's pitch; 0 holds it.
    node_sigma_mm
        Standard deviations of a node's correction within the target's plane and out of it; 0 holds them.
    """
    sigma, mean = np.full(layout.size, np.inf), np.zeros(layout.size)
    carried = np.zeros(layout.size)
    staged = bool(layout.steps)
    for c, nominal in enumerate(nominals):
        aspect = (
            (_LOOSE_ASPECT_SIGMA if layout.frames else 0.0) if options.aspect_sigma is None else options.aspect_sigma
        )
        sigma[layout.lens(c)] = layout.form.prior_sigma(
            nominal.image_size_px, nominal.phd_px, centre_px=options.centre_sigma_px, aspect=aspect
        )
        span = layout.lens(c)
        mean[span.start + 1 : span.start + 3] = nominal.centre_px
        mean[span.stop - 1] = nominal.aspect
        if options.aspect_sigma is None and not layout.frames and nominal.aspect != 1.0:
            carried[span.stop - 1] = ASPECT_SIGMA**-2
        sigma[layout.tilt(c)] = options.axis_tilt_sigma_rad if staged and layout.moves == "cameras" else 0.0
    sigma[layout.direction] = _DIRECTION_SIGMA_RAD if staged and layout.moves != "cameras" else 0.0
    for axis in range(2):
        used = any(step[0] == axis for step in layout.steps)
        sigma[layout.stage_scale(axis)] = options.scale_sigma if used else 0.0
    sigma[layout.pitch_scale] = pitch_scale_sigma
    sigma[layout.motion + 5 : layout.motion + 5 + len(layout.steps)] = options.stage_step_sigma_mm
    free = sigma > 0.0
    weight = np.zeros(layout.size)
    known = free & np.isfinite(sigma)
    weight[known] = sigma[known] ** -2
    node = np.array([node_sigma_mm[0], node_sigma_mm[0], node_sigma_mm[1]])
    with np.errstate(divide="ignore"):
        return Priors(mean, weight, free, carried, node**-2.0)


# A direction near Z by its first two components: the stage's axis in a camera's frame or in the system frame.


def direction(tilt: Float) -> Float:
    """Unit vector (3,) with the first two components ``tilt`` and a positive third one."""
    return np.array([tilt[0], tilt[1], np.sqrt(max(1.0 - float(tilt[0] ** 2 + tilt[1] ** 2), 1e-12))])


def direction_jacobian(tilt: Float) -> Float:
    """Derivatives (3, 2) of :func:`direction`."""
    third = direction(tilt)[2]
    return np.array([[1.0, 0.0], [0.0, 1.0], [-tilt[0] / third, -tilt[1] / third]])
