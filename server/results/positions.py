"""Positions of a result's points in a step's own image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.results.reader import read_point_positions


def image_positions(result: Path, calibration: Path, cam: str) -> NDArray[np.float64]:
    """Project each point at its position in that step into one camera's image.

    Parameters
    ----------
    result
        Result file of the step.
    calibration
        The test's calibration.
    cam
        ``cam1`` or ``cam2``.

    Returns
    -------
    NDArray
        (rows, cols, 2) column and row in px; NaN where the point was not measured or has no image.
    """
    pair = load_calibration(calibration).pair
    positions = read_point_positions(result)
    camera = pair.cam1 if cam == "cam1" else pair.cam2
    found: NDArray[Any] = np.full((*positions.shape[:-1], 2), np.nan)
    there = np.isfinite(positions).all(axis=-1)
    if there.any():
        mapped = camera.project(positions[there])
        found[there] = np.where(mapped.valid[:, None], mapped.xy, np.nan)
    return found
