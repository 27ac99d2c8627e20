"""Views that the fit did not use: stage positions without any fit, free poses with their pose fitted alone.

If the user names no such views, some are left out in turn: a fifth of the free poses at a time, or each stage position
except the first and the last, which keep the travel whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.choice.screening import Screened, points_mm
from stereorig.core.calibration.fit.adjust import Adjustment, adjust
from stereorig.core.calibration.fit.dots import dot_offsets_px
from stereorig.core.calibration.fit.free_start import pose_of
from stereorig.core.calibration.fit.layout import Layout, State, camera_of, camera_seeing, turned
from stereorig.core.calibration.fit.problem import FitData, rebased, restricted
from stereorig.core.calibration.inputs import CalibrationView
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS

_FOLDS = 5
MIN_FRAMES = 6  # with fewer, leaving some out leaves too little
_POSE_STEPS = 15


@dataclass(frozen=True)
class HeldOutView:
    """A view under cameras that were fitted without it.

    Attributes
    ----------
    view
        The view.
    camera
        The camera with its pose towards the target, ``cam_from_target``.
    xy_px
        (n, 2) its positions, dots' centres corrected; NaN where not found.
    """

    view: CalibrationView
    camera: Camera
    xy_px: Float


def held_out_view(view: CalibrationView, camera: Camera, points: Float) -> HeldOutView:
    """Return a view under a camera with its pose towards the target; ``points`` (n, 3) are the target's."""
    xy = view.xy_px.reshape(-1, 2)
    if view.dot_radius_mm:
        xy = xy - dot_offsets_px(camera, points, view.dot_radius_mm)
    return HeldOutView(view, camera, xy)


def fit_target_pose(
    cameras: Sequence[Camera], points_mm: Float, images_px: Sequence[Float | None], start: RigidTransform
) -> RigidTransform:
    """Fit the pose ``sys_from_target`` of one free view to the cameras that see it.

    Parameters
    ----------
    cameras
        Both cameras, in the system frame.
    points_mm
        (n, 3) points of the target.
    images_px
        (n, 2) image of each camera, NaN for points not found; None for a camera without a view.
    start
        Pose to start from.
    """
    from scipy.optimize import least_squares  # slow to load, and not every start needs it

    seen = [np.isfinite(xy).all(axis=1) if xy is not None else None for xy in images_px]

    def pose(p: Float) -> RigidTransform:
        return RigidTransform(turned(p[:3]) @ start.rotation, start.translation_mm + p[3:])

    def residuals(p: Float) -> Float:
        body = pose(p).apply(points_mm)
        parts = []
        for camera, xy, found in zip(cameras, images_px, seen, strict=True):
            if xy is not None and found is not None:
                parts.append(np.nan_to_num(xy[found] - camera.project(body[found]).xy, nan=1e4).ravel())
        return np.concatenate(parts)

    scale = np.array([1e-3] * 3 + [1e-3 * float(np.abs(points_mm).max())] * 3)
    return pose(least_squares(residuals, np.zeros(6), x_scale=scale, method="lm", max_nfev=_POSE_STEPS * 7).x)


def leave_out_in_turn(screened: Screened) -> list[HeldOutView]:
    """Fit without a fifth of the free poses, or without one stage position, at a time; return the views left out.

    Each has its residuals under the cameras fitted without it. Empty if there are too few.
    """
    problem, adjustment = screened.problem, screened.adjustment
    frames = [k for k in problem.frames if k != problem.system_frame or not problem.staged]
    if len(frames) >= MIN_FRAMES:
        chosen = [set(frames[i::_FOLDS]) for i in range(_FOLDS)]
        folds = [[v for v in problem.views if v.frame in fold] for fold in chosen]
    else:
        folds = _positions_between(problem)
    out: list[HeldOutView] = []
    for held in folds:
        try:
            out.extend(_fold(screened, problem, adjustment, held))
        except StereorigError:
            continue  # without these the others do not determine the cameras; that shows in the uncertainty
    return out


