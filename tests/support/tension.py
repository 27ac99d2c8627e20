"""A tension along the image's vertical, in a system frame that lies at 45 degrees in the image."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float

TENSION, LATERAL = 2000e-6, -661e-6
# the system frame in the image: 45 degrees about the line of sight, as a grid on its corner makes it, and a tilt
SYS_FROM_IMAGE = Rotation.from_euler("xz", [4.0, 45.0], degrees=True).as_matrix()
SHIFT = np.array([3.0, -1.0, 40.0])


def shape(x_px: Float, y_px: Float) -> Float:
    flat = np.stack([0.02 * (x_px - 90.0), 0.02 * (y_px - 100.0), np.zeros_like(x_px)], axis=-1)
    return np.asarray(flat @ SYS_FROM_IMAGE.T + SHIFT)


def pulled(x: Float) -> Float:
    E = SYS_FROM_IMAGE @ np.diag([LATERAL, TENSION, 0.0]) @ SYS_FROM_IMAGE.T
    # Green-Lagrange of a symmetric stretch U: (U^2 - 1) / 2
    values, vectors = np.linalg.eigh(np.eye(3) + 2.0 * E)
    U = vectors @ np.diag(np.sqrt(values)) @ vectors.T
    return np.asarray((x - SHIFT) @ U.T + SHIFT + [0.05, 0.02, -0.03])
