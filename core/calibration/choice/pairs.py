"""Pairs of free poses whose two pictures do not show one pose, found before a pose is shared.

Each camera is fitted to its own pictures alone, with poses of its own. If the cameras did not move and both pictures of
a pair were taken at one instant, the two poses of the target differ by the same motion in every pair, as far as their
covariance allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.checks.measures import focal_lengths_px
from stereorig.core.calibration.choice.held_out import fit_target_pose
from stereorig.core.calibration.choice.screening import DroppedView, Screened, fit_screened, points_mm, view_sizes
from stereorig.core.calibration.fit.free_start import MIN_POSES, pose_of
from stereorig.core.calibration.fit.layout import Layout, State, camera_of, turned
from stereorig.core.calibration.fit.problem import FitData, converted, unfolded
from stereorig.core.calibration.inputs import CalibrationView, NominalValues
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS

_LEAST_PAIRS = 4  # with three, two that agree are no majority of any weight
_MEDIAN = 5.348  # median of chi squared of six numbers
_APART = 38.3  # chi squared of six numbers, reached by chance once in a million
# multiple of the squares that noise explains: above it the cameras' own fits leave structure, and a richer lens is
# tried
_STRUCTURE = 2.0


def apart_pairs(problem: FitData, start: State, odd: Sequence[int], held: Sequence[CalibrationView]) -> tuple[int, ...]:
    """Return the numbers of the free poses in which the two cameras saw different poses.

    Parameters
    ----------
    problem, start
        The views to fit, without a stage, and their start under the paper's lens.
    odd
        Poses that did not fit the cameras' relative pose from the start.
    held
        Views kept for the check, which are examined alike.

    Returns
    -------
    tuple
        ``odd`` if the views do not decide it, or if no majority of the pairs agrees.
    """
    if problem.system_frame is None:
        return tuple(odd)
    views = [*problem.views, *(v for v in held if v.frame is not None)]
    first = max(v.frame for v in views if v.frame is not None) + 1
    seen = [{v.frame for v in views if v.camera == name} for name in CAMERAS]
    second = {k: first + k for k in seen[0] & seen[1] if k is not None}
    if len(second) < _LEAST_PAIRS:
        return tuple(odd)
    # camera 2's poses are numbered on their own
    numbered = [replace(v, frame=second.get(v.frame or 0, v.frame)) if v.camera == "cam2" else v for v in views]
    separate = replace(problem, views=tuple(numbered), system_frame=None, cameras_held=True)
    layout = separate.layout("paper")
    x = np.zeros(layout.size)
    x[: layout.motion] = start.x[: layout.motion]
    begun = _posed(separate, layout, x)
    apart: tuple[int, ...] = tuple(odd)
    while True:
        try:
            fit = fit_screened(separate, layout, begun)
        except (StereorigError, np.linalg.LinAlgError):
            return apart
        found = _disagreeing(fit, second)
        if found is None:
            return apart
        others, squares, known = found
        unknown = {k for k in odd if k not in known}
        apart = tuple(sorted({*others, *unknown}))
        if layout.form.model != "paper" or (squares < _STRUCTURE and not apart):
            return apart
        richer = separate.layout("opencv5")
        state = converted(fit.adjustment.state, fit.adjustment.layout, fit.problem.layout("opencv5"))
        x = np.zeros(richer.size)
        x[: richer.motion] = state.x[: richer.motion]
        layout, begun = richer, unfolded(separate, richer, _posed(separate, richer, x))


def _posed(problem: FitData, layout: Layout, x: Float) -> State:
    """Return a start with each view's own pose, by the lenses and cameras in ``x``."""
    poses = {}
    for view in problem.views:
        camera = camera_of(layout, x, CAMERAS.index(view.camera))
        pose = pose_of(view, problem.nodes_mm, camera.lens)
        if pose is not None and view.frame is not None:
            poses[view.frame] = camera.sys_from_cam @ pose
    return State(x, poses, np.zeros_like(problem.flat_nodes_mm))