def _positions_between(problem: FitData) -> list[list[CalibrationView]]:
    """Return both cameras' views of each stage position but the first and the last, counted from the first."""
    own = [sorted((v for v in problem.staged if v.camera == n), key=lambda v: v.position_mm) for n in CAMERAS]
    between = [views[1:-1] for views in own]
    return [[views[k] for views in between if k < len(views)] for k in range(max(map(len, between), default=0))]


def _fold(
    screened: Screened, problem: FitData, adjustment: Adjustment, held: Sequence[CalibrationView]
) -> list[HeldOutView]:
    layout, state = adjustment.layout, adjustment.state
    kept = [k for k, v in enumerate(problem.views) if not any(v is other for other in held)]
    left = problem.without(held)
    if left.system_frame != problem.system_frame and left.system_frame is not None:
        old_from_new = state.sys_from_target[left.system_frame]
        state = rebased(state, layout, left.system_frame)
        assert problem.system_frame is not None  # a frame takes over from another
        state.sys_from_target[problem.system_frame] = old_from_new.inverse()
    other = left.layout(layout.form.model)
    fitted = adjust(
        other,
        restricted(state, layout, other),
        [screened.rows[k] for k in kept],
        left.flat_nodes_mm,
        left.priors(other),
        max_iterations=problem.options.max_iterations,
        noise_px=adjustment.noise_px,
        rounds=1,
    )
    if held[0].frame is None:
        known = staged_views(problem, other, fitted.state, held)
    else:
        known = held_out_views(problem, other, fitted.state, held, state)
    rows = dict(zip(map(id, problem.views), screened.rows, strict=True))
    # points that the fit left out are no check
    return [replace(h, xy_px=np.where(rows[id(h.view)].found[:, None], h.xy_px, np.nan)) for h in known]


def staged_views(problem: FitData, layout: Layout, fitted: State, held: Sequence[CalibrationView]) -> list[HeldOutView]:
    """Return residuals of views at stage positions under fitted cameras; arguments as of :func:`held_out_views`."""
    points = points_mm(problem, layout, fitted)
    return [
        held_out_view(v, camera_seeing(layout, fitted, CAMERAS.index(v.camera), v.dz_mm, None), points)
        for v in held
        if v.dz_mm is not None
    ]


def held_out_views(
    problem: FitData, layout: Layout, fitted: State, held: Sequence[CalibrationView], start: State | None = None
) -> list[HeldOutView]:
    """Return free views under fitted cameras, each target's pose fitted to its own two images.

    Parameters
    ----------
    problem, layout, fitted
        The fit without them.
    held
        The views.
    start
        State that knows their poses in the same system frame; else the pose comes from one camera.
    """
    cameras = [camera_of(layout, fitted.x, c) for c in range(2)]
    points = points_mm(problem, layout, fitted)
    out: list[HeldOutView] = []
    for frame in sorted({v.frame for v in held if v.frame is not None}):
        own = [v for v in held if v.frame == frame]
        pose = None if start is None else start.sys_from_target.get(frame, RigidTransform.identity())
        if pose is None:
            c = CAMERAS.index(own[0].camera)
            seen = pose_of(own[0], problem.nodes_mm, cameras[c].lens)
            if seen is None:
                continue
            pose = cameras[c].sys_from_cam @ seen
        images: list[Float | None] = [
            next((v.xy_px.reshape(-1, 2) for v in own if v.camera == name), None) for name in CAMERAS
        ]
        views: list[HeldOutView] = []
        for _ in range(2 if any(v.dot_radius_mm for v in own) else 1):
            pose = fit_target_pose(cameras, points, images, pose)
            seen_by = [Camera(c.lens, c.cam_from_sys @ pose) for c in cameras]
            views = [held_out_view(v, seen_by[CAMERAS.index(v.camera)], points) for v in own]
            images = [next((h.xy_px for h in views if h.view.camera == name), None) for name in CAMERAS]
        out.extend(views)
    return out
