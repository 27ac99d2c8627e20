"""The cameras and poses as the views taken so far have them: adjusted, or nominal while there are too few."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.lens import fit_lens, richer_lenses
from stereorig.core.calibration.choice.screening import DroppedView, Screened, fit_screened
from stereorig.core.calibration.fit.adjust import NOISE_ROUNDS
from stereorig.core.calibration.fit.free_start import MIN_POSES, pose_of
from stereorig.core.calibration.fit.layout import Layout, Priors, State, camera_of
from stereorig.core.calibration.fit.lens_form import LensName
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.calibration.fit.problem import FitData, converted, pose_numbers, started
from stereorig.core.calibration.inputs import AnyTarget, CalibrationOptions, CalibrationView, NominalValues, extent_mm
from stereorig.core.calibration.prepare import problem_of
from stereorig.core.cameras.camera import RigidTransform, rotation_from_angles
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationError, CalibrationInputError
from stereorig.core.names import CAMERAS

_PHD_SIGMA = 0.3  # share of a nominal pinhole distance, "good to a few tens of percent"
_FILLS = 0.5  # share of the image's narrower side that the target fills if its distance is not given
_HALF_ANGLE_DEG = 10.0  # between each camera and the target's normal if it is not given
_NOISE_PX = 0.05  # noise of a board's corner, before any residual is known
_LEAST_FOR_LENS, _LENS_EVERY = 5, 2  # poses before further lens terms are asked for, and until they are again
_HALF_TURN = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Cameras and poses of the target by the views so far.

    Attributes
    ----------
    problem, layout, state, priors
        The views, the unknowns, their values and their priors.
    rows
        Observations of ``problem.views``.
    noise_px
        (2,) standard deviation of a coordinate; a board's usual one before there are residuals.
    adjusted
        False if too few views determine the cameras, and the lenses are the nominal ones.
    cam1_from_target
        The target's pose in camera 1's frame in each free pose that has one, by its number.
    half_turned
        Numbers of the poses in which camera 2 counts a symmetric target from its other end.
    dropped
        Views that do not fit the others, with the reason.
    reason
        Reason for a missing adjustment; empty if there is one.
    """

    problem: FitData
    layout: Layout
    state: State
    priors: Priors
    rows: tuple[ViewRows, ...]
    noise_px: Float
    adjusted: bool
    cam1_from_target: dict[int, RigidTransform]
    half_turned: frozenset[int]
    dropped: tuple[DroppedView, ...] = ()
    reason: str = ""

    @property
    def pair(self) -> StereoPair:
        """The cameras, in the frame of the first pose."""
        return StereoPair(*(camera_of(self.layout, self.state.x, c) for c in range(2)))

    @property
    def sys_from_target(self) -> dict[int, RigidTransform]:
        """The target's pose in the system frame; the first pose is the identity."""
        poses = dict(self.state.sys_from_target)
        if self.problem.system_frame is not None:
            poses[self.problem.system_frame] = RigidTransform.identity()
        return poses


def estimate(
    views: Sequence[CalibrationView],
    target: AnyTarget,
    nominals: tuple[NominalValues, NominalValues],
    options: CalibrationOptions,
    previous: Estimate | None = None,
) -> Estimate:
    """Estimate cameras and poses from free poses of the target, any number of them.

    Parameters
    ----------
    views
        Views of both cameras, of free poses only.
    target, nominals, options
        See :func:`stereorig.core.calibration.calibrate`; ``lens = "auto"`` begins with the paper's lens and takes
        further terms once the residuals ask for them.
    previous
        The estimate with fewer views; a start that spares the search.

    Raises
    ------
    ValueError
        For views at stage positions.
    """
    if any(v.frame is None for v in views):
        raise ValueError("a guided acquisition has free poses only")
    options = replace(options, held_out_frames=(), held_out_mm=())
    per_camera = [sorted((v for v in views if v.camera == name), key=lambda v: v.frame or 0) for name in CAMERAS]
    problem = problem_of(per_camera, target, nominals, options)
    both = {v.frame for v in per_camera[0]} & {v.frame for v in per_camera[1]}
    reason = f"{len(both)} of at least {MIN_POSES} poses are taken."
    if len(both) >= MIN_POSES:
        try:
            return _adjusted(problem, previous)
        except (CalibrationError, CalibrationInputError, np.linalg.LinAlgError) as error:
            reason = getattr(error, "cause", str(error))
        if previous is not None and previous.adjusted:
            try:  # the start from one more pose may be the bad one
                return _adjusted(problem, None)
            except (CalibrationError, CalibrationInputError, np.linalg.LinAlgError) as error:
                reason = getattr(error, "cause", str(error))
    return _nominal(problem, target, reason)


