"""A crack that opens: no subset that reaches over it may come out as a measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import Scene
from stereorig.sim.truth import truth_at
from tests.support.requirements import ROOT

SIZE = (288, 160)  # the whole crack and what lies above and below it
CORNER = (112.0, 160.0)


@pytest.fixture(scope="module")
def rig() -> SimRig:
    return SimRig.from_toml(ROOT / "config" / "sim_panel.toml")


def cut(camera: Camera) -> Camera:
    lens = camera.lens
    assert isinstance(lens, SeidelLens)
    return replace(camera, lens=replace(lens, cx_px=lens.cx_px - CORNER[0], cy_px=lens.cy_px - CORNER[1]))


def take(pair: StereoPair, scene: Scene, rig: SimRig, seed: int) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(seed)
    images = [
        render(scene, camera, SIZE, options=RenderOptions(blur_px=rig.blur_px)) for camera in (pair.cam1, pair.cam2)
    ]
    return [np.clip(np.rint(255 * i + 2 * rng.standard_normal(i.shape)), 0, 255).astype(np.uint8) for i in images]


@pytest.mark.fault(37)
def test_points_over_an_open_crack_are_refused_and_both_lips_stand(rig: SimRig) -> None:
    pair = StereoPair(cut(rig.cam1.camera), cut(rig.cam2.camera))
    before, after = make_scene(rig, "panel", load=0.0), make_scene(rig, "panel", load=35.6)
    grid = PointGrid.rectangle(20, 20, SIZE[0] - 21, SIZE[1] - 21, spacing_px=5)
    reference = ReferencePair(pair, *take(pair, before, rig, 1))
    shape = reference.shape(grid, MeasureOptions(subset_px=33))
    field = reference.motion(*take(pair, after, rig, 2), grid, MeasureOptions(subset_px=33), shape=shape)
    true = truth_at(before, pair.cam1, grid.xy_px, now=after)
    assert field.uvw_mm is not None
    v = field.valid
    assert 0.6 < v[shape.valid].mean() < 0.97  # a good part of this small image lies beside the crack
    # in the plane: a smeared crack would be off by a good part of its opening, 60 um
    error = np.abs(field.uvw_mm - true.uvw_mm)[v]
    assert error[:, :2].max() < 0.010
    assert (error[:, :2] / field.sigma_mm[v][:, 3:5]).max() < 6.0
    # out of the plane: a plane patch on a buckled sheet, whose curvature costs some micrometres more
    assert error[:, 2].max() < 0.030
    above, below = v & (true.xyz_mm[..., 1] < -8.0), v & (true.xyz_mm[..., 1] > 8.0)
    middle = np.abs(true.xyz_mm[..., 0]) < 20.0
    assert (above & middle).any()
    assert (below & middle).any()
    opening = field.uvw_mm[below & middle][:, 1].mean() - field.uvw_mm[above & middle][:, 1].mean()
    assert opening > 0.05
