"""`stereorig calibration distance`, `compare`, `aspect` and `measure --projected`, from files to their text."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.calibration import CalibrationOptions, calibrate
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from stereorig.server.cli.main import main
from stereorig.server.formats.calibrations.native import write_calibration
from stereorig.server.formats.images import write_image
from stereorig.server.formats.results.reading import read_field, read_head
from stereorig.sim.catalog import make_scene
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.truth import truth_at
from tests.support.calibration_truth import NOMINAL, PAPER, Grid, make_views, project
from tests.support.grid_images import grid_image, paper_camera
from tests.support.measure_command import command
from tests.support.measure_command import rig as rig

TARGET = "pitch_mm = {pitch}\nlines = [11, 11]\nline_width_mm = 0.03\n"
TRUE = {"cam1": paper_camera(-29.0, alpha_deg=44.3), "cam2": paper_camera(30.5, alpha_deg=45.4)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pair of images of a grid, the cameras that took them, and calibrations of another rig."""
    path = tmp_path_factory.mktemp("checks")
    for k, (name, camera) in enumerate(TRUE.items()):
        write_image(path / f"{name}.tif", grid_image(camera, seed=k))
    (path / "true.json").write_text(json.dumps({n: c.paper_parameters() for n, c in TRUE.items()}))
    (path / "target.toml").write_text(TARGET.format(pitch=1.0))
    (path / "wrong.toml").write_text(TARGET.format(pitch=1.004))
    grid = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03)
    options = CalibrationOptions(lens="paper", axis_tilt_sigma_rad=0.0, aspect_sigma=0.0)
    turned = [PAPER[0], {**PAPER[1], "beta": PAPER[1]["beta"] + np.radians(0.1)}]
    for name, seed, cameras in (("a", 1, PAPER), ("b", 2, PAPER), ("turned", 3, turned)):
        made = calibrate(make_views((0.0, 2.0, 4.0, 5.0), seed=seed, cameras=cameras), Grid(), NOMINAL, options)
        write_calibration(path / f"{name}.json", made, grid)
    return path


def marks(length_mm: float) -> list[str]:
    """Two marks that far apart, as the printed equations image them in both cameras."""
    half = 0.5 * length_mm
    ends = [np.concatenate([project(c, x, 1.0, 0.0, 0.3) for x in (-half, half)]) for c in PAPER]
    return [",".join(f"{v:.5f}" for v in end) for end in ends]


