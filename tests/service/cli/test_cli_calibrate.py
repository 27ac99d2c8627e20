"""`stereorig calibrate` from image files to calibration.json, and every refusal in one line."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.calibration import CalibrationOptions, NominalValues, from_images
from stereorig.core.calibration.from_images import ImageOfTarget, calibrate_views
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import Cancelled, InputError
from stereorig.core.grid import GridView, detect_grid
from stereorig.core.progress import Cancel
from stereorig.core.target import GridTarget
from stereorig.server.cli.main import main
from stereorig.server.cli.measurement import calibrate as command_line
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.images import GrayImage, write_image
from tests.support.grid_images import PAPER_TARGET, Exposure, expose, node_positions, paper_camera, render_cover

FOUND: dict[Any, GridView] = {}
POSITIONS = (0.0, 2.0, 5.0)
TRUE = StereoPair(
    paper_camera(-29.2, alpha_deg=44.3, beta_deg=0.6, z0_mm=399.0),
    paper_camera(30.5, alpha_deg=45.4, beta_deg=-0.5, z0_mm=402.0, centre_offset_px=(-3.0, 5.0)),
)
TARGET = "pitch_mm = 1.0\nlines = [11, 11]\nline_width_mm = 0.03\nnode_tolerance_mm = 0.0\ndark_lines = true\n"
CAMERA = "image_size_px = [512, 480]\nphd_px = 12500.0\nstandoff_mm = 410.0\naspect = 0.9617\nangle_deg = "
RIG = f"[cam1]\n{CAMERA}-30.0\n[cam2]\n{CAMERA}30.0\n"


def captured(tolerance_mm: float, seed: int) -> dict[tuple[str, float], GrayImage]:
    positions = node_positions(PAPER_TARGET, tolerance_mm, seed)
    images = {}
    for dz in POSITIONS:
        for k, (name, camera) in enumerate((("cam1", TRUE.cam1), ("cam2", TRUE.cam2))):
            cover = render_cover(camera.moved(dz), PAPER_TARGET, nodes_mm=positions)
            images[name, dz] = expose(cover, Exposure(seed=seed + 10 * int(dz) + k))
    return images


@pytest.fixture(scope="module")
def exact() -> dict[tuple[str, float], GrayImage]:
    return captured(0.0, 1)


@pytest.fixture(autouse=True)
def each_image_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same images come back in most tests; the detection itself is tested elsewhere."""

    def remembered(image: GrayImage, target: GridTarget, **how: Any) -> GridView:
        key = (image.tobytes(), image.shape, target, how["localiser"], how["options"])
        if key not in FOUND:
            FOUND[key] = detect_grid(image, target, **how)
        return FOUND[key]

    monkeypatch.setattr(from_images, "detect_target", remembered)


@pytest.fixture
def folder(tmp_path: Path, exact: dict[tuple[str, float], GrayImage]) -> Path:
    (tmp_path / "views").mkdir()
    for (camera, dz), image in exact.items():
        write_image(tmp_path / "views" / f"{camera}_{dz:+.3f}mm.tif", image)
    (tmp_path / "target.toml").write_text(TARGET)
    (tmp_path / "rig.toml").write_text(RIG)
    return tmp_path


def command(folder: Path, *more: str) -> list[str]:
    return [
        "calibrate",
        str(folder / "views"),
        "--target",
        str(folder / "target.toml"),
        "--rig",
        str(folder / "rig.toml"),
        "--out",
        str(folder / "calibration.json"),
        *more,
    ]


def volume_error_um(pair: StereoPair) -> float:
    points = np.stack(np.meshgrid(*[np.linspace(-4, 4, 5)] * 2, [-1.0, 0.0, 1.0]), -1).reshape(-1, 3)
    found = pair.triangulate(TRUE.cam1.project(points).xy, TRUE.cam2.project(points).xy).xyz_mm
    return float(1e3 * np.sqrt(np.mean((found - points) ** 2)))


