"""Problem of the adjustment: views, nominal points and settings; its unknowns under a lens model, and their start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.free_start import pose_of, start_free
from stereorig.core.calibration.fit.layout import Layout, Priors, State, camera_of, priors
from stereorig.core.calibration.fit.lens_form import LensForm, LensName
from stereorig.core.calibration.fit.model import linearise_all
from stereorig.core.calibration.fit.observations import ViewRows, collect
from stereorig.core.calibration.fit.single import fit_single
from stereorig.core.calibration.inputs import CalibrationOptions, CalibrationView, Moves, NominalValues
from stereorig.core.cameras.camera import RigidTransform, angles_from_rotation
from stereorig.core.cameras.opencv_full import TILT_TERMS
from stereorig.core.names import CAMERAS

_PAPER = LensForm("paper")


@dataclass(frozen=True)
class FitData:
    """Views to fit, with all that is given.

    Attributes
    ----------
    views
        The views to fit, of both cameras.
    nodes_mm
        (n_a, n_b, 2) nominal points.
    nominals, options
        Nominal cameras and settings.
    moves
        Part of the rig that the stage moves; ``free`` without stage positions.
    node_sigma_mm
        Prior on a node's correction within the plane, and out of it; 0 holds them.
    pitch_scale_sigma
        Relative prior on the pitch.
    system_frame
        Number of the free pose that defines the system frame; None if the stage's views define it.
    cameras_held
        True holds both cameras' poses: each has its own target's poses, and nothing ties the cameras.
    sensor_tilt_sigma_rad
        Prior on a sensor's tilt, each way; None: the lens model's prior, which is nearly uninformative.
    """

    views: tuple[CalibrationView, ...]
    nodes_mm: Float
    nominals: tuple[NominalValues, NominalValues]
    options: CalibrationOptions
    moves: Moves
    node_sigma_mm: tuple[float, float] = (0.0, 0.0)
    pitch_scale_sigma: float = 0.0
    system_frame: int | None = None
    cameras_held: bool = False
    sensor_tilt_sigma_rad: float | None = None

    @property
    def flat_nodes_mm(self) -> Float:
        """(n, 3) nominal points."""
        flat = self.nodes_mm.reshape(-1, 2)
        return np.column_stack([flat, np.zeros(len(flat))])

    @property
    def rows(self) -> list[ViewRows]:
        """The views as rows of the adjustment."""
        return collect(self.views)

    @property
    def staged(self) -> tuple[CalibrationView, ...]:
        """Views at stage positions."""
        return tuple(v for v in self.views if v.dz_mm is not None)

    @property
    def frames(self) -> tuple[int, ...]:
        """Numbers of the free poses, ascending."""
        return tuple(sorted({v.frame for v in self.views if v.frame is not None}))

    def layout(self, model: LensName) -> Layout:
        """Return the unknowns under a lens model."""
        axes = {
            (("cam1", "cam2").index(v.camera) if self.moves == "cameras" else 0, v.position_mm) for v in self.staged
        }
        free = tuple(k for k in self.frames if k != self.system_frame)
        return Layout(LensForm(model), self.moves, free, tuple(sorted(axes)))

    def priors(self, layout: Layout) -> Priors:
        """Return the priors of the unknowns."""
        known = priors(
            layout,
            self.nominals,
            self.options,
            pitch_scale_sigma=self.pitch_scale_sigma,
            node_sigma_mm=self.node_sigma_mm,
        )
        for c in range(2):
            if self.cameras_held:
                known.free[layout.pose(c)] = False
            if self.sensor_tilt_sigma_rad is not None:
                tilts = [3 + k for k, name in enumerate(layout.form.distortion_names) if name in TILT_TERMS]
                known.weight[layout.lens(c)][tilts] = self.sensor_tilt_sigma_rad**-2
        return known

    def without(self, views: Sequence[CalibrationView]) -> FitData:
        """Return the problem without some views; the frame that defines the system frame stays one of those left."""
        left = tuple(v for v in self.views if not any(v is other for other in views))
        frames = sorted({v.frame for v in left if v.frame is not None})
        first = self.system_frame
        if first is not None and first not in frames:
            first = frames[0] if frames else None
        return replace(self, views=left, system_frame=first)


def started(problem: FitData) -> tuple[FitData, State, tuple[int, ...]]:
    """Return the problem with its points counted alike, a start under the paper's lens, and frames that do not fit."""
    if problem.staged:
        state = _from_stage(problem)
        return problem, _with_poses(problem, state), ()
    return _from_free(problem)


