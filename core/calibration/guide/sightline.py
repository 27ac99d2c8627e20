"""The pair's common line of sight to the specimen, and the directions that its images show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.guide.estimate import Estimate


@dataclass(frozen=True, eq=False)
class Sightline:
    """Line of sight of the pair to the specimen, system frame.

    Attributes
    ----------
    eye_mm
        (3,) the point between both pinholes.
    towards, right, down
        (3,) unit vectors: from the specimen to the eye, and along the images' rows and columns.
    depth_mm
        Distance of the specimen.
    """

    eye_mm: Float
    towards: Float
    right: Float
    down: Float
    depth_mm: float

    def distance_mm(self, point_mm: Float) -> float:
        """Distance of a point along the line."""
        return float((self.eye_mm - point_mm) @ self.towards)


def sightline(estimate: Estimate) -> Sightline:
    """Return the line of sight to the system frame's origin, where the specimen will be."""
    cameras = estimate.pair.cam1, estimate.pair.cam2
    eye = np.mean([c.centre_sys_mm for c in cameras], axis=0)
    depth = float(np.linalg.norm(eye))
    towards = eye / depth
    rows = np.mean([c.cam_from_sys.rotation[0] for c in cameras], axis=0)
    right = rows - (rows @ towards) * towards
    right /= np.linalg.norm(right)
    return Sightline(eye, towards, right, np.cross(-towards, right), depth)
