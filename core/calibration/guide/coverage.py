"""Coverage of the views taken: parts of the images, depths and tilts of the target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.calibration.guide.estimate import Estimate

CELLS = (8, 6)  # columns, rows
_DEPTHS = (0.8, 0.9, 0.97, 1.03, 1.1, 1.2)  # multiples of the specimen's distance
_FACING_RAD = np.radians(10.0)  # a tilt below it is none
TILTS = ("facing", "right", "lower right", "down", "lower left", "left", "upper left", "up", "upper right")


@dataclass(frozen=True, eq=False)
class ViewCoverage:
    """Coverage of the views taken.

    Attributes
    ----------
    cells
        (2, rows, columns) number of the target's points that each part of either camera's image has shown.
    share
        (2,) share of the parts with at least one.
    depth_edges
        Distances over the specimen's between the classes of ``depths``; the outermost classes are open.
    depths
        Number of poses in each class, nearest first.
    tilts
        Number of poses tilted in each direction of :data:`TILTS`, as the images show it.
    """

    cells: Float
    share: Float
    depth_edges: tuple[float, ...]
    depths: tuple[int, ...]
    tilts: dict[str, int]


def coverage_of(estimate: Estimate, sizes_px: tuple[tuple[int, int], tuple[int, int]]) -> ViewCoverage:
    """Count where the target's points were seen, and the poses' depths and tilts.

    Parameters
    ----------
    estimate
        Cameras, poses and views.
    sizes_px
        (width, height) of each camera's image.
    """
    cells = np.zeros((2, CELLS[1], CELLS[0]))
    for row in estimate.rows:
        xy = row.xy_px[row.found]
        width, height = sizes_px[row.camera]
        counts, _, _ = np.histogram2d(
            xy[:, 1], xy[:, 0], bins=CELLS[::-1], range=((-0.5, height - 0.5), (-0.5, width - 0.5))
        )
        cells[row.camera] += counts
    line = sightline(estimate)
    depths, tilts = np.zeros(len(_DEPTHS) + 1, dtype=int), dict.fromkeys(TILTS, 0)
    for pose in estimate.sys_from_target.values():
        depths[int(np.searchsorted(_DEPTHS, line.distance_mm(pose.translation_mm) / line.depth_mm))] += 1
        tilts[tilt_name(line, pose.rotation)] += 1
    return ViewCoverage(cells, (cells > 0).mean(axis=(1, 2)), _DEPTHS, tuple(depths.tolist()), tilts)


def tilt_name(line: Sightline, rotation: Float) -> str:
    """Direction in which the target's face is turned, as the images show it."""
    face = -rotation[:, 2]
    if float(np.arccos(np.clip(face @ line.towards, -1.0, 1.0))) < _FACING_RAD:
        return TILTS[0]
    angle = np.arctan2(face @ line.down, face @ line.right)
    return TILTS[1 + int(np.round(angle / (np.pi / 4.0))) % 8]


# The pair's common line of sight to the specimen, and the directions that its images show.


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
