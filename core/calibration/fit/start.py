"""Start values from nominal lens data; only alpha and the target's position are taken from the image."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.inputs import CalibrationView, NominalValues


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