def said(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["calibration", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["calibration", *map(str, arguments)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_a_known_distance_agrees_and_is_kept_beside_the_calibration(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made_before = (folder / "a.json").read_bytes()
    out = said(capsys, "distance", folder / "a.json", "--points", *marks(6.0), "--mm", "6", "--sigma-px", "0.01")
    assert "within 3 sigma" in out
    assert "known_distance: agrees" in out
    kept = json.loads((folder / "a.checks.json").read_text())["checks"]["known_distance"]
    assert kept["agrees"] is True
    assert kept["ratio"] == pytest.approx(1.0, abs=1e-4)
    assert (folder / "a.json").read_bytes() == made_before
    assert "known_distance: Measured 6.000" in said(capsys, "check", folder / "a.json")
    # another calibration in the file's place has not been checked
    (folder / "a.json").write_bytes((folder / "b.json").read_bytes())
    assert "known_distance" not in said(capsys, "check", folder / "a.json")
    (folder / "a.json").write_bytes(made_before)


def test_a_wrong_distance_is_said_at_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = said(capsys, "distance", folder / "b.json", "--points", *marks(6.0), "--mm", "6.05", "--sigma-px", "0.01")
    assert "beyond 3 sigma" in out
    assert "DOES NOT AGREE" in out


def test_a_target_in_a_pair_of_images_is_measured_whole(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = ("--images", folder / "cam1.tif", folder / "cam2.tif")
    out = said(capsys, "distance", folder / "true.json", *images, "--target", folder / "target.toml")
    assert "over 81 points" in out
    assert "known_distance: agrees" in out
    assert "not known and does not count" in out  # parameters alone have no covariance
    ratio = float(out.split("ratio ")[1].split(" ")[0])
    # 0.003 px of noise at 33 um a pixel over 11 mm
    assert ratio == pytest.approx(1.0, abs=5e-5)
    out = said(capsys, "distance", folder / "true.json", *images, "--target", folder / "wrong.toml")
    assert "DOES NOT AGREE" in out
    assert float(out.split("ratio ")[1].split(" ")[0]) == pytest.approx(1.0 / 1.004, abs=5e-5)


def test_two_calibrations_of_one_rig_agree_and_one_of_a_turned_camera_does_not(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = said(capsys, "compare", folder / "a.json", folder / "b.json", "--out", tmp_path / "all.json")
    assert "Both calibrations agree" in out
    assert "of 14 degrees of freedom" in out
    numbers = json.loads((tmp_path / "all.json").read_text())
    assert numbers["agrees"] is True
    out = said(capsys, "compare", folder / "a.json", folder / "turned.json")
    assert "The calibrations differ" in out
    turn = out.split("a camera that moved (relative_orientation_deg ")[1].split(" ")[0]
    assert float(turn) == pytest.approx(0.1, abs=0.003)  # six times its standard deviation of 0.0005
    out = said(capsys, "compare", folder / "true.json", folder / "true.json")
    assert "nothing is concluded" in out


def test_the_aspect_ratio_is_printed_for_each_camera_and_a_tilted_grid_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, aspect in (("cam1", 0.9617), ("cam2", 1.0)):
        for k, alpha in enumerate((44.0, 45.0, 46.0)):
            camera = paper_camera(0.2, alpha_deg=alpha, aspect=aspect)
            write_image(tmp_path / f"{name}_{k}.tif", grid_image(camera, seed=k))
    images = sorted(tmp_path.glob("*.tif"))
    out = said(capsys, "aspect", *images, "--target", folder / "target.toml", "--standoff-mm", "400")
    lines = out.splitlines()
    for line, aspect in zip(lines, (0.9617, 1.0), strict=True):
        # 0.2 degrees of tilt change it by 6e-6
        assert float(line.split("aspect ratio ")[1].split(" ")[0]) == pytest.approx(aspect, abs=5e-5)
    error = refused(capsys, "aspect", folder / "cam1.tif", "--target", folder / "target.toml", "--standoff-mm", "400")
    assert "aspect_not_normal" in error
    (tmp_path / "board.toml").write_text('kind = "checkerboard"\nsize = [9, 6]\npitch_mm = 1.0\n')
    error = refused(capsys, "aspect", folder / "cam1.tif", "--target", tmp_path / "board.toml")
    assert "aspect_target" in error
    assert "free poses" in error


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--mm", "6"], "option_missing"),
        (["--points", "1,2,3,4", "5,6,7,8"], "option_missing"),
        (["--points", "1,2,3", "5,6,7,8", "--mm", "6"], "known_distance_unusable"),
        (["--points", "1,2,3,4", "5,6,7,8", "--mm", "-6"], "known_distance_unusable"),
        (["--points", "1,2,3,4", "1,2,3,4", "--mm", "6", "--sigma-mm", "nan"], "option_invalid"),
        (["--images", "no.tif", "no.tif"], "option_missing"),
    ],
)
def test_arguments_that_make_no_check_are_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: str
) -> None:
    assert f"stereorig: {code}: " in refused(capsys, "distance", folder / "a.json", *arguments)


def test_under_a_projected_pattern_the_shape_of_every_pair_is_measured(
    rig: SimRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    for n, load in enumerate((0.0, 1.0)):
        for name in CAMERAS:
            sim = rig.camera(name)
            scene = make_scene(rig, "block", load=load)
            seen = render(scene, sim.camera, sim.size_px, options=RenderOptions(blur_px=rig.blur_px, threads=1))
            write_image(tmp_path / f"{name}_{n}.tif", sim.sensor.expose(sim.lighting.apply(seen), rng, exposure=1.0))
    calibration = {name: rig.camera(name).camera.paper_parameters() for name in CAMERAS}
    (tmp_path / "calibration.json").write_text(json.dumps(calibration))
    out = tmp_path / "out"
    assert main([*command(tmp_path, out), "--projected"]) == 0
    for n, load in enumerate((0.0, 1.0)):
        path = out / f"step_000{n}.nc"
        assert read_head(path).kind == "shape"
        assert read_head(path).settings["pattern"] == "projected"
        field = read_field(path)
        xy = np.stack([field.x_px, field.y_px], axis=-1)
        now = make_scene(rig, "block", load=load)
        truth = truth_at(now, rig.cam1.camera, xy, now=now)
        # as for any shape of this rig: noise of 2 of 255 at 21 px
        assert np.sqrt(np.nanmean((field.xyz_mm - truth.xyz_mm)[field.valid] ** 2)) < 0.4e-3
    assert json.loads((out / "summary.json").read_text())["settings"]["strain"] is None
    capsys.readouterr()
    for more in (["--strain", "9"], ["--smooth", "5"], ["--reference-update", "auto"]):
        assert main([*command(tmp_path, tmp_path / "none"), "--projected", *more]) == 1
        assert "pattern_projected: The pattern is projected and does not move" in capsys.readouterr().err
    for more in (["--extensometer", "60,60,150,60"], ["--area", "all", "--variable", "u_mm"], ["--remove-rigid"]):
        assert main(["gauge", str(out), *more]) == 1
        assert "pattern_projected" in capsys.readouterr().err
    assert main(["gauge", str(out), "--area", "all", "--variable", "z_mm"]) == 0