def converted(state: State, layout: Layout, other: Layout) -> State:
    """Return a state under another lens model, in the other layout of the same problem."""
    x = np.zeros(other.size)
    for c in range(2):
        x[other.lens(c)] = layout.form.converted(state.x[layout.lens(c)], other.form)
        x[other.pose(c)] = state.x[layout.pose(c)]
        x[other.tilt(c)] = state.x[layout.tilt(c)]
    tail = other.size - other.motion
    x[other.motion :] = state.x[layout.motion : layout.motion + tail]
    return State(x, dict(state.sys_from_target), state.nodes_mm.copy())


def unfolded(problem: FitData, layout: Layout, state: State) -> State:
    """Return a state converted from the paper's lens, with a k2 where k1 alone has no image for a point of the views.

    In a wide lens k1 alone folds back within the image; 1 + k1 r^2 + k1^2 r^4 never does.
    """
    if all(lin.valid for lin in linearise_all(layout, state, problem.rows, problem.flat_nodes_mm)):
        return state
    x = state.x.copy()
    for c in range(2):
        k1 = layout.lens(c).start + 3
        x[k1 + 1] = x[k1] ** 2
    return replace(state, x=x)


def restricted(state: State, layout: Layout, other: Layout) -> State:
    """Return a state for a problem with fewer free poses or steps, under the same lens model.

    The system frame moves with the pose that defines it.
    """
    x = np.zeros(other.size)
    x[: other.motion + 5] = state.x[: layout.motion + 5]
    for k, step in enumerate(other.steps):
        index = layout.step(*step)
        x[other.motion + 5 + k] = 0.0 if index is None else state.x[index]
    poses = {k: state.sys_from_target[k] for k in other.frames}
    return State(x, poses, state.nodes_mm.copy())


def rebased(state: State, layout: Layout, frame: int) -> State:
    """Return the state in the system frame that another free pose defines."""
    new_from_old = state.sys_from_target[frame].inverse()
    old_from_new = state.sys_from_target[frame]
    x = state.x.copy()
    for c in range(2):
        pose = camera_of(layout, state.x, c).cam_from_sys @ old_from_new
        x[layout.pose(c)] = pose_numbers(pose)
    poses = {k: new_from_old @ p for k, p in state.sys_from_target.items() if k != frame}
    return State(x, poses, state.nodes_mm)


def pose_numbers(pose: RigidTransform) -> Float:
    """Return alpha, beta, gamma, x0, y0, z0 of a pose, (6,)."""
    return np.array([*angles_from_rotation(pose.rotation), *pose.translation_mm])


def _from_stage(problem: FitData) -> State:
    layout = problem.layout("paper")
    x = np.zeros(layout.size)
    rows = problem.rows
    directions = []
    for c, (name, nominal) in enumerate(zip(CAMERAS, problem.nominals, strict=True)):
        own = [v for v in problem.staged if v.camera == name]
        own_rows = [r for r in rows if r.camera == c and r.dz_mm is not None]
        reference = min(own, key=lambda v: abs(v.position_mm))
        gamma = float(np.radians(nominal.placed()[1]))
        # a plane seen from the other side of its normal is nearly as good a start; trying both reveals exchanged or
        # mirrored cameras
        starts = [start_pose(reference, problem.nodes_mm, nominal, g) for g in (gamma, -gamma)]
        found, direction = fit_single(
            layout, c, own_rows, problem.flat_nodes_mm, nominal, starts, centre_sigma_px=problem.options.centre_sigma_px
        )
        x[layout.lens(c)], x[layout.pose(c)] = found[:5], found[5:]
        directions.append(direction)
    x[layout.direction] = np.mean(directions, axis=0)
    return State(x, {}, np.zeros_like(problem.flat_nodes_mm))


