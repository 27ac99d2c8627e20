"""A direction near Z by its first two components: the stage's axis in a camera's frame or in the system frame."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float


def direction(tilt: Float) -> Float:
    """Unit vector (3,) with the first two components ``tilt`` and a positive third one."""
    return np.array([tilt[0], tilt[1], np.sqrt(max(1.0 - float(tilt[0] ** 2 + tilt[1] ** 2), 1e-12))])


def direction_jacobian(tilt: Float) -> Float:
    """Derivatives (3, 2) of :func:`direction`."""
    third = direction(tilt)[2]
    return np.array([[1.0, 0.0], [0.0, 1.0], [-tilt[0] / third, -tilt[1] / third]])
