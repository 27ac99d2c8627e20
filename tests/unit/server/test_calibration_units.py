"""OpenCV's calibrations under every usual name and unit of length, and VIC-3D's with elements side by side."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import xarray

from stereorig.core.errors import FileFormatError, InputError
from stereorig.server.cli import main
from stereorig.server.formats.calibrations.export import convert_calibration
from stereorig.server.formats.calibrations.programs.plausibility import check_calibration, length_warning
from stereorig.server.formats.calibrations.recognise import (
    LoadedCalibration,
    imported_content,
    load_calibration,
    parse_calibration,
)
from tests.support.copied_tests import write_test_folder

K1 = np.array([[1425.4, 0.0, 639.5], [0.0, 1425.1, 337.1], [0.0, 0.0, 1.0]])
K2 = np.array([[1425.7, 0.0, 653.0], [0.0, 1425.7, 352.6], [0.0, 0.0, 1.0]])
D1, D2 = np.array([[-0.0708, 0.575, 7.6e-4, -1.96e-3, -1.15]]), np.array([[-0.004, 1.13, 8e-4, 1.3e-3, -4.3]])
R = cv2.Rodrigues(np.array([0.004, 0.35, 0.007]))[0]  # the axes meet about 220 mm away
T = np.array([[-80.1], [2.1], [5.04]])
LENSES, POSE = {"M1": K1, "D1": D1, "M2": K2, "D2": D2}, {"R": R, "T": T}
OTHER = {"R1": np.eye(3), "R2": np.eye(3), "P1": np.eye(3, 4), "P2": np.eye(3, 4), "Q": np.eye(4)}


def written(path: Path, values: dict[str, np.ndarray]) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


def in_units(folder: Path, scale: float, rotation: np.ndarray = R) -> Path:
    return written(folder / f"t{scale:g}.yml", LENSES | {"R": rotation, "T": scale * T})


def is_the_pair(loaded: LoadedCalibration) -> None:
    np.testing.assert_allclose(loaded.pair.cam2.cam_from_sys.translation_mm, T[:, 0], rtol=1e-12)
    lens = loaded.pair.cam2.lens
    assert (lens.fx_px, lens.cy_px, lens.k3) == (1425.7, 352.6, -4.3)  # type: ignore[union-attr]


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
@pytest.mark.parametrize(
    "names",
    ["M1 D1 M2 D2 R T", "K1 D1 K2 D2 R T", "KL DL KR DR R T", "K_left D_left K_right D_right R T",
     "mtx_left dist_left mtx_right dist_right R T", "cameraMatrixL distCoeffsL cameraMatrixR distCoeffsR R T",
     "left_camera_matrix left_distortion_coefficients right_camera_matrix right_distortion_coefficients Rotation "
     "Translation", "camera_matrix_1 dist_coeffs_1 camera_matrix_2 dist_coeffs_2 R T"],
)  # fmt: skip
def test_a_pair_is_read_under_the_names_of_opencvs_sample_and_its_twins(
    tmp_path: Path, names: str, ending: str
) -> None:
    values = dict(zip(names.split(), (K1, D1, K2, D2, R, T), strict=True))
    is_the_pair(load_calibration(written(tmp_path / f"stereo.{ending}", values | OTHER)))


def test_a_lens_term_k1_is_no_matrix_and_two_values_of_one_entry_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.yml", LENSES | POSE)
    path.write_text(path.read_text() + "k1: 0.5\nd1: 2.0\n")
    is_the_pair(load_calibration(path))
    with pytest.raises(FileFormatError, match="two values of cameraMatrix1"):
        load_calibration(written(tmp_path / "b.yml", LENSES | POSE | {"K1": K2}))


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_either_of_opencvs_two_files_is_read_with_the_other_beside_it_or_appended(tmp_path: Path, ending: str) -> None:
    inner = written(tmp_path / f"Intrinsics.{ending}", LENSES)
    outer = written(tmp_path / f"extrinsics.{ending}", POSE | OTHER)
    for path in (inner, outer):
        is_the_pair(load_calibration(path))
    if ending != "json":
        is_the_pair(parse_calibration(inner.read_bytes() + outer.read_bytes(), name="both"))
    assert main(["calibration", "convert", str(outer), str(tmp_path / "c.json"), "--to", "json"]) == 0
    for path in (inner, outer):  # each by itself now
        (tmp_path / path.stem).mkdir()
        path.rename(tmp_path / path.stem / path.name)
    for name, has, lacks in (("Intrinsics", "M1 D1 M2 D2", "R T"), ("extrinsics", "R T", "M1 D1 M2 D2")):
        with pytest.raises(FileFormatError) as caught:
            load_calibration(tmp_path / name / f"{name}.{ending}")
        assert f"has {has}; {lacks} are in the other" in caught.value.cause
        assert "Append" in caught.value.remedy
    is_the_pair(load_calibration(tmp_path / "c.json"))  # holds both


@pytest.mark.parametrize(
    ("scale", "likely"),
    [(1e-3, "in metres"), (1e3, "in micrometres"), (1 / 30.0, "squares of the board"), (0.1, "centimetres"),
     (1 / 25.4, "inches"), (0.02, "metres?")],
)  # fmt: skip
def test_lengths_that_no_two_cameras_have_are_asked_about(tmp_path: Path, scale: float, likely: str) -> None:
    loaded = load_calibration(in_units(tmp_path, scale))
    asked = length_warning(loaded)
    assert asked is not None
    assert likely in asked
    assert f"baseline of {loaded.pair.baseline_mm:.3g} mm" in asked
    assert asked in check_calibration(loaded).warnings


def test_usual_lengths_and_stated_ones_are_not_asked_about(tmp_path: Path) -> None:
    parallel = cv2.Rodrigues(np.array([0.0, 1e-4, 0.0]))[0]  # the axes meet 800 m away, by chance
    assert length_warning(load_calibration(in_units(tmp_path, 1.0))) is None
    assert length_warning(load_calibration(in_units(tmp_path, 1.0, parallel))) is None
    assert length_warning(load_calibration(in_units(tmp_path, 0.03, parallel))) is not None
    assert length_warning(load_calibration(in_units(tmp_path, 0.03), unit="mm")) is None


@pytest.mark.parametrize(
    ("scale", "unit"), [(1e-3, "m"), (0.1, "cm"), (1 / 25.4, "in"), (1e3, "um"), (1 / 30.0, "30 mm"), (1 / 30.0, "3cm")]
)
def test_a_stated_unit_is_used_kept_and_carried_into_other_forms(tmp_path: Path, scale: float, unit: str) -> None:
    path = in_units(tmp_path, scale)
    loaded = load_calibration(path, unit=unit)
    is_the_pair(loaded)
    assert length_warning(loaded) is None
    kept = json.dumps(imported_content(path.read_bytes(), name="a", unit=unit)).encode()
    is_the_pair(parse_calibration(kept, name="a"))
    is_the_pair(parse_calibration(kept, name="a", unit=unit))
    with pytest.raises(InputError, match="was given") as caught:
        parse_calibration(kept, name="a", unit="mm")
    assert caught.value.code == "calibration_unit_conflict"
    for form in ("json", "opencv", "dice", "matchid"):
        made = convert_calibration(loaded, form, path.read_bytes()).data
        baseline = parse_calibration(made, name=form).pair.baseline_mm
        np.testing.assert_allclose(baseline, np.linalg.norm(T), rtol=1e-6)


@pytest.mark.parametrize("unit", ["furlong", "", "0 mm", "-1 mm", "nan mm", "1e mm", "12", "1 mm mm"])
def test_a_unit_that_is_no_length_is_refused(tmp_path: Path, unit: str) -> None:
    with pytest.raises(InputError) as caught:
        load_calibration(in_units(tmp_path, 1.0), unit=unit)
    assert caught.value.code == "calibration_unit_unknown"


@pytest.mark.parametrize(
    ("said", "scale", "unit"), [("unit: cm", 0.1, "cm"), ("length_unit: meters", 1e-3, "m"), ("units: mm", 1.0, "mm")]
)
def test_a_unit_that_the_file_states_is_taken(tmp_path: Path, said: str, scale: float, unit: str) -> None:
    path = in_units(tmp_path, scale)
    path.write_text(f"{path.read_text()}{said}\n")
    for loaded in (load_calibration(path), load_calibration(path, unit=unit)):
        is_the_pair(loaded)
        assert loaded.unit == unit
    again = parse_calibration(json.dumps(imported_content(path.read_bytes(), name="a")).encode(), name="b")
    is_the_pair(again)
    with pytest.raises(InputError, match=f"in {unit}, but in was given") as refused:
        load_calibration(path, unit="in")
    assert refused.value.code == "calibration_unit_conflict"


@pytest.mark.parametrize(
    ("said", "code"),
    [
        ("T: [1, 2, 3]", "calibration_unreadable"),
        ("---\nT: [1, 2, 3]", "calibration_unreadable"),
        ("model: fisheye", "calibration_unsupported"),
        ("distortion_model: equidistant", "calibration_unsupported"),
        ("fisheye: 1", "calibration_unsupported"),
        ("model: plumb_bob", None),
        ("fisheye: 0", None),
    ],
)
def test_two_values_of_an_entry_and_a_lens_of_other_terms_are_refused(
    tmp_path: Path, said: str, code: str | None
) -> None:
    path = in_units(tmp_path, 1.0)
    path.write_text(f"{path.read_text()}{said}\n")
    if code is None:
        is_the_pair(load_calibration(path))
        return
    with pytest.raises(FileFormatError) as refused:
        load_calibration(path)
    assert refused.value.code == code


@pytest.mark.parametrize(("old", "new"), [("[mm]", "[m]"), ("[mm]", "[in]"), ("[deg]", "[rad]"), ("[deg]", "[°]")])
def test_a_caldat_in_other_units_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = in_units(tmp_path, 1.0)
    text = convert_calibration(load_calibration(path), "matchid", path.read_bytes()).data.decode()
    assert old in text
    if new == "[°]":
        assert parse_calibration(text.replace(old, new).encode(), name="a").source == "matchid_caldat"
        return
    with pytest.raises(FileFormatError, match=f"in {new[1:-1]}, not in mm or deg"):
        parse_calibration(text.replace(old, new).encode(), name="a")


def test_a_calibration_of_this_program_has_its_unit_already(tmp_path: Path) -> None:
    write_test_folder(tmp_path / "t", 1)
    own = tmp_path / "t" / "calibration.json"
    assert load_calibration(own, unit="mm").pair.baseline_mm == load_calibration(own).pair.baseline_mm
    with pytest.raises(InputError, match="in mm, but m was given"):
        load_calibration(own, unit="m")


def test_measure_asks_for_the_unit_once_and_measures_in_a_stated_one(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_test_folder(tmp_path / "t", 2, load_a_step=300.0)
    loaded = load_calibration(tmp_path / "t" / "calibration.json")
    made = convert_calibration(loaded, "opencv", (tmp_path / "t" / "calibration.json").read_bytes()).data
    (tmp_path / "mm.yml").write_bytes(made)
    pair = parse_calibration(made, name="a").pair.cam2.cam_from_sys
    storage = cv2.FileStorage(made.decode(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    values = {
        name: storage.getNode(name).mat() for name in ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2")
    }
    written(tmp_path / "m.yml", values | {"R": pair.rotation, "T": 1e-3 * pair.translation_mm[:, None]})
    z = {}
    for name, more in (("mm.yml", []), ("m.yml", ["--unit", "m"]), ("m.yml", [])):
        out = tmp_path / f"{name}{len(more)}"
        arguments = ["--roi", "60,60,90,90", "--subset", "21", "--strain", "off", "--out", str(out)]
        assert main(["measure", str(tmp_path / "t"), "--calibration", str(tmp_path / name), *arguments, *more]) == 0
        said = capfd.readouterr().err
        assert said.count("the unit of T is not stated") == (not more and name == "m.yml")
        with xarray.open_dataset(out / "step_0001.nc") as data:
            z[out.name] = np.array(data["z_mm"])
    np.testing.assert_allclose(z["m.yml2"], z["mm.yml0"], rtol=1e-5)
    # the file alone does not state the unit: what was measured with lies beside the results
    summary = json.loads((tmp_path / "m.yml2" / "summary.json").read_text())
    again = load_calibration(tmp_path / "m.yml2" / "calibration_used.json")
    assert (summary["calibration"]["sha256"], again.unit) == (again.sha256, "m")
    assert not (tmp_path / "mm.yml0" / "calibration_used.json").exists()


CAMERAS = """<calibration lri="calibration" >
  <camera id="0" >640.25 402.5 2450.1 2452.3 1.25 0.051 0 0
    <orientation>-179.9 -14.2 0.45 1210.5 4.25 980.75</orientation>
  </camera>
  <camera id="1" >655.5 398.75 2461.4 2463.9 0.75 0.048 0 0
    <orientation>179.8 14.6 -0.55 -1190.25 -21.5 1040.5</orientation>
  </camera>