# an adjustment ---------------------------------------------------------------------------------------------------


def _adjusted(problem: FitData, previous: Estimate | None) -> Estimate:
    model: LensName = "paper" if problem.options.lens == "auto" else problem.options.lens
    noise, rounds = None, NOISE_ROUNDS
    if previous is not None and previous.adjusted:
        turned, state, half_turned = _continued(problem, previous)
        odd: tuple[int, ...] = ()
        layout = turned.layout(previous.layout.form.model)
        noise, rounds = previous.noise_px, 1  # one more view changes little
        if problem.options.lens == "auto":
            model = layout.form.model
    else:
        turned, state, odd = started(problem)
        layout = turned.layout("paper")
        half_turned = _turned_frames(problem, turned)
    other = turned.layout(model)
    begin = state if model == layout.form.model else converted(state, layout, other)
    screened = fit_screened(turned, other, begin, odd, noise_px=noise, rounds=rounds)
    frames = len(screened.problem.frames)
    if problem.options.lens == "auto" and frames >= _LEAST_FOR_LENS and (frames - _LEAST_FOR_LENS) % _LENS_EVERY == 0:
        screened = _with_terms(screened)
    adjustment = screened.adjustment
    cam1 = camera_of(adjustment.layout, adjustment.state.x, 0).cam_from_sys
    poses = {k: cam1 @ p for k, p in adjustment.state.sys_from_target.items()}
    if screened.problem.system_frame is not None:
        poses[screened.problem.system_frame] = cam1
    return Estimate(
        problem=screened.problem,
        layout=adjustment.layout,
        state=adjustment.state,
        priors=adjustment.priors,
        rows=screened.rows,
        noise_px=adjustment.noise_px,
        adjusted=True,
        cam1_from_target=poses,
        half_turned=half_turned,
        dropped=screened.dropped,
    )


def _with_terms(screened: Screened) -> Screened:
    """Return the fit with all lens terms that the residuals ask for and the views determine."""
    while models := richer_lenses(screened):
        start, trials = screened.adjustment, []
        for model in models:
            into = screened.problem.layout(model)
            with suppress(CalibrationError):  # these views do not determine it yet
                trials.append(fit_lens(screened.problem, into, converted(start.state, start.layout, into)))
        if not trials:
            break
        best = min(trials, key=lambda t: float(np.sum(t.adjustment.noise_px**2)))
        screened = replace(best, dropped=(*screened.dropped, *best.dropped))
    return screened


def _turned_frames(problem: FitData, turned: FitData) -> frozenset[int]:
    kept = {id(v) for v in problem.views}
    return frozenset(v.frame for v in turned.views if v.frame is not None and id(v) not in kept)


def _continued(problem: FitData, previous: Estimate) -> tuple[FitData, State, frozenset[int]]:
    """Return the problem and a start from an earlier estimate, new poses added by its cameras."""
    pair = previous.pair
    lenses = pair.cam1.lens, pair.cam2.lens
    known, half_turned = dict(previous.sys_from_target), set(previous.half_turned)
    by_frame = _by_frame(problem.views)
    symmetric = _symmetric(problem.nodes_mm)
    for k, own in by_frame.items():
        if k in known:
            continue
        poses = {name: pose_of(v, problem.nodes_mm, lenses[CAMERAS.index(name)]) for name, v in own.items()}
        one, two = poses.get("cam1"), poses.get("cam2")
        if one is not None and two is not None and symmetric:
            relative = pair.cam2_from_cam1
            if _apart(two @ _HALF_TURN, relative @ one) < _apart(two, relative @ one):
                half_turned.add(k)
        if one is not None:
            known[k] = pair.cam1.sys_from_cam @ one
        elif two is not None:
            known[k] = pair.cam2.sys_from_cam @ two
    views = tuple(_half_turned(v) if v.camera == "cam2" and v.frame in half_turned else v for v in problem.views)
    turned = replace(problem, views=views, system_frame=previous.problem.system_frame)
    layout = turned.layout(previous.layout.form.model)
    x = np.zeros(layout.size)
    shared = layout.motion + 5
    x[:shared] = previous.state.x[:shared]
    state = State(x, {k: known[k] for k in layout.frames if k in known}, previous.state.nodes_mm.copy())
    return turned, state, frozenset(half_turned)


# nominal cameras -------------------------------------------------------------------------------------------------


