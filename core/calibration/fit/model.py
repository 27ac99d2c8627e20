"""One view's predicted image positions, residuals and derivatives, Eqs. (3) to (11), for any lens and motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.arrays import Float
from core.calibration.fit.layout import Layout, State, camera_of, shift_cam_mm, travel_mm
from core.calibration.fit.observations import ViewRows
from core.calibration.fit.unit_vector import direction, direction_jacobian
from core.cameras.camera import normalised_jacobian, rotation_derivatives


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


def linearise(layout: Layout, state: State, view: ViewRows, nominal_nodes_mm: Float) -> Linearised:
    """Evaluate one view at the nominal nodes (n, 3) and the state's corrections of them."""
    x, c, form = state.x, view.camera, layout.form
    camera = camera_of(layout, x, c)
    R, T = camera.cam_from_sys.rotation, camera.cam_from_sys.translation_mm
    scale = 1.0 + float(x[layout.pitch_scale])
    target = nominal_nodes_mm * scale + state.nodes_mm
    frame = None if view.frame is None else layout.frame(view.frame)
    pose = None if view.frame is None else state.sys_from_target.get(view.frame)
    body = target if pose is None else pose.apply(target)
    single = layout.moves != "cameras"
    if view.dz_mm is not None and single:
        body = body + travel_mm(layout, x, c, view.dz_mm) * direction(x[layout.direction])
    p = body @ R.T + T
    if view.dz_mm is not None and not single:
        p = p + shift_cam_mm(layout, x, c, view.dz_mm, R)
    in_front = p[:, 2] > 0.0
    p = np.where(in_front[:, None], p, np.nan)
    n = p[:, :2] / p[:, 2:]
    image = camera.lens.image_from_normalised(n)
    use = view.found & in_front & image.valid
    valid = bool((use | ~view.found).all())
    safe = np.where(use[:, None], n, 0.0)
    with np.errstate(invalid="ignore"):
        to_cam = camera.lens.image_jacobian(safe) @ normalised_jacobian(np.where(use[:, None], p, [0.0, 0.0, 1.0]))
    blocks: list[tuple[Float, slice]] = [(form.jacobian(camera.lens, x[layout.lens(c)], safe), layout.lens(c))]
    angles = x[layout.pose(c)][:3]
    turns = np.einsum("nij,ajk,nk->nia", to_cam, rotation_derivatives(*angles), body, optimize=True)
    blocks.append((np.concatenate([turns, to_cam], axis=-1), layout.pose(c)))
    if view.dz_mm is not None:
        axis = layout.axis_of(c)
        travel = travel_mm(layout, x, c, view.dz_mm)
        span = layout.direction if single else layout.tilt(c)
        frame_of = R if single else np.eye(3)
        along = to_cam @ (frame_of @ direction(x[span]))
        blocks.append((travel * to_cam @ (frame_of @ direction_jacobian(x[span])), span))
        index = layout.stage_scale(axis)
        blocks.append((view.dz_mm * along[..., None], slice(index, index + 1)))
        step = layout.step(axis, view.dz_mm)
        if step is not None:
            blocks.append((along[..., None], slice(step, step + 1)))
    to_sys = to_cam @ R
    to_target = to_sys if pose is None else to_sys @ pose.rotation
    if frame is not None and pose is not None:
        arm = target @ pose.rotation.T
        cross = np.zeros((len(arm), 3, 3))  # d(omega x arm)/d(omega)
        cross[:, 0, 1], cross[:, 0, 2] = arm[:, 2], -arm[:, 1]
        cross[:, 1, 0], cross[:, 1, 2] = -arm[:, 2], arm[:, 0]
        cross[:, 2, 0], cross[:, 2, 1] = arm[:, 1], -arm[:, 0]
        blocks.append((np.concatenate([to_sys @ cross, to_sys], axis=-1), frame))
    blocks.append(
        (
            np.einsum("nij,nj->ni", to_target, nominal_nodes_mm)[..., None],
            slice(layout.pitch_scale, layout.pitch_scale + 1),
        )
    )
    columns = np.concatenate([np.arange(s.start, s.stop) for _, s in blocks])
    A = np.concatenate([b for b, _ in blocks], axis=-1)
    A[~use] = 0.0
    to_target = np.where(use[:, None, None], to_target, 0.0)
    residual = np.where(use[:, None], view.xy_px - image.xy, 0.0)
    return Linearised(residual, A, columns, to_target, safe, valid)
