"""Parts in relief to measure, and the calibration that a user has of the cameras that saw them."""

from __future__ import annotations

import numpy as np

from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.stereo import StereoPair
from tests.support.relief_rig import (
    CYLINDER,
    HOLE,
    PLATEAU,
    RIDGE,
    SPHERE,
    VALLEY,
    WIRE,
    Body,
    Feature,
    ReliefCamera,
    Texture,
)


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


def obstructed_plate(texture: Texture | None = None) -> Body:
    """A plate with a hole, steps of 1, 3 and 10 mm, ridges of 30 and 65 degrees, and a wire before it."""
    return Body(
        (
            Feature(PLATEAU, (-22.0, -12.0), (5.0, 7.0), 1.0),
            Feature(PLATEAU, (-10.0, -12.0), (5.0, 7.0), 3.0),
            Feature(PLATEAU, (5.0, -12.0), (6.0, 7.0), 10.0),
            Feature(RIDGE, (-18.0, 12.0), (10.0, 8.0), 5.0, np.radians(30.0), 0.3),
            Feature(RIDGE, (4.0, 12.0), (4.0, 8.0), 8.0, np.radians(65.0)),
            Feature(HOLE, (22.0, 12.0), (4.0, 4.0), 3.5),
            Feature(WIRE, (20.0, 0.0), (1.0, 40.0), 9.0, 0.25, 0.25),
        ),
        texture=texture or Texture(),
    )