</calibration>
"""
MASK = '<polygonmask width="1280" height="800" lri="polygonmask">\n</polygonmask>\n'


@pytest.mark.parametrize("head", ["", "\ufeff", '<?xml version="1.0"?>\n<!-- saved -->\n', "<!DOCTYPE vpml >\n"])
@pytest.mark.parametrize("order", [(CAMERAS, MASK), (MASK, CAMERAS), (CAMERAS, MASK, "<notes>a</notes>")])
def test_vic3ds_elements_side_by_side_are_read_as_in_one(head: str, order: tuple[str, ...]) -> None:
    whole = parse_calibration(f"<project>{CAMERAS}{MASK}</project>".encode(), name="whole")
    found = parse_calibration((head + "".join(order)).encode(), name="pair.xml")
    assert found.image_size1_px == found.image_size2_px == whole.image_size1_px == (1280, 800)
    np.testing.assert_allclose(found.pair.baseline_mm, whole.pair.baseline_mm, rtol=1e-12)
    kept = json.dumps(imported_content((head + "".join(order)).encode(), name="pair.xml")).encode()
    assert parse_calibration(kept, name="kept").pair.baseline_mm == found.pair.baseline_mm


@pytest.mark.parametrize("text", [CAMERAS[:-5], CAMERAS + "<polygonmask", CAMERAS + "</project>", CAMERAS + CAMERAS])
def test_vic3ds_elements_that_are_cut_or_twice_there_are_refused(text: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        parse_calibration(text.encode(), name="pair.xml")
    assert caught.value.code == "calibration_unreadable"
