"""A calibration with a volume and a covariance, for the cameras of `field_bench`."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereorig.core.calibration import COVARIANCE_NAMES
from stereorig.core.target import GridTarget
from tests.support.field_bench import SIZE, pair

TARGET = GridTarget(pitch_mm=0.5, lines=(7, 7), line_width_mm=0.02)


POSITIONS = (0.0, 2.0, 5.0)


def covariance() -> np.ndarray:
    """A made-up covariance with the correlation of distance and principal distance that real ones have."""
    sigma = np.array([2.0, 0.5, 0.5, 1e-10, 2e-5, 2e-5, 2e-5, 2e-3, 2e-3, 0.06])
    one = np.diag(sigma**2)
    one[0, 9] = one[9, 0] = 0.999 * sigma[0] * sigma[9]
    return np.kron(np.eye(2), one)


def content() -> dict[str, Any]:
    """A calibration.json as ``stereorig calibrate`` writes it, as far as the volume needs it."""
    cameras = {"cam1": pair().cam1, "cam2": pair().cam2}
    return {
        **{name: camera.paper_parameters() for name, camera in cameras.items()},
        "image_size_px": {name: list(SIZE) for name in cameras},
        "target": {"pitch_mm": 0.5, "lines": [7, 7], "line_width_mm": 0.02, "node_tolerance_mm": 0.0},
        "views": [
            {"camera": name, "dz_mm": dz, "held_out": held_out, "name": f"{name}_{dz:g}"}
            for name in cameras
            for dz, held_out in ((0.0, False), (2.0, False), (5.0, False), (40.0, True))
        ],
        "covariance": {"names": list(COVARIANCE_NAMES), "matrix": covariance().tolist()},
    }
