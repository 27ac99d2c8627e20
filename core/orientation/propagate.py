"""Covariance of a repaired pair's parameters: the estimate's own, and the part inherited from the calibration.

Errors of the lenses and of camera 1 change the orientation that the offsets ask for, and the baseline's length is the
old poses'. So the new pose of camera 2 is a function of all old parameters, and of the estimate's own error.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform, angles_from_rotation
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.orientation.change import changed
from stereorig.core.orientation.repair import RepairedPair

_STEP_RAD = 1e-6


def pose_parameters(pair: StereoPair) -> Float:
    """Return camera 2's pose (6,), :data:`stereorig.core.cameras.camera.POSE_NAMES`."""
    pose = pair.cam2.cam_from_sys
    return np.concatenate([angles_from_rotation(pose.rotation), pose.translation_mm])


def repaired_covariance(
    repair: RepairedPair,
    covariance: Float,
    stepped: Sequence[tuple[StereoPair, StereoPair]],
    steps: Float,
    pose_index: Sequence[int],
) -> Float:
    """Return the covariance (k, k) of the parameters after a repair.

    Parameters
    ----------
    repair
        The repair.
    covariance
        (k, k) of the old calibration's parameters.
    stepped
        For each parameter the old pair with a larger and a smaller value of it.
    steps
        (k,) half the difference of the two values.
    pose_index
        Which parameters are camera 2's pose, in the order of :data:`stereorig.core.cameras.camera.POSE_NAMES`.
    """
    whole, pose = carried_parameters(repair, stepped, steps, pose_index), list(pose_index)
    out = whole @ covariance @ whole.T
    own = np.stack(
        [
            (pose_parameters(changed(repair.pair, step)) - pose_parameters(changed(repair.pair, -step)))
            / (2.0 * _STEP_RAD)
            for step in np.eye(5) * _STEP_RAD
        ],
        axis=1,
    )
    out[np.ix_(pose, pose)] += own @ repair.estimate.covariance @ own.T
    length = (_with_length(repair.pair, 1.0 + _STEP_RAD) - _with_length(repair.pair, 1.0 - _STEP_RAD)) / (
        2.0 * _STEP_RAD
    )
    out[np.ix_(pose, pose)] += repair.length_sigma**2 * np.outer(length, length)
    return np.asarray(0.5 * (out + out.T))


def carried_parameters(
    repair: RepairedPair, stepped: Sequence[tuple[StereoPair, StereoPair]], steps: Float, pose_index: Sequence[int]
) -> Float:
    """Return the derivatives (k, k) of the parameters after a repair over the old ones; see the arguments above."""
    whole, pose = np.eye(len(steps)), list(pose_index)
    for j, (ahead, back) in enumerate(stepped):
        whole[pose, j] = _pose_slope(repair, ahead, back) / (2.0 * steps[j])
    return whole


def _pose_slope(repair: RepairedPair, ahead: StereoPair, back: StereoPair) -> Float:
    """Difference of camera 2's repaired poses for two old calibrations, to first order."""
    pairs = [_with_relative_pose(repair.pair, old) for old in (ahead, back)]
    offsets = [p.epipolar_residual_px(repair.points.xy1_px, repair.points.xy2_px) for p in pairs]
    turn = repair.estimate.response @ (0.5 * (offsets[0] - offsets[1]))
    poses = [pose_parameters(changed(p, sign * turn)) for p, sign in zip(pairs, (1.0, -1.0), strict=True)]
    difference = poses[0] - poses[1]
    difference[:3] = (difference[:3] + np.pi) % (2.0 * np.pi) - np.pi
    return np.asarray(difference)


def _with_length(pair: StereoPair, factor: float) -> Float:
    """Camera 2's pose with the baseline's length multiplied."""
    relative = pair.cam2_from_cam1
    scaled = RigidTransform(relative.rotation, relative.translation_mm * factor)
    return pose_parameters(StereoPair(pair.cam1, Camera(pair.cam2.lens, scaled @ pair.cam1.cam_from_sys)))


def _with_relative_pose(repaired: StereoPair, old: StereoPair) -> StereoPair:
    """Return an old calibration's lenses, camera 1 and baseline length with the repaired orientation."""
    relative = repaired.cam2_from_cam1
    scaled = RigidTransform(relative.rotation, relative.translation_mm * (old.baseline_mm / repaired.baseline_mm))
    return StereoPair(old.cam1, Camera(old.cam2.lens, scaled @ old.cam1.cam_from_sys))
