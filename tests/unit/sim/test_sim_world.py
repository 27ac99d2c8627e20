"""The simulated world: exposure, noise, positions, scenes, threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.errors import InputError
from stereorig.sim.rig import SimCamera, SimRig
from stereorig.sim.sensor import Sensor
from stereorig.sim.world import SimWorld
from tests.support.requirements import ROOT

CONFIG = ROOT / "config"


def small(rig: SimRig) -> SimRig:
    """The same rig looking at its middle only, to be quick."""

    def crop(cam: SimCamera) -> SimCamera:
        p = cam.camera.paper_parameters()
        p["cx_px"] -= cam.size_px[0] / 2 - 40
        p["cy_px"] -= cam.size_px[1] / 2 - 32
        return replace(cam, size_px=(80, 64), camera=type(cam.camera).from_paper(**p))

    return replace(rig, cam1=crop(rig.cam1), cam2=crop(rig.cam2))


@pytest.fixture(scope="module")
def rig() -> SimRig:
    return small(SimRig.from_toml(CONFIG / "sim_paper.toml"))


def test_noise_is_two_grey_levels_at_mid_scale(rig: SimRig) -> None:
    sensor = rig.cam1.sensor
    flat = np.full((400, 400), 0.5)
    image = sensor.expose(flat, np.random.default_rng(1)).astype(float)
    # 2.0 and the rounding's 1/12 on top; 160,000 samples know an sd to 0.2 %
    assert image.std() == pytest.approx(np.hypot(2.0, 1 / np.sqrt(12)), rel=0.01)
    assert image.mean() == pytest.approx(127.5, abs=0.03)
    # shot noise: brighter is noisier
    assert sensor.noise_sd(0.9) > sensor.noise_sd(0.5) > sensor.noise_sd(0.0)


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_quantisation(bits: int, dtype: type) -> None:
    sensor = Sensor(bit_depth=bits, full_well_e=1e6, read_noise_e=0.0)
    ramp = np.linspace(-0.1, 1.1, 10001)[None]
    image = sensor.expose(ramp, None)
    assert image.dtype == dtype
    assert image.max() == 2**bits - 1
    assert image.min() == 0
    np.testing.assert_array_equal(image, np.clip(np.rint(ramp * (2**bits - 1)), 0, 2**bits - 1))


def test_exposure_and_gain_scale_and_saturate(rig: SimRig) -> None:
    world = SimWorld(rig, lambda axis: 0.0)
    world.set_scene("block")
    base = world.expose("cam1", exposure_ms=5.0, rng=None).astype(float)
    double = world.expose("cam1", exposure_ms=10.0, rng=None).astype(float)
    by_gain = world.expose("cam1", exposure_ms=5.0, gain_db=20 * np.log10(2), rng=None).astype(float)
    np.testing.assert_allclose(double, 2 * base, atol=1.5)
    np.testing.assert_array_equal(double, by_gain)
    assert (world.expose("cam1", exposure_ms=100.0, rng=None) == 255).mean() > 0.5


def test_frames_differ_in_noise_only(rig: SimRig) -> None:
    world = SimWorld(rig, lambda axis: 0.0)
    world.set_scene("plate", load=300.0)
    rng = np.random.default_rng(5)
    clean = world.expose("cam2", exposure_ms=10.0, rng=None).astype(float)
    a, b = (world.expose("cam2", exposure_ms=10.0, rng=rng).astype(float) for _ in range(2))
    assert (a != b).mean() > 0.5
    assert (a - b).std() == pytest.approx(2.0 * np.sqrt(2), rel=0.1)
    assert abs((a - clean).mean()) < 0.15


def test_the_picture_follows_the_stage_and_its_misalignment(rig: SimRig) -> None:
    at = {1: 0.0, 2: 0.0}
    world = SimWorld(rig, lambda axis: at[axis])
    first = world.expose("cam1", exposure_ms=10.0, rng=None)
    other = world.expose("cam2", exposure_ms=10.0, rng=None)
    at[1] = 5.0
    moved = world.expose("cam1", exposure_ms=10.0, rng=None)
    assert (moved != first).any()
    np.testing.assert_array_equal(world.expose("cam2", exposure_ms=10.0, rng=None), other)
    depth = world.true_camera("cam1").cam_from_sys.translation_mm - rig.cam1.camera.cam_from_sys.translation_mm
    np.testing.assert_allclose(depth, [0.0, 0.0, 5.0], atol=1e-12)
    world.set_axis_tilt("cam1", (0.0, 1e-3))
    assert (world.expose("cam1", exposure_ms=10.0, rng=None) != moved).any()
    drift = world.true_camera("cam1").cam_from_sys.translation_mm - rig.cam1.camera.cam_from_sys.translation_mm
    np.testing.assert_allclose(drift, [5e-3, 0.0, 5.0], atol=1e-5)
    # one milliradian moves the picture by phd / 1000 = 12 px per unit of relative travel: 0.15 px over 5 mm of 400


def test_many_threads_see_one_world(rig: SimRig) -> None:
    world = SimWorld(rig, lambda axis: 0.0)
    alone = {}
    for name in ("grid", "block"):
        world.set_scene(name)
        alone[name] = world.expose("cam1", exposure_ms=10.0, rng=None)
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda _: world.expose("cam1", exposure_ms=10.0, rng=None), range(12)))
    for image in images:
        np.testing.assert_array_equal(image, alone["block"])


def test_what_makes_no_sense_is_refused(rig: SimRig) -> None:
    world = SimWorld(rig, lambda axis: 0.0)
    for name, load, code in (
        ("tomato", 0.0, "unknown_scene"),
        ("plate", float("nan"), "scene_invalid"),
        ("panel", -1.0, "scene_invalid"),
    ):
        with pytest.raises(InputError) as caught:
            world.set_scene(name, load=load)
        assert caught.value.code == code
    assert world.scene.name == "grid"
    with pytest.raises(InputError) as caught:
        world.expose("cam3", exposure_ms=1.0, rng=None)  # type: ignore[arg-type]
    assert caught.value.code == "unknown_camera"


def test_a_rig_file_that_makes_no_sense_is_refused(tmp_path: Path) -> None:
    text = (CONFIG / "sim_paper.toml").read_text()
    for change, code in (
        (("[sim.cam1]\nphd_px = 12062.0", "[sim.cam1]"), "rig_invalid"),
        (("z0_mm = 399.3", "z0_mm = nan"), "rig_invalid"),
        (("stage_sign = 1", "stage_sign = 2"), "rig_invalid"),
        (("lines = [11, 11]", "lines = 11"), "rig_invalid"),
        (("full_well_e = 40000.0", "full_well_e = 0.0"), "rig_invalid"),
        (("[target]", "[target"), "rig_unreadable"),
    ):
        assert change[0] in text
        file = tmp_path / "rig.toml"
        file.write_text(text.replace(*change))
        with pytest.raises(InputError) as caught:
            SimRig.from_toml(file)
        assert caught.value.code == code
    with pytest.raises(InputError) as caught:
        SimRig.from_toml(tmp_path / "none.toml")
    assert caught.value.code == "rig_unreadable"
