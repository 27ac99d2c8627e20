"""Test for cameras that disagree about the target's pose, although each camera's own views are consistent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.result import ViewResult
from stereorig.core.cameras.camera import normalised_jacobian
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.names import CAMERAS

#: of the squared residuals: 0.7 to 1 for a bumped camera, below 0.2 for lenses that do not fit, bent boards and noise
DISAGREE_SHARE = 0.5


def share_of_own_poses(views: Sequence[ViewResult], points_mm: Float, pair: StereoPair) -> float:
    """Return the share of the squared residuals that vanishes if each camera gets its own poses of the target.

    A target seen in a free pose has one pose for both cameras. A camera that moved between the views, or images of one
    number that show two poses, make the two differ, and next to nothing else does.

    Parameters
    ----------
    views
        Views of a calibration; only free poses that both cameras saw are used.
    points_mm
        (n, 3) points of the target.
    pair
        The cameras.

    Returns
    -------
    float
        0 if no pose is used.
    """
    seen = [{v.frame for v in views if v.camera == name and v.frame is not None} for name in CAMERAS]
    total = left = 0.0
    for view in views:
        if view.frame not in seen[0] & seen[1]:
            continue
        residual = view.residual_px.reshape(-1, 2)
        found = np.isfinite(residual).all(axis=-1)
        if found.sum() <= 3:
            continue
        lens = (pair.cam1, pair.cam2)[CAMERAS.index(view.camera)].lens
        p = view.cam_from_target.apply(points_mm[found])
        by_point = lens.image_jacobian(p[:, :2] / p[:, 2:]) @ normalised_jacobian(p)
        arm = p - p.mean(axis=0)
        turns = np.stack([np.cross(np.eye(3)[axis], arm) for axis in range(3)], axis=-1)
        J = by_point @ np.concatenate([turns, np.broadcast_to(np.eye(3), turns.shape)], axis=-1)
        r, J = residual[found].ravel(), J.reshape(-1, 6)
        if not np.isfinite(J).all():
            continue
        total += float(r @ r)
        r = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
        # six numbers take up their share of mere noise, too
        left += float(r @ r) * len(r) / (len(r) - 6)
    return max(1.0 - left / total, 0.0) if total > 0.0 else 0.0
