"""One camera's views as arrays: predicted image positions, residuals and derivatives, Eqs. (9) to (11)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.arrays import Bool, Float
from core.calibration.inputs import CalibrationView
from core.cameras.camera import TEN_PARAMETER_NAMES, Camera, RigidTransform

N_CAMERA = 12  # ten parameters and the tilt of the stage axis in x and y
TILT_NAMES = ("axis_tilt_x_rad", "axis_tilt_y_rad")


@dataclass(frozen=True)
class Observations:
    """All fitted views of one camera.

    Attributes
    ----------
    dz_mm
        (v,).
    xy_px
        (v, n, 2), NaN where not found.
    found
        (v, n).
    weight
        (v, n), mean 1 over the points found; 0 where not found.
    correlation
        Observed coordinates per independent one.
    """

    dz_mm: Float
    xy_px: Float
    found: Bool
    weight: Float
    correlation: float = 1.0

    @property
    def count(self) -> int:
        """Number of observed coordinates."""
        return 2 * int(self.found.sum())


def collect(views: Sequence[CalibrationView]) -> Observations:
    """Stack one camera's views."""
    xy = np.stack([v.xy_px.reshape(-1, 2) for v in views])
    found = np.asarray(np.isfinite(xy).all(axis=-1))
    if all(v.sigma_px is not None for v in views):
        sigma = np.stack([np.broadcast_to(np.asarray(v.sigma_px), v.xy_px.shape[:2]).ravel() for v in views])
        sigma = np.where(np.isfinite(sigma) & found, sigma, np.inf)
        # a localiser that claims much less noise at some nodes would otherwise decide the fit there
        sigma = np.maximum(sigma, 0.5 * np.median(sigma[found]))
        weight = 1.0 / sigma**2
    else:
        weight = found.astype(np.float64)
    return Observations(
        np.array([v.dz_mm for v in views]),
        np.where(found[..., None], xy, np.nan),
        found,
        weight / weight[found].mean(),
        float(np.mean([v.correlation for v in views])),
    )


def camera_of(parameters: Float, aspect: float) -> Camera:
    """Build the camera from its (10,) or (12,) parameters."""
    values = {name: float(v) for name, v in zip(TEN_PARAMETER_NAMES, parameters[:10], strict=True)}
    return Camera.from_paper(**values, aspect=aspect)


def camera_at(parameters: Float, aspect: float, dz_mm: float) -> Camera:
    """Return the camera after its travel ``dz_mm`` along the (possibly tilted) stage axis."""
    camera = camera_of(parameters, aspect)
    tilt = parameters[10:12] if parameters.size > 10 else np.zeros(2)
    shift = dz_mm * np.array([tilt[0], tilt[1], 1.0])
    pose = camera.cam_from_sys
    return Camera(camera.lens, RigidTransform(pose.rotation, pose.translation_mm + shift))


@dataclass(frozen=True)
class Linearised:
    """Residuals (measured - predicted) and derivatives of the prediction; zero where not found.

    Attributes
    ----------
    residual_px
        (v, n, 2).
    by_camera
        (v, n, 2, 12).
    by_node
        (v, n, 2, 2), px/mm.
    valid
        True if every observed point has an image under these parameters.
    """

    residual_px: Float
    by_camera: Float
    by_node: Float
    valid: bool


def linearise(parameters: Float, aspect: float, nodes_mm: Float, obs: Observations) -> Linearised:
    """Evaluate one camera's views at ``nodes_mm`` (n, 2)."""
    points = np.column_stack([nodes_mm, np.zeros(len(nodes_mm))])
    v, n = obs.found.shape
    residual = np.zeros((v, n, 2))
    by_camera = np.zeros((v, n, 2, N_CAMERA))
    by_node = np.zeros((v, n, 2, 2))
    valid = True
    for k, dz in enumerate(obs.dz_mm):
        camera = camera_at(parameters, aspect, float(dz))
        image = camera.project(points)
        valid = valid and bool(image.valid[obs.found[k]].all())
        use = obs.found[k] & image.valid
        residual[k, use] = obs.xy_px[k, use] - image.xy[use]
        ten = camera.ten_parameter_jacobian(points[use])
        by_camera[k, use, :, :10] = ten
        by_camera[k, use, :, 10:] = dz * ten[..., 7:9]  # a tilt moves x0 and y0 in proportion to the travel
        by_node[k, use] = camera.point_jacobian(points[use])[..., :2]
    return Linearised(residual, by_camera, by_node, valid)


def predicted_residual(parameters: Float, aspect: float, nodes_mm: Float, view: CalibrationView) -> Float:
    """Measured minus projected, (n_a, n_b, 2) px, NaN where not found; ``nodes_mm`` is (n_a, n_b, 2)."""
    points = np.concatenate([nodes_mm, np.zeros((*nodes_mm.shape[:2], 1))], axis=-1)
    return np.asarray(view.xy_px - camera_at(parameters, aspect, view.dz_mm).project(points).xy)