@pytest.mark.parametrize(("localiser", "rbe_px", "error_um"), [("profile", 0.0035, 0.1), ("paper", 0.0075, 0.3)])
def test_images_become_a_calibration(
    folder: Path, capsys: pytest.CaptureFixture[str], localiser: str, rbe_px: float, error_um: float
) -> None:
    assert main(command(folder, "--hold-out", "2", "--localiser", localiser)) == 0
    out = capsys.readouterr().out
    assert "verdict: good" in out
    assert "NOT checked: known_distance" in out
    path = folder / "calibration.json"
    content = json.loads(path.read_text())
    assert content["checks"]["held_out"]["rbe_px"] < rbe_px
    assert content["checks"]["held_out"]["positions_mm"] == {"cam1": [2.0], "cam2": [2.0]}
    assert content["provenance"]["localiser"] == localiser
    assert len(content["provenance"]["views_sha256"]) == 6
    # no alignment: the system frame is the grid's, truth and result share it
    assert volume_error_um(load_calibration(path).pair) < error_um


def test_a_toleranced_grid_stays_within_the_band() -> None:
    images = captured(0.004, 3)
    target = dataclasses.replace(PAPER_TARGET, node_tolerance_mm=0.004)
    nominal = (
        NominalValues((512, 480), 12500.0, 410.0, -30.0, 0.9617),
        NominalValues((512, 480), 12500.0, 410.0, 30.0, 0.9617),
    )
    views = [ImageOfTarget(camera, dz, pixels) for (camera, dz), pixels in images.items()]  # type: ignore[arg-type]
    stages: list[tuple[str, int, int]] = []
    options = CalibrationOptions(held_out_mm=(2.0,))
    found = calibrate_views(views, target, nominal, options, progress=lambda *s: stages.append(s))
    assert found.result.held_out is not None
    # against the corrected nodes; the nominal grid's own figure stays what 4 um at 33 um/px make
    assert found.result.held_out.mean.rbe_px < 0.02
    assert 0.06 < found.result.held_out.nominal_mean.rbe_px < 0.11
    assert volume_error_um(found.result.pair) < 1.5
    assert stages[0] == ("grid", 0, 7)
    assert stages[-1] == ("calibration", 7, 7)
    cancel = Cancel()
    cancel.set()
    with pytest.raises(Cancelled):
        calibrate_views(views, target, nominal, options, cancel=cancel)


def drop(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "views" / name).unlink()


def edit(file: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))

    return change


def swap(folder: Path) -> None:
    for path in sorted((folder / "views").iterdir()):
        path.rename(path.with_name("new_" + path.name.replace("cam1", "camX").replace("cam2", "cam1")))
    for path in sorted((folder / "views").iterdir()):
        path.rename(path.with_name(path.name.removeprefix("new_").replace("camX", "cam2")))


def empty(folder: Path) -> None:
    for path in (folder / "views").iterdir():
        path.unlink()


def one_position(folder: Path) -> None:
    for path in (folder / "views").glob("*[25].000mm.tif"):
        path.unlink()


def blank(folder: Path) -> None:
    write_image(folder / "views" / "cam2_+2.000mm.tif", np.full((480, 512), 128, np.uint8))


def small(folder: Path) -> None:
    write_image(folder / "views" / "cam2_+2.000mm.tif", np.full((240, 512), 128, np.uint8))


def damaged(folder: Path) -> None:
    path = folder / "views" / "cam1_+5.000mm.tif"
    path.write_bytes(path.read_bytes()[:5000])


def same_image(folder: Path) -> None:
    data = (folder / "views" / "cam1_+0.000mm.tif").read_bytes()
    for dz in ("+2.000", "+5.000"):
        (folder / "views" / f"cam1_{dz}mm.tif").write_bytes(data)


def micrometres(folder: Path) -> None:
    for path in sorted((folder / "views").iterdir()):
        path.rename(path.with_name(path.name.replace("2.000", "2000").replace("5.000", "5000")))


