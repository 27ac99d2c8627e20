"""One view's predicted image positions, residuals and derivatives, Eqs. (3) to (11), for any lens and motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.calibration.fit.layout import (
    Layout,
    State,
    camera_of,
    direction,
    direction_jacobian,
    shift_cam_mm,
    travel_mm,
)
from stereorig.core.calibration.fit.observations import ViewRows
from stereorig.core.cameras.camera import normalised_jacobian, rotation_derivatives


@dataclass(frozen=True)
class Linearised:
    """Residuals (measured - predicted) and derivatives of the prediction; zero where not found.

    Attributes
    ----------
    residual_px
        (n, 2).
    by_unknown
        (n, 2, p).
    columns
        (p,) places of these unknowns in the vector.
    by_node
        (n, 2, 3), px/mm.
    normalised
        (n, 2) predicted points at depth 1 in the camera's frame.
    valid
        True if every observed point has an image.
    """

    residual_px: Float
    by_unknown: Float
    columns: NDArray[np.intp]
    by_node: Float
    normalised: Float
    valid: bool


def linearise_all(layout: Layout, state: State, views: Sequence[ViewRows], nominal_nodes_mm: Float) -> list[Linearised]:
    """Evaluate views at the nominal nodes (n, 3) and the state's corrections of them, all views of a camera at once."""
    out: list[Linearised | None] = [None] * len(views)
    for c in range(2):
        own = [k for k, view in enumerate(views) if view.camera == c]
        if own:
            for k, lin in zip(
                own, _of_camera(layout, state, c, [views[k] for k in own], nominal_nodes_mm), strict=True
            ):
                out[k] = lin
    return [lin for lin in out if lin is not None]


def _of_camera(
    layout: Layout, state: State, c: int, views: Sequence[ViewRows], nominal_nodes_mm: Float
) -> list[Linearised]:
    x, form = state.x, layout.form
    camera = camera_of(layout, x, c)
    R, T = camera.cam_from_sys.rotation, camera.cam_from_sys.translation_mm
    scale = 1.0 + float(x[layout.pitch_scale])
    target = nominal_nodes_mm * scale + state.nodes_mm
    single = layout.moves != "cameras"
    poses = [None if view.frame is None else state.sys_from_target.get(view.frame) for view in views]
    body = np.stack([target if pose is None else pose.apply(target) for pose in poses])
    shift_cam = np.zeros((len(views), 1, 3))
    for k, view in enumerate(views):
        if view.dz_mm is not None and single:
            body[k] += travel_mm(layout, x, c, view.dz_mm) * direction(x[layout.direction])
        elif view.dz_mm is not None:
            shift_cam[k, 0] = shift_cam_mm(layout, x, c, view.dz_mm, R)
    p = body @ R.T + T + shift_cam
    in_front = p[..., 2] > 0.0
    p = np.where(in_front[..., None], p, np.nan)
    n = p[..., :2] / p[..., 2:]
    image = camera.lens.image_from_normalised(n)
    found = np.stack([view.found for view in views])
    use = found & in_front & image.valid
    safe = np.where(use[..., None], n, 0.0)
    with np.errstate(invalid="ignore"):
        to_cam = camera.lens.image_jacobian(safe) @ normalised_jacobian(np.where(use[..., None], p, [0.0, 0.0, 1.0]))
    to_cam = np.where(use[..., None, None], to_cam, 0.0)
    by_lens = np.where(use[..., None, None], form.jacobian(camera.lens, x[layout.lens(c)], safe), 0.0)
    turned = np.stack([body @ dR.T for dR in rotation_derivatives(*x[layout.pose(c)][:3])], axis=-1)
    by_pose = np.concatenate([to_cam @ turned, to_cam], axis=-1)
    to_sys = to_cam @ R
    residual = np.where(use[..., None], np.stack([view.xy_px for view in views]) - image.xy, 0.0)
    out = []
    for k, (view, pose) in enumerate(zip(views, poses, strict=True)):
        to_target = to_sys[k] if pose is None else to_sys[k] @ pose.rotation
        blocks = [(by_lens[k], layout.lens(c)), (by_pose[k], layout.pose(c))]
        if view.dz_mm is not None:
            blocks += _by_stage(layout, x, c, view.dz_mm, to_cam[k], R)
        frame = None if view.frame is None else layout.frame(view.frame)
        if frame is not None and pose is not None:
            blocks.append((_by_frame(to_sys[k], target @ pose.rotation.T), frame))
        by_scale = (to_target @ nominal_nodes_mm[:, :, None])[..., 0]
        blocks.append((by_scale[..., None], slice(layout.pitch_scale, layout.pitch_scale + 1)))
        out.append(
            Linearised(
                residual[k],
                np.concatenate([b for b, _ in blocks], axis=-1),
                np.concatenate([np.arange(s.start, s.stop) for _, s in blocks]),
                to_target,
                safe[k],
                bool((use[k] | ~found[k]).all()),
            )
        )
    return out


def _by_stage(layout: Layout, x: Float, c: int, dz_mm: float, to_cam: Float, R: Float) -> list[tuple[Float, slice]]:
    """Derivatives over the stage's direction or tilt, its scale, and the error of this position."""
    single = layout.moves != "cameras"
    axis, travel = layout.axis_of(c), travel_mm(layout, x, c, dz_mm)
    span = layout.direction if single else layout.tilt(c)
    frame_of = R if single else np.eye(3)
    along = to_cam @ (frame_of @ direction(x[span]))
    index = layout.stage_scale(axis)
    blocks = [
        (travel * to_cam @ (frame_of @ direction_jacobian(x[span])), span),
        (dz_mm * along[..., None], slice(index, index + 1)),
    ]
    step = layout.step(axis, dz_mm)
    if step is not None:
        blocks.append((along[..., None], slice(step, step + 1)))
    return blocks


def _by_frame(to_sys: Float, arm_mm: Float) -> Float:
    """Derivatives (n, 2, 6) over a small turn on the left and a shift of a free pose; ``arm_mm`` are turned points."""
    cross = np.zeros((len(arm_mm), 3, 3))  # d(omega x arm)/d(omega)
    cross[:, 0, 1], cross[:, 0, 2] = arm_mm[:, 2], -arm_mm[:, 1]
    cross[:, 1, 0], cross[:, 1, 2] = -arm_mm[:, 2], arm_mm[:, 0]
    cross[:, 2, 0], cross[:, 2, 1] = arm_mm[:, 1], -arm_mm[:, 0]
    return np.concatenate([to_sys @ cross, to_sys], axis=-1)
