"""Comparison of measured and true values, point by point.

The measured system frame is the one that the grid defined; it differs from the simulation's own by the calibration's
error (micrometres). Displacements are compared as they are, shapes after subtracting each one's best plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.server.demo.session import pixels_of
from stereorig.sim.catalog import make_scene
from stereorig.sim.rig import SimRig
from stereorig.sim.truth import Truth, truth_at

WRONG_PX = 0.1  # a matched point is off by hundredths of a pixel; a mismatch by tenths and more
WRONG_SIGMA = 5.0


@dataclass(frozen=True)
class MotionComparison:
    """Displacements against the truth.

    Attributes
    ----------
    truth
        At the points' pixels.
    error_mm
        (r, c, 3) measured minus true, NaN at points that were not measured.
    wrong
        (r, c) valid, but further off than ``WRONG_PX`` on the target and ``WRONG_SIGMA`` standard deviations together.
    """

    truth: Truth
    error_mm: Float
    wrong: NDArray[np.bool_]

    @property
    def rms_mm(self) -> Float:
        """(3,) root mean square of u, v, w."""
        return np.asarray(np.sqrt(np.nanmean(self.error_mm**2, axis=(0, 1))))


def pixel_mm(rig: SimRig) -> float:
    """One pixel on the target."""
    parameters = rig.cam1.camera.paper_parameters()
    return parameters["z0_mm"] / parameters["phd_px"]


def compare_motion(result: Field, rig: SimRig, scene: str, load: float) -> MotionComparison:
    """Compare a displacement field with the truth at the same pixels."""
    if result.uvw_mm is None:
        raise ValueError("the result is a shape, not a displacement")
    truth = truth_at(make_scene(rig, scene), rig.cam1.camera, pixels_of(result), now=make_scene(rig, scene, load=load))
    error = np.where(result.valid[..., None], result.uvw_mm - truth.uvw_mm, np.nan)
    limit = WRONG_PX * pixel_mm(rig) + WRONG_SIGMA * result.sigma_mm[..., 3:6]
    with np.errstate(invalid="ignore"):
        within = (np.abs(error) <= limit).all(axis=-1)
    return MotionComparison(truth, error, result.valid & ~within)


def compare_shape(result: Field, rig: SimRig, scene: str, load: float = 0.0) -> NDArray[np.bool_]:
    """Return (r, c): valid points whose height over the best plane is wrong, by the same measure."""
    truth = truth_at(make_scene(rig, scene, load=load), rig.cam1.camera, pixels_of(result))
    difference = heights_mm(result.xyz_mm, result.valid) - heights_mm(truth.xyz_mm, result.valid)
    angle_rad = StereoPair(rig.cam1.camera, rig.cam2.camera).stereo_angle_rad
    limit = WRONG_PX * pixel_mm(rig) / np.sin(0.5 * angle_rad) + WRONG_SIGMA * result.sigma_mm[..., 2]
    with np.errstate(invalid="ignore"):
        within = np.abs(difference) <= limit
    return np.asarray(result.valid & ~within)


def heights_mm(xyz_mm: Float, use: NDArray[np.bool_]) -> Float:
    """Heights (r, c) of points (r, c, 3) over their best plane, along Z_sys; NaN where ``use`` is False."""
    p = xyz_mm[use]
    centre = p.mean(axis=0)
    design = np.column_stack([np.ones(len(p)), p[:, :2] - centre[:2]])
    heights = np.full(use.shape, np.nan)
    heights[use] = p[:, 2] - design @ np.linalg.lstsq(design, p[:, 2], rcond=None)[0]
    return heights
