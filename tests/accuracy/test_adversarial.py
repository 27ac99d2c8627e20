"""Pictures that invite wrong matches: nothing wrong is shown as valid, and what can be matched is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.errors import SeedError
from stereorig.core.field.region.textured import repeats
from stereorig.core.field.seeding.seeds import Seed
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.sim.render import render
from stereorig.sim.texture import dots, speckle
from tests.bench.accuracy.adversarial_scenes import Pictures
from tests.support import field_bench as bench

MOTION = (0.02, -0.013, 0.03, 0.0006, -0.0004, 0.001)
OPTIONS = MeasureOptions(subset_px=21)
PX_MM = 0.033

CASES = {
    "blur": lambda p: p.blur(1.0, matchable=True),
    "much blur": lambda p: p.blur(2.5, matchable=False),
    "smeared": lambda p: p.motion_blur(9),
    "patches": lambda p: p.patches(0.05, 4.0),
    "many patches": lambda p: p.patches(0.3, 4.0),
    "patches in camera 2": lambda p: p.patches_one(0.2),
    "shines through": lambda p: p.shines_through(0.25),
    "noise": lambda p: p.noise(15.0),
    "dead pixels": lambda p: p.dead_pixels(0.01),
    "fixed pattern": lambda p: p.fixed_pattern(3.0, 2.0),
    "over-exposed": lambda p: p.overexposed(1.4),
}


@pytest.fixture(scope="module")
def pictures():
    clean = (*bench.take("block", 0.0, MOTION), *bench.take("block", 1.0, MOTION, seed=1))
    other = tuple(np.ascontiguousarray(image[::-1, ::-1]) for image in clean[2:])
    return Pictures(clean, other)


@pytest.mark.fault(37)
@pytest.mark.fault(39)
@pytest.mark.parametrize("name", CASES)
def test_no_wrong_point_is_valid(pictures, name):
    case = CASES[name](pictures)
    grid = bench.grid(spacing_px=6.0)
    true = bench.truth(grid, bench.scene("block", 0.0, MOTION), bench.scene("block", 1.0, MOTION))
    try:
        field = ReferencePair(bench.pair(), *case.pictures[:2]).motion(*case.pictures[2:], grid, OPTIONS)
    except SeedError:
        assert name in ("smeared", "many patches", "much blur")
        return
    error = field.uvw_mm - true.uvw_mm
    v = field.valid
    if v.any():
        assert np.linalg.norm(error[v], axis=-1).max() < 0.5 * PX_MM
        assert np.abs(error / field.sigma_mm[..., 3:])[v].max() < 6.0
    if name in ("blur", "noise", "fixed pattern"):
        assert v.mean() > 0.99


def lattice(scene_name, load):
    return replace(bench.scene(scene_name, load, MOTION), texture=dots(pitch_mm=0.5, diameter_mm=0.25, rim_mm=0.03))


def capture(scene):
    rng = np.random.default_rng(3)
    out = []
    for camera in (bench.pair().cam1, bench.pair().cam2):
        clean = 255.0 * render(scene, camera, bench.SIZE)
        out.append(np.clip(np.rint(clean + rng.normal(0.0, 2.0, clean.shape)), 0, 255).astype(np.uint8))
    return tuple(out)


@pytest.mark.fault(36)
def test_a_texture_that_repeats_gives_no_start():
    reference = ReferencePair(bench.pair(), *capture(lattice("block", 0.0)))
    grid = bench.grid(spacing_px=12.0)
    with pytest.raises(SeedError):
        reference.shape(grid, OPTIONS)
    # a user who states which dot is which gets the shape, but no guess at how many dots it moved
    xy = np.array([[130.0, 110.0]])
    position = bench.truth(grid, lattice("block", 0.0)).xyz_mm.reshape(-1, 3)
    nearest = np.argmin(np.linalg.norm(grid.xy_px.reshape(-1, 2) - xy, axis=1))
    seed = Seed(tuple(grid.xy_px.reshape(-1, 2)[nearest]), tuple(bench.pair().cam2.project(position[nearest]).xy))
    shape = reference.shape(grid, OPTIONS, seeds=[seed])
    assert shape.valid.mean() > 0.9
    assert np.nanmax(np.abs(shape.xyz_mm.reshape(-1, 3) - position)) < 0.02
    with pytest.raises(SeedError):
        reference.motion(*capture(lattice("block", 1.0)), grid, OPTIONS, shape=shape)


@pytest.mark.parametrize("subset_px", [9, 15, 21, 33])
def test_speckles_do_not_repeat_and_dots_do(subset_px):
    xy = np.stack(np.meshgrid(np.arange(60, 200, 20), np.arange(60, 170, 20)), -1).reshape(-1, 2).astype(float)
    for seed in range(3):
        painted = replace(bench.scene("block"), texture=speckle(diameter_mm=0.15, seed=seed))
        assert not repeats(capture(painted)[0], xy, subset_px=subset_px).any()
    assert repeats(capture(lattice("block", 0.0))[0], xy, subset_px=subset_px).all()