def _disagreeing(fit: Screened, second: dict[int, int]) -> tuple[list[int], float, set[int]] | None:
    """Return the pairs that disagree with most others, the others' squares relative to noise, and all pairs known.

    None if no majority agrees.
    """
    adjustment = fit.adjustment
    layout, state = adjustment.layout, adjustment.state
    pairs = [k for k, other in second.items() if {k, other} <= set(layout.frames)]
    if len(pairs) < _LEAST_PAIRS:
        return None
    motions, J = np.zeros((len(pairs), 6)), np.zeros((len(pairs), 6, layout.size))
    for n, k in enumerate(pairs):
        one, two = state.sys_from_target[k], state.sys_from_target[second[k]]
        motion = two @ one.inverse()
        R, arm = motion.rotation, motion.rotation @ one.translation_mm
        motions[n] = [*_rotation_vector(R), *motion.translation_mm]
        # small turns w on the left and shifts t of both poses: w2 - R w1, and t2 - R t1 - (w2 - R w1) x arm
        cross = np.array([[0.0, -arm[2], arm[1]], [arm[2], 0.0, -arm[0]], [-arm[1], arm[0], 0.0]])
        eye, none = np.eye(3), np.zeros((3, 3))
        J[n][:, layout.frame(second[k])] = np.block([[eye, none], [cross, eye]])
        J[n][:, layout.frame(k)] = -np.block([[R, none], [cross @ R, R]])
    flat = J.reshape(-1, layout.size)
    C = (flat @ adjustment.covariance @ flat.T).reshape(len(pairs), 6, len(pairs), 6)
    # a blurred or bent view determines its pose less well than the noise of all views implies
    sizes = dict(zip((row.frame for row in fit.rows), view_sizes(fit.problem, fit.rows, adjustment)[0], strict=True))
    share = np.array([max(sizes[k], sizes[second[k]], np.sqrt(2.0)) for k in pairs]) / np.sqrt(2.0)
    own = np.einsum("kikj->kij", C) * (share**2)[:, None, None]
    squares = np.zeros((len(pairs), len(pairs)))
    for j in range(len(pairs)):
        off = motions - motions[j]
        spread = own + own[j] - C[:, :, j] - np.swapaxes(C[:, :, j], 1, 2)
        spread[j] = np.eye(6)
        squares[j] = np.einsum("ki,ki->k", off, np.linalg.solve(spread, off[..., None])[..., 0])
    # the pair that most others agree with; its own zero does not count
    typical = np.array([np.median(np.delete(row, j)) for j, row in enumerate(squares)])
    best = int(np.argmin(typical))
    scale = float(typical[best]) / _MEDIAN
    limit = _APART * max(scale, 1.0)
    near = squares[best] <= limit
    weight = np.linalg.inv(own[near])
    common = np.linalg.solve(weight.sum(axis=0), np.einsum("kij,kj->i", weight, motions[near]))
    apart = [
        k
        for k, value, size in zip(pairs, squares[best], share, strict=True)
        if value > limit and _common_pose_costs(fit, k, second[k], common) > limit * size**2
    ]
    left = len(pairs) - len(apart)
    return (apart, scale, set(pairs)) if left >= MIN_POSES and left > len(pairs) // 2 else None