def _nominal(problem: FitData, target: AnyTarget, reason: str) -> Estimate:
    """Return nominal lenses and the cameras' poses from the views' own poses."""
    nodes, nominals = problem.nodes_mm, problem.nominals
    form = FitData((), nodes, nominals, problem.options, "free").layout("paper").form
    lenses = [form.lens(form.start(n.phd_px, n.centre_px, n.aspect)) for n in nominals]
    symmetric = _symmetric(nodes)
    pairs: dict[int, tuple[RigidTransform, RigidTransform]] = {}
    half_turned: set[int] = set()
    for k, own in _by_frame(problem.views).items():
        poses = [
            pose_of(own[name], nodes, lens) if name in own else None for name, lens in zip(CAMERAS, lenses, strict=True)
        ]
        if poses[0] is None or poses[1] is None:
            continue
        one, two = poses[0], poses[1]
        # a symmetric target may be counted in two ways: take the one with the smaller angle between the cameras
        if symmetric and _angle(two @ _HALF_TURN @ one.inverse()) < _angle(two @ one.inverse()):
            half_turned.add(k)
            two = two @ _HALF_TURN
        pairs[k] = one, two
    views = tuple(
        _half_turned(v) if v.camera == "cam2" and v.frame in half_turned else v
        for v in problem.views
        if v.frame in pairs
    )
    first = min(pairs) if pairs else None
    reduced = replace(problem, views=views, system_frame=first)
    layout = reduced.layout("paper")
    x = np.zeros(layout.size)
    if first is None:
        starts = [_placed(n, sign, target) for n, sign in zip(nominals, (-1.0, 1.0), strict=True)]
    else:
        cam1 = pairs[first][0]
        starts = [cam1, _mean([two @ one.inverse() for one, two in pairs.values()]) @ cam1]
    for c, (pose, nominal) in enumerate(zip(starts, nominals, strict=True)):
        x[layout.lens(c)] = layout.form.start(nominal.phd_px, nominal.centre_px, nominal.aspect)
        x[layout.pose(c)] = pose_numbers(pose)
    cam1_from_target = {k: one for k, (one, _) in pairs.items()}
    state = State(
        x, {k: starts[0].inverse() @ cam1_from_target[k] for k in layout.frames}, np.zeros_like(reduced.flat_nodes_mm)
    )
    return Estimate(
        problem=reduced,
        layout=layout,
        state=state,
        priors=_with_focal_prior(reduced.priors(layout), layout, nominals),
        rows=tuple(reduced.rows),
        noise_px=np.full(2, _NOISE_PX),
        adjusted=False,
        cam1_from_target=cam1_from_target,
        half_turned=frozenset(half_turned),
        reason=reason,
    )


def _placed(nominal: NominalValues, sign: float, target: AnyTarget) -> RigidTransform:
    """Pose of a camera towards a target that faces it where the specimen will be."""
    depth = nominal.standoff_mm or nominal.phd_px * extent_mm(target) / (_FILLS * min(nominal.image_size_px))
    angle = sign * _HALF_ANGLE_DEG if nominal.angle_deg is None else nominal.angle_deg
    return RigidTransform(rotation_from_angles(0.0, 0.0, np.radians(angle)), np.array([0.0, 0.0, depth]))


def _with_focal_prior(known: Priors, layout: Layout, nominals: Sequence[NominalValues]) -> Priors:
    """Without an adjustment the pinhole distance is known as well as its nominal value."""
    weight, mean = known.weight.copy(), known.mean.copy()
    for c, nominal in enumerate(nominals):
        index = layout.lens(c).start
        weight[index], mean[index] = (_PHD_SIGMA * nominal.phd_px) ** -2, nominal.phd_px
    return replace(known, weight=weight, mean=mean)


# parts -----------------------------------------------------------------------------------------------------------


def _by_frame(views: Sequence[CalibrationView]) -> dict[int, Mapping[str, CalibrationView]]:
    out: dict[int, dict[str, CalibrationView]] = {}
    for view in views:
        if view.frame is not None:
            out.setdefault(view.frame, {})[view.camera] = view
    return {k: out[k] for k in sorted(out)}


def _symmetric(nodes_mm: Float) -> bool:
    return bool(np.allclose(nodes_mm[::-1, ::-1], -nodes_mm, atol=1e-9))


def _half_turned(view: CalibrationView) -> CalibrationView:
    sigma = view.sigma_px
    turned = sigma if sigma is None or np.ndim(sigma) == 0 else np.asarray(sigma)[::-1, ::-1]
    return replace(view, xy_px=view.xy_px[::-1, ::-1], sigma_px=turned)


def _angle(transform: RigidTransform) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(transform.rotation) - 1.0), -1.0, 1.0)))


def _apart(a: RigidTransform, b: RigidTransform) -> float:
    return _angle(RigidTransform(a.rotation.T @ b.rotation, np.zeros(3)))


def _mean(transforms: Sequence[RigidTransform]) -> RigidTransform:
    u, _, vt = np.linalg.svd(np.mean([t.rotation for t in transforms], axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return RigidTransform(rotation, np.median([t.translation_mm for t in transforms], axis=0))
