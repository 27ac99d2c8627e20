"""Derivatives of measured points over the cameras' parameters: beside the matcher itself with changed cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereorig.core.cameras.camera import TEN_PARAMETER_NAMES, Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.derivatives import measured_derivatives
from stereorig.core.matching.fit import fit_motion, fit_shape
from stereorig.core.matching.geometry import motion_geometry, shape_geometry
from stereorig.core.matching.options import MatchOptions
from tests.support import matching_scene as scene

SIZE = 160
NAMES = [f"{camera}.{name}" for camera in ("cam1", "cam2") for name in TEN_PARAMETER_NAMES]
#: changes that move points by micrometres
CHANGES = {
    "phd_px": 2.0,
    "cx_px": 0.3,
    "cy_px": 0.3,
    "kappa_per_px2": 1e-9,
    "alpha_rad": 2e-5,
    "beta_rad": 2e-5,
    "gamma_rad": 2e-5,
    "x0_mm": 5e-3,
    "y0_mm": 5e-3,
    "z0_mm": 5e-2,
}


def test_they_are_what_the_matcher_does_when_the_cameras_change() -> None:
    pair = scene.paper_pair(size=SIZE)
    turn = 0.01
    before = scene.Plane(np.zeros(3), np.array([[1.0, 0.0], [0.0, 1.0], [0.05, -0.03]]))
    R = np.array([[np.cos(turn), 0.0, np.sin(turn)], [0.0, 1.0, 0.0], [-np.sin(turn), 0.0, np.cos(turn)]])
    after = scene.Plane(np.array([0.3, -0.25, 0.5]), R @ before.basis * 1.004)
    texture = scene.Texture(blob_mm=0.06)
    images = [
        scene.render(camera, plane, texture, size=SIZE).astype(np.float32)
        for plane in (before, after)
        for camera in (pair.cam1, pair.cam2)
    ]
    xy = scene.grid(SIZE, margin=50, count=4)
    options = MatchOptions(subset_px=33)

    def measured(values: dict[str, float]) -> NDArray[np.float64]:
        one, two = (
            Camera.from_paper(**{k.removeprefix(p): v for k, v in values.items() if k.startswith(p)})
            for p in ("cam1.", "cam2.")
        )
        now = StereoPair(one, two)
        w, G = scene.true_w(one, before, xy), scene.true_g(one, before, after, xy)
        shape = fit_shape(now, images[0], images[1], xy, w, options)
        motion = fit_motion(now, *images, xy, w, G, options)
        assert (shape.status == 0).all()
        assert (motion.status == 0).all()
        xyz = shape_geometry(now, xy, shape.w).xyz_mm
        return np.concatenate([xyz, motion_geometry(now, xy, motion.w, motion.G).uvw_mm], axis=-1)

    nominal = pair.values()
    start = measured(nominal)
    slopes = measured_derivatives(pair, start[:, :3], NAMES, start[:, :3] + start[:, 3:])
    for k, name in enumerate(NAMES):
        step = CHANGES[name.split(".")[1]]
        up, down = ({**nominal, name: nominal[name] + s * step} for s in (1.0, -1.0))
        seen_um = 1e3 * 0.5 * (measured(up) - measured(down))
        predicted_um = 1e3 * step * slopes[:, :, k]
        # the matcher fits a whole subset, whose corners move by some thousandths unlike its centre: 5 nm of up to 10 um
        assert np.sqrt(np.mean((seen_um - predicted_um) ** 2, axis=0)).max() < 0.006, name
