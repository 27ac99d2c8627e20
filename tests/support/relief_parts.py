"""Parts in relief to measure, and the calibration that a user has of the cameras that saw them."""

from __future__ import annotations

import numpy as np

from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from tests.support.relief_rig import CYLINDER, PLATEAU, RIDGE, SPHERE, VALLEY, Body, Feature, ReliefCamera, Texture


def calibrated(cameras: tuple[ReliefCamera, ReliefCamera]) -> StereoPair:
    """The pair as a calibration knows it: all but the misfit."""

    def one(c: ReliefCamera) -> Camera:
        k1, k2, p1, p2 = c.k
        lens = OpenCVLens(c.f_px, c.f_px, *c.centre_px, 0.0, k1, k2, p1, p2)
        return Camera(lens, RigidTransform(c.R, c.t))

    return StereoPair(one(cameras[0]), one(cameras[1]))


def relief_plate(texture: Texture | None = None) -> Body:
    """A plate of 64 x 51 mm with a ridge and a valley of 45 degrees, a step, a ball and a cylinder to 60 degrees."""
    return Body(
        (
            Feature(RIDGE, (-18.0, 0.0), (9.0, 12.0), 6.0, np.radians(45.0)),
            Feature(PLATEAU, (0.0, -12.0), (6.0, 6.0), 4.0),
            Feature(SPHERE, (2.0, 12.0), (9.0, 9.0), 9.0, np.radians(60.0)),
            Feature(CYLINDER, (20.0, -8.0), (8.0, 14.0), 8.0, np.radians(60.0)),
            Feature(VALLEY, (21.0, 17.0), (8.0, 6.0), 5.0, np.radians(45.0)),
        ),
        texture=texture or Texture(),
    )