def _with_poses(problem: FitData, state: State) -> State:
    """Add the free poses by the cameras that the stage's views gave."""
    layout = problem.layout("paper")
    poses: dict[int, RigidTransform] = {}
    for view in problem.views:
        if view.frame is None or view.frame in poses:
            continue
        camera = camera_of(layout, state.x, CAMERAS.index(view.camera))
        pose = pose_of(view, problem.nodes_mm, camera.lens)
        if pose is not None:
            poses[view.frame] = camera.sys_from_cam @ pose
    return State(state.x, poses, state.nodes_mm)


def _from_free(problem: FitData) -> tuple[FitData, State, tuple[int, ...]]:
    nodes = problem.nodes_mm
    symmetric = bool(np.allclose(nodes[::-1, ::-1], -nodes, atol=1e-9))
    open_aspect = problem.options.aspect_sigma is None
    start = start_free(problem.views, nodes, problem.nominals, symmetric=symmetric, open_aspect=open_aspect)
    views = tuple(
        replace(v, xy_px=v.xy_px[::-1, ::-1], sigma_px=_turned(v.sigma_px))
        if v.camera == "cam2" and v.frame in start.half_turned
        else v
        for v in problem.views
        if v.frame in start.cam1_from_target
    )
    first = min(k for k in start.cam1_from_target if k not in start.odd)
    turned = replace(problem, views=views, system_frame=first)
    layout = turned.layout("paper")
    x = np.zeros(layout.size)
    cam1 = start.cam1_from_target[first]
    for c, pose in enumerate((cam1, start.cam2_from_cam1 @ cam1)):
        nominal = problem.nominals[c]
        focal, k1 = float(start.focal_px[c]), float(start.k1[c])
        values = _PAPER.start(focal, nominal.centre_px, float(start.aspect[c]))
        values[3] = -k1 / focal**2
        x[layout.lens(c)], x[layout.pose(c)] = values, pose_numbers(pose)
    sys_from_cam1 = cam1.inverse()
    poses = {k: sys_from_cam1 @ start.cam1_from_target[k] for k in layout.frames}
    return turned, State(x, poses, np.zeros_like(problem.flat_nodes_mm)), start.odd


def _turned(sigma_px: float | Float | None) -> float | Float | None:
    return sigma_px if sigma_px is None or np.ndim(sigma_px) == 0 else np.asarray(sigma_px)[::-1, ::-1]


# Start values from nominal lens data; only alpha and the target's position are taken from the image.


def affine_of_view(view: CalibrationView, nodes_mm: Float, aspect: float) -> tuple[Float, Float]:
    """Fit ``image = A (X, Y) + b`` with the rows scaled back by the aspect ratio.

    Returns
    -------
    A, b
        (2, 2) in px/mm, and (2,) in px (rows still divided by the aspect ratio).
    """
    found = view.found
    xy = view.xy_px[found] / [1.0, aspect]
    design = np.column_stack([nodes_mm[found], np.ones(int(found.sum()))])
    solution = np.asarray(np.linalg.lstsq(design, xy, rcond=None)[0], dtype=np.float64)
    return solution[:2].T, solution[2]


def start_pose(view: CalibrationView, nodes_mm: Float, nominal: NominalValues, gamma_rad: float) -> Float:
    """Return the pose (6,) to start from: alpha, beta, gamma, x0, y0, z0.

    With beta = 0 the rows of Eq. (1) give, for any gamma, the rows' direction of the image of X_sys as sin(alpha) and
    that of Y_sys as cos(alpha).
    """
    A, b = affine_of_view(view, nodes_mm, nominal.aspect)
    alpha = float(np.arctan2(A[1, 0], A[1, 1]))
    cx, cy = nominal.centre_px
    standoff, _ = nominal.placed()
    depth = standoff + view.position_mm
    x0 = (b[0] - cx) * depth / nominal.phd_px
    y0 = (b[1] - cy / nominal.aspect) * depth / nominal.phd_px
    return np.array([alpha, 0.0, gamma_rad, x0, y0, standoff])