def _common_pose_costs(fit: Screened, one: int, two: int, motion: Float) -> float:
    """Return each pair's increase of squares over noise by one pose for both cameras, from either camera's own pose.

    If perspective is weak, two poses explain a plane's picture nearly alike, and the cameras may have taken either.
    """
    adjustment = fit.adjustment
    layout, state = adjustment.layout, adjustment.state
    moved = RigidTransform(turned(motion[:3]), motion[3:])
    first, second = (camera_of(layout, state.x, c) for c in range(2))
    cameras = [first, Camera(second.lens, second.cam_from_sys @ moved)]
    rows = {row.frame: row for row in fit.rows}
    points = points_mm(fit.problem, layout, state)
    images = [rows[one].xy_px, rows[two].xy_px]

    def squares(poses: Sequence[RigidTransform]) -> float:
        total = 0.0
        for camera, xy, pose, noise in zip(cameras, images, poses, adjustment.noise_px, strict=True):
            found = np.isfinite(xy).all(axis=1)
            off = camera.project(pose.apply(points[found])).xy - xy[found]
            total += float(np.sum(np.nan_to_num(off, nan=1e3) ** 2)) / noise**2
        return total

    own = [state.sys_from_target[one], moved.inverse() @ state.sys_from_target[two]]
    joint = [fit_target_pose(cameras, points, images, pose) for pose in own]
    return min(squares([pose, pose]) for pose in joint) - squares(own)


def _rotation_vector(rotation: Float) -> Float:
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


# Images that were exchanged: poses whose views fit crosswise, cameras with each other's pinhole distance.

_ONE_POSE_PX = 0.3  # residual of an RBE view that is still usable
_MOST_POSES = 12  # poses left out that are compared; with more the comparison of all pairs would take long
_OFF = 0.2  # logarithm of found over declared pinhole distance; declared ones are good to some tens of percent
_CROSSED = 0.3  # share of that logarithm, with the other camera's declaration


def name_exchanged(
    dropped: Sequence[DroppedView], views: Sequence[Sequence[CalibrationView]], pair: StereoPair
) -> tuple[DroppedView, ...]:
    """Return the views left out, with the reason of those that two poses of one camera exchanged."""
    names = {view.name for view in dropped}
    one, two = ({v.frame: v for v in own if v.frame is not None and v.label in names} for own in views)
    reasons: dict[str, str] = {}
    for k, m in combinations(sorted(set(one) & set(two))[:_MOST_POSES], 2):
        if _of_one_pose(one[k], two[m], pair) and _of_one_pose(one[m], two[k], pair):
            own = f"{one[k].label} and {one[m].label}, or {two[k].label} and {two[m].label}, are swapped"
            reasons |= {v.label: own for v in (one[k], one[m], two[k], two[m])}
    return tuple(replace(view, reason=reasons.get(view.name, view.reason)) for view in dropped)


def _of_one_pose(one: CalibrationView, two: CalibrationView, pair: StereoPair) -> bool:
    both = one.found & two.found
    if not both.any():
        return False
    xy = one.xy_px[both], two.xy_px[both]
    space = pair.triangulate(*xy).xyz_mm
    off = [camera.project(space).xy - seen for camera, seen in zip((pair.cam1, pair.cam2), xy, strict=True)]
    return bool(np.sqrt(np.mean(np.square(off))) < _ONE_POSE_PX)


def remark_on_distances(pair: StereoPair, nominals: Sequence[NominalValues]) -> list[str]:
    """Remark on pinhole distances that are far from the declared ones, and on those that fit the other camera's."""
    found = np.array([focal_lengths_px(camera.lens)[0] for camera in (pair.cam1, pair.cam2)])
    declared = np.array([nominal.phd_px for nominal in nominals])
    off, crossed = np.abs(np.log(found / declared)), np.abs(np.log(found / declared[::-1]))
    if not off.max() > _OFF:
        return []
    if crossed.max() < _CROSSED * off.max():
        return [
            f"The pinhole distances found, {found[0]:.0f} and {found[1]:.0f} px, are those declared of the other one:"
            " the names of the cameras' images seem exchanged."
        ]
    return [
        f"The pinhole distance of {name} is {f:.0f} px, {100.0 * abs(f / d - 1.0):.0f} % off the declared {d:g} px: "
        "check the declaration, and which camera took which images."
        for name, f, d, o in zip(CAMERAS, found, declared, off, strict=True)
        if o > _OFF
    ]
