"""Corrections to a camera's view of dots."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.boards.eccentricity import dot_centre_offset_px
from stereorig.core.cameras.camera import Camera


def dot_offsets_px(camera: Camera, nodes_mm: Float, radius_mm: float) -> Float:
    """Return the found centres of dots minus the images of the dots' centres, (n, 2), zero where a dot has no image.

    Parameters
    ----------
    camera
        With its pose towards the target, ``cam_from_target``.
    nodes_mm
        (n, 3) the dots' centres, target frame.
    radius_mm
        Radius of the dots.
    """
    offset = dot_centre_offset_px(lambda points: camera.project(points).xy, nodes_mm, radius_mm)
    return np.where(np.isfinite(offset), offset, 0.0)
