"""``stereorig noise`` on the simulated sensor's frames, and ``measure --noise``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stereorig.core.errors import FileFormatError
from stereorig.core.noise import NoiseModel
from stereorig.server.cli import main
from stereorig.server.formats.images import write_image
from stereorig.server.formats.noise_json import load_noise, noise_content, write_noise
from stereorig.sim.sensor import Sensor

SENSORS = {
    "cam1": Sensor(bit_depth=12, full_well_e=10500.0, read_noise_e=2.4),
    "cam2": Sensor(bit_depth=12, full_well_e=8000.0, read_noise_e=9.0),
}


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    rng = np.random.default_rng(2)
    base = gaussian_filter(rng.normal(size=(160, 150)), 2.0)
    bright = np.clip(0.45 + 0.17 * base / base.std(), 0.03, 0.9)
    for cam, sensor in SENSORS.items():
        for k in range(6):
            write_image(tmp_path / f"{cam}_{k}.tif", sensor.expose(bright, rng))
    return tmp_path


def true_variance(cam: str, grey: np.ndarray) -> np.ndarray:
    return SENSORS[cam].noise_sd(grey / 4095.0) ** 2 + 1.0 / 12.0


def test_both_cameras_are_measured(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = frames / "new" / "noise.json"
    arguments = ["noise", "--cam1", str(frames / "cam1_*.tif"), "--cam2", str(frames / "cam2_*.tif"), "-o", str(out)]
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert "cam1: 6 frames" in shown
    assert "noise sd" in shown
    loaded = load_noise(out)
    grey = np.linspace(400, 3500, 6)
    for cam, model in zip(SENSORS, loaded.models, strict=True):
        assert model is not None
        np.testing.assert_allclose(model.variance(grey), true_variance(cam, grey), rtol=0.05)
    content = json.loads(out.read_text())
    assert [len(content[cam]["source"]) for cam in SENSORS] == [6, 6]
    assert loaded.record()["cam1"]["coefficients"] == list(loaded.models[0].coefficients)  # type: ignore[union-attr]


def test_frames_of_one_camera_stand_for_both(frames: Path) -> None:
    out = frames / "noise.json"
    assert main(["noise", *(str(frames / f"cam1_{k}.tif") for k in range(4)), "-o", str(out)]) == 0
    one, two = load_noise(out).models
    assert one == two
    assert one is not None
    assert one.frames == 4


def test_frames_of_an_even_field_add_a_map_of_the_sensor(frames: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Columns of 12 and a stuck pixel, in 12 bits, under light that falls off."""
    rng = np.random.default_rng(4)
    columns = 12.0 * rng.normal(size=150)
    light = 2000.0 + np.linspace(0.0, 300.0, 160)[:, None]
    for k in range(12):
        grey = light + columns + rng.normal(0.0, 10.0, (160, 150))
        grey[40, 70] = 4095.0 if k else 4000.0
        write_image(frames / f"even_{k}.tif", np.rint(grey).astype(np.uint16))
    out = frames / "noise.json"
    even = ["--even1", str(frames / "even_*.tif"), "-o", str(out)]
    assert main(["noise", "--cam1", str(frames / "cam1_*.tif"), *even]) == 0
    assert "cam1: fixed pattern" in capsys.readouterr().out
    model, other = load_noise(out).models
    assert other is None
    assert model is not None
    assert model.sensor is not None
    assert model.sensor.defects.tolist() == [40 * 150 + 70]
    assert np.abs(model.sensor.pattern.mean(axis=0) - columns + columns.mean()).max() < 4.0
    content = json.loads(out.read_text())
    content["cam1"]["sensor"]["shape"] = [160, 151]
    out.write_text(json.dumps(content))
    with pytest.raises(FileFormatError) as raised:
        load_noise(out)
    assert raised.value.code == "noise_unreadable"
    assert main(["noise", "--cam2", str(frames / "cam2_*.tif"), *even]) == 1
    assert capsys.readouterr().err.startswith("stereorig: option_missing: ")
    still = ["--even1", str(frames / "cam1_*.tif"), "-o", str(out)]
    assert main(["noise", "--cam1", str(frames / "cam1_*.tif"), *still]) == 1
    assert capsys.readouterr().err.startswith("stereorig: frames_not_even: ")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ([], "option_missing"),
        (["cam1_0.tif"], "too_few_frames"),
        (["cam1_0.tif", "nowhere.tif"], "file_missing"),
        (["cam1_0.tif", "--cam1", "cam1_1.tif"], "option_conflict"),
    ],
)
def test_mistakes_are_told_in_one_line(
    frames: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: str
) -> None:
    paths = [a if a.startswith("--") else str(frames / a) for a in arguments]
    assert main(["noise", *paths, "-o", str(frames / "noise.json")]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"stereorig: {code}: ")
    assert said.count("\n") == 1
    assert not (frames / "noise.json").exists()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"format": "stereorig noise", "format_version": 1}',
        '{"format": "stereorig noise", "format_version": 1, "cam1": {"coefficients": [1, 2]}}',
        '{"format": "stereorig noise", "format_version": 1, "cam1": {"coefficients": [-1, 0, 0]}}',
    ],
)
def test_a_file_that_is_no_noise_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "noise.json"
    path.write_text(text)
    with pytest.raises(FileFormatError) as error:
        load_noise(path)
    assert error.value.code == "noise_unreadable"


def test_a_file_gives_back_what_was_written(tmp_path: Path) -> None:
    model = NoiseModel(coefficients=(1.5, 0.25, 1e-5), levels=(1.0, 2.0), variances=(3.0, 4.0), frames=3)
    write_noise(tmp_path / "noise.json", noise_content({"cam2": model}))
    assert load_noise(tmp_path / "noise.json").models == (None, model)
    content = json.loads((tmp_path / "noise.json").read_text())
    content["format_version"] = 99
    (tmp_path / "noise.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="99"):
        load_noise(tmp_path / "noise.json")
