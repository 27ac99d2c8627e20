"""TARGET.toml, RIG.toml, folders of views and calibration.json."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.calibration import COVARIANCE_NAMES, calibrate
from stereorig.core.errors import FileFormatError, InputError
from stereorig.core.target import GridTarget
from stereorig.server.formats.calibrations.native import covariance_in, write_calibration
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.calibrations.target_toml import read_rig, read_target
from stereorig.server.formats.calibrations.views import find_views
from tests.support.calibration_truth import HELD, NOMINAL, Grid, make_views
from tests.support.requirements import ROOT

TARGET = "pitch_mm = 1.0\nlines = [11, 11]\nline_width_mm = 0.03\nnode_tolerance_mm = 0.004\ndark_lines = true\n"
PAPER_PAIR = calibrate(make_views(), Grid(), NOMINAL, HELD).pair
CAMERA = "image_size_px = [512, 480]\nphd_px = 12000\nstandoff_mm = 400.0\nangle_deg = -30\naspect = 0.9617\n"
RIG = f"[rig]\nname = 'x'\n[cam1]\n{CAMERA}driver = 'sim'\n[cam2]\n{CAMERA}"


def put(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def test_target_at_top_level_and_in_a_table(tmp_path: Path) -> None:
    expected = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03, node_tolerance_mm=0.004, dark_lines=True)
    assert read_target(put(tmp_path, "a.toml", TARGET)) == expected
    assert read_target(put(tmp_path, "b.toml", f"[rig]\nname='r'\n[target]\n{TARGET}")) == expected


@pytest.mark.parametrize(
    ("text", "code", "fragment"),
    [
        (TARGET.replace("pitch_mm = 1.0", ""), "field_invalid", "pitch_mm is missing"),
        (TARGET.replace("= 1.0", "= nan"), "field_invalid", "pitch_mm is nan"),
        (TARGET.replace("= 1.0", "= -1"), "field_invalid", "pitch_mm is -1, not positive"),
        (TARGET.replace("= 1.0", "= '1'"), "field_invalid", "pitch_mm is '1', not a number"),
        (TARGET.replace("[11, 11]", "11"), "field_invalid", "lines is 11"),
        (TARGET.replace("[11, 11]", "[11, 3]"), "field_invalid", "at least 5 lines"),
        (TARGET.replace("0.03", "inf"), "field_invalid", "line_width_mm is inf"),
        (TARGET.replace("0.03", "0.8"), "field_invalid", "line_width_mm must lie"),
        (TARGET.replace("true", "'yes'"), "field_invalid", "dark_lines is 'yes'"),
        (TARGET.replace("= 0.004", "= -0.004"), "field_invalid", "node_tolerance_mm is -0.004, negative"),
        ("pitch_mm = = 1", "toml_malformed", "no valid TOML"),
    ],
)
def test_a_bad_target_is_refused_by_field(tmp_path: Path, text: str, code: str, fragment: str) -> None:
    with pytest.raises(FileFormatError, match=r"target\.toml") as caught:
        read_target(put(tmp_path, "target.toml", text))
    assert caught.value.code == code
    assert fragment in caught.value.cause
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "code", "fragment"),
    [
        (RIG.split("[cam2]")[0], "field_invalid", "[cam2] is missing"),
        (RIG.replace("aspect = 0.9617", "", 1), "field_invalid", "[cam1]: aspect is missing"),
        (RIG.replace("512, 480", "512", 1), "field_invalid", "image_size_px is [512]"),
        (RIG.replace("400.0", "0", 1), "field_invalid", "standoff_mm is 0, not positive"),
        (RIG.replace("-30", "-95", 1), "field_invalid", "angle_deg is -95"),
        (RIG.replace("12000", "true", 1), "field_invalid", "phd_px is True"),
        ("cam1 = 3", "field_invalid", "[cam1] is not a table"),
    ],
)
def test_a_bad_rig_is_refused_by_field(tmp_path: Path, text: str, code: str, fragment: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        read_rig(put(tmp_path, "rig.toml", text))
    assert caught.value.code == code
    assert fragment in caught.value.cause


def test_a_rig_file_of_the_service_serves_as_well(tmp_path: Path) -> None:
    rig = read_rig(put(tmp_path, "rig.toml", RIG + "[calibration]\naxis_tilt_sigma_rad = 0.001\n"))
    assert rig.cam1.image_size_px == (512, 480)
    assert rig.axis_tilt_sigma_rad == 0.001
    assert read_rig(ROOT / "config" / "sim_paper.toml").cam2.angle_deg == 30.0
    with pytest.raises(FileFormatError) as caught:
        read_rig(tmp_path / "none.toml")
    assert caught.value.code == "file_missing"


def test_views_carry_their_position_in_the_name(tmp_path: Path) -> None:
    for name in ("cam1_+0.000mm.tif", "cam2_0mm.png", "cam1_-2.5mm.TIFF", "cam2_-2.500mm.tif", "notes.txt", "cam1.tif"):
        put(tmp_path, name, "")
    assert [(v.camera, v.dz_mm) for v in find_views(tmp_path)] == [
        ("cam1", -2.5),
        ("cam1", 0.0),
        ("cam2", -2.5),
        ("cam2", 0.0),
    ]


@pytest.mark.parametrize(
    ("names", "code"),
    [
        (["notes.txt"], "views_missing"),
        (["cam1_+0.000mm.tif", "cam2_+0.000mm.tif", "cam1_+5.000mm.tif"], "view_missing"),
        (["cam1_+0.000mm.tif"], "view_missing"),
        (["cam2_+0.000mm.tif"], "view_missing"),
        (["cam1_+0.000mm.tif", "cam1_0mm.tif", "cam2_0mm.tif"], "view_duplicate"),
    ],
)
def test_an_odd_folder_of_views_is_refused(tmp_path: Path, names: list[str], code: str) -> None:
    for name in names:
        put(tmp_path, name, "")
    with pytest.raises(InputError) as caught:
        find_views(tmp_path)
    assert caught.value.code == code


@pytest.mark.fault(65)
def test_views_may_be_of_any_image_format_and_another_ending_is_named(tmp_path: Path) -> None:
    for name in ("cam1_000.jpg", "cam2_000.JPEG", "cam1_001.BMP", "cam2_001.Tif", "cam1_002.png"):
        put(tmp_path, name, "")
    assert [v.path.suffix for v in find_views(tmp_path)] == [".jpg", ".BMP", ".png", ".JPEG", ".Tif"]
    other = tmp_path / "other"
    other.mkdir()
    for name in ("cam1_000.gif", "cam2_000.gif"):
        put(other, name, "")
    with pytest.raises(InputError, match=r"no view\. cam1_000\.gif and 1 more cannot be read by the ending"):
        find_views(other)


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none", put(tmp_path, "file", "")):
        with pytest.raises(InputError) as caught:
            find_views(path)
        assert caught.value.code == "folder_missing"


def test_calibration_json_holds_what_its_readers_need(tmp_path: Path) -> None:
    target = GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03)
    result = calibrate(make_views(), target, NOMINAL, replace(HELD, aspect_sigma=0.0))
    path = tmp_path / "calibration.json"
    write_calibration(path, result, target, provenance={"localiser": "profile"})
    content = json.loads(path.read_text())
    eleven = {
        "phd_px",
        "cx_px",
        "cy_px",
        "kappa_per_px2",
        "aspect",
        "alpha_rad",
        "beta_rad",
        "gamma_rad",
        "x0_mm",
        "y0_mm",
        "z0_mm",
    }
    for cam in ("cam1", "cam2"):
        assert set(content[cam]) == eleven
    for part in ("fitted", "held_out"):
        check = content["checks"][part]
        assert {"rbe_px", "raz_mm", "nsce", "per_camera"} <= set(check)
        for key in ("rbe_px", "raz_mm", "nsce"):
            mean = np.mean([check["per_camera"][c][key] for c in ("cam1", "cam2")])
            assert check[key] == pytest.approx(mean, rel=1e-12)
    assert content["verdict"]["level"] == "good"
    assert content["verdict"]["reasons"]
    names = content["covariance"]["names"]
    ten = ("phd_px", "cx_px", "cy_px", "kappa_per_px2", "alpha_rad", "beta_rad", "gamma_rad", "x0_mm", "y0_mm", "z0_mm")
    assert names == [f"{c}.{n}" for c in ("cam1", "cam2") for n in ten]

    loaded = load_calibration(path)
    for a, b in ((loaded.pair.cam1, result.pair.cam1), (loaded.pair.cam2, result.pair.cam2)):
        assert a.paper_parameters() == pytest.approx(b.paper_parameters(), rel=1e-14)
    assert loaded.image_size1_px == loaded.image_size2_px == (512, 480)
    found = covariance_in(loaded.details, name=str(path), pair=loaded.pair)
    assert found is not None
    assert found[0] == COVARIANCE_NAMES
    back = found[1]
    np.testing.assert_allclose(back, result.covariance, rtol=1e-14)

    shuffled = {"names": names[::-1], "matrix": np.asarray(content["covariance"]["matrix"])[::-1, ::-1].tolist()}
    again = covariance_in({"covariance": shuffled}, name="x", pair=loaded.pair)
    assert again is not None
    np.testing.assert_array_equal(again[1], back)
    assert covariance_in({}, name="x", pair=loaded.pair) is None
    assert len(COVARIANCE_NAMES) == 20


@pytest.mark.parametrize(
    "covariance",
    [
        3,
        {"names": ["a"], "matrix": [[1.0]]},
        {"names": list(COVARIANCE_NAMES), "matrix": [[1.0]]},
        {"names": list(COVARIANCE_NAMES), "matrix": [["x"] * 20] * 20},
        {"names": list(COVARIANCE_NAMES), "matrix": [[float("nan")] * 20] * 20},
    ],
)
def test_a_damaged_covariance_is_refused(covariance: object) -> None:
    with pytest.raises(FileFormatError, match="covariance in x"):
        covariance_in({"covariance": covariance}, name="x", pair=PAPER_PAIR)


def test_eleven_numbers_a_camera_are_enough(tmp_path: Path) -> None:
    result = calibrate(make_views(), GridTarget(pitch_mm=1.0, lines=(11, 11), line_width_mm=0.03), NOMINAL, HELD)
    small = {"cam1": result.pair.cam1.paper_parameters(), "cam2": result.pair.cam2.paper_parameters()}
    loaded = load_calibration(put(tmp_path, "small.json", json.dumps(small)))
    assert loaded.pair.cam2.paper_parameters() == pytest.approx(small["cam2"], rel=1e-14)
    assert loaded.image_size1_px is None