BAD: list[tuple[str, Callable[[Path], None] | None, list[str], str, str]] = [
    ("missing folder", lambda f: (f / "views").rename(f / "elsewhere") and None, [], "folder_missing", "views"),
    ("no views", empty, [], "views_missing", "no view"),
    ("one camera's view missing", drop("cam2_+2.000mm.tif"), [], "view_missing", "no view of cam2 at +2.000 mm"),
    ("other size", small, [], "image_size_mismatch", "cam2_+2.000mm.tif is 512 x 240 px"),
    ("size in rig", edit("rig.toml", "[512, 480]", "[640, 480]"), [], "image_size_mismatch", "640 x 480"),
    ("swapped", swap, [], "cameras_swapped", "swapped"),
    ("blank", blank, [], "target_not_found", "cam2_+2.000mm.tif"),
    ("one position", one_position, [], "calibration_one_position", "predicted uncertainty"),
    ("same image", same_image, [], "position_wrong", "show no travel"),
    ("micrometres", micrometres, [], "positions_unit", "micrometres"),
    ("hold-out unknown", None, ["--hold-out", "3"], "hold_out_unknown", "+3 mm"),
    ("hold-out negative", None, ["--hold-out", "-2,4"], "hold_out_unknown", "-2 mm"),
    ("hold-out text", None, ["--hold-out", "two"], "hold_out_malformed", "'two'"),
    ("malformed TOML", edit("target.toml", "= 1.0", "= = 1"), [], "toml_malformed", "target.toml"),
    ("NaN", edit("rig.toml", "12500.0", "nan"), [], "field_invalid", "phd_px is nan"),
    ("missing field", edit("target.toml", "lines = [11, 11]\n", ""), [], "field_invalid", "lines is missing"),
    ("wrong line count", edit("target.toml", "[11, 11]", "[12, 11]"), [], "target_line_count", "cam1_+0.000mm.tif"),
    ("unreadable TIFF", damaged, [], "image_unreadable", "cam1_+5.000mm.tif"),
    ("no target file", lambda f: (f / "target.toml").unlink(), [], "file_missing", "target.toml"),
    ("output is a folder", lambda f: (f / "calibration.json").mkdir(), [], "output_unusable", "calibration.json"),
]


@pytest.mark.parametrize(("change", "more", "code", "fragment"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_bad_input_gets_one_line_and_no_file(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Path], None] | None,
    more: list[str],
    code: str,
    fragment: str,
) -> None:
    if change is not None:
        change(folder)
    assert main(command(folder, *more)) == 1
    # progress may come first on a slow machine; the error itself is one line
    *progress, line = capsys.readouterr().err.strip().splitlines()
    assert not any(p.startswith("stereorig:") for p in progress)
    assert line.startswith(f"stereorig: {code}: ")
    assert fragment in line
    assert " Remedy: " in line
    assert not (folder / "calibration.json").is_file()


@pytest.mark.fault(34)
def test_a_calibration_that_failed_its_check_is_not_written(
    folder: Path, capsys: pytest.CaptureFixture[str], exact: dict[tuple[str, float], GrayImage]
) -> None:
    # camera 2 was bumped before the held-out view
    write_image(folder / "views" / "cam2_+2.000mm.tif", np.roll(exact["cam2", 2.0], 1, axis=1))
    assert main(command(folder, "--hold-out", "2")) == 1
    captured = capsys.readouterr()
    assert "verdict: failed" in captured.out
    assert "Worst views: cam2_+2.000mm.tif " in captured.out
    rejected = captured.err.strip().splitlines()[-1]  # progress may come first on a slow machine
    assert rejected.startswith("stereorig: calibration_rejected: ")
    assert "cam2_+2.000mm.tif" in rejected
    assert "within" not in rejected
    assert not (folder / "calibration.json").exists()


@pytest.mark.fault(65)
def test_patterns_name_the_views_of_free_poses_in_pairs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []

    def stop(views: Any, *_: Any, **__: Any) -> None:
        given.extend(views)
        raise InputError("enough", code="field_invalid")

    monkeypatch.setattr(command_line, "calibrate_folder", stop)
    for name in ("left01.jpg", "left02.jpg", "right01.jpg", "right02.jpg"):
        (tmp_path / name).write_bytes(b"")
    files = ["--target", "t", "--rig", "r", "--out", str(tmp_path / "c.json")]
    patterns = ["--cam1", str(tmp_path / "left*.jpg"), "--cam2", str(tmp_path / "right*.jpg")]
    assert main(["calibrate", *patterns, *files]) == 1
    assert [(v.camera, v.frame, v.path.name) for v in given] == [
        ("cam1", 0, "left01.jpg"),
        ("cam1", 1, "left02.jpg"),
        ("cam2", 0, "right01.jpg"),
        ("cam2", 1, "right02.jpg"),
    ]
    (tmp_path / "right02.jpg").unlink()
    for more, code in ((patterns, "counts_differ"), (patterns[:2], "views_missing"), ([], "views_missing")):
        assert main(["calibrate", *more, *files]) == 1
        assert f"stereorig: {code}: " in capsys.readouterr().err
