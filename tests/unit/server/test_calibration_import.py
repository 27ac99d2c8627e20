"""Imported calibrations project as OpenCV does with the same numbers; doubtful files are refused with the reason."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import OpenCVLens
from stereorig.core.cameras.opencv_full import opencv_lens_of
from stereorig.core.errors import CalibrationError, FileFormatError
from stereorig.server.formats.calibrations.export import convert_calibration
from stereorig.server.formats.calibrations.programs.plausibility import check_calibration
from stereorig.server.formats.calibrations.recognise import (
    LoadedCalibration,
    imported_content,
    load_calibration,
    parse_calibration,
)
from stereorig.server.report.geometry import geometry_of_cameras

K1 = np.array([[6638.6, 0.0, 981.5], [0.0, 6639.8, 610.0], [0.0, 0.0, 1.0]])
K2 = np.array([[6644.7, 0.0, 1005.4], [0.0, 6644.1, 567.3], [0.0, 0.0, 1.0]])
D1, D2 = np.array([0.0889, -2.84, 1e-3, -2e-3, 55.9]), np.array([0.061, 2.03, -1e-3, 5e-4, -120.6])
R = cv2.Rodrigues(np.array([0.004, -0.33, 0.007]))[0]
T = np.array([121.4, 0.574, 23.19])
POINTS = np.random.default_rng(1).uniform([-40, -20, 380], [40, 20, 400], (40, 3))


def opencv_file(path: Path, **changes: object) -> Path:
    values: dict[str, object] = {
        "cameraMatrix1": K1,
        "distCoeffs1": D1,
        "cameraMatrix2": K2,
        "distCoeffs2": D2,
        "R": R,
        "T": T[:, None],
    }
    values.update(changes)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.startWriteStruct("imageSize", cv2.FILE_NODE_SEQ)
    storage.write("", 1920)
    storage.write("", 1200)
    storage.endWriteStruct()
    for key, value in values.items():
        if value is not None:
            storage.write(key, value)
    storage.release()
    return path


def check_against_opencv(loaded: LoadedCalibration, d1: np.ndarray = D1, d2: np.ndarray = D2) -> None:
    for camera, K, d, rvec, tvec in (
        (loaded.pair.cam1, K1, d1, np.zeros(3), np.zeros(3)),
        (loaded.pair.cam2, K2, d2, cv2.Rodrigues(R)[0], T),
    ):
        theirs = cv2.projectPoints(POINTS, rvec, tvec, K, d)[0][:, 0]
        np.testing.assert_allclose(camera.project(POINTS).xy, theirs, atol=1e-6)


def refused(path: Path) -> FileFormatError:
    with pytest.raises(FileFormatError) as caught:
        load_calibration(path)
    assert str(path) in caught.value.cause
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("ending", ["yml", "json", "xml"])
def test_opencv_storage_of_every_kind(tmp_path: Path, ending: str) -> None:
    loaded = load_calibration(opencv_file(tmp_path / f"stereo.{ending}"))
    check_against_opencv(loaded)
    assert loaded.source == "opencv_yaml"
    assert loaded.image_size1_px == loaded.image_size2_px == (1920, 1200)
    np.testing.assert_array_equal(loaded.pair.cam1.cam_from_sys.rotation, np.eye(3))


@pytest.mark.parametrize("head", ["", "---\n", "%YAML:1.0\n---\n"])
def test_plain_yaml_lists(tmp_path: Path, head: str) -> None:
    lines = [f"cameraMatrix{i}: {K.tolist()}\ndistCoeffs{i}: {d.tolist()}" for i, K, d in ((1, K1, D1), (2, K2, D2))]
    text = head + "\n".join([*lines, f"R: {R.tolist()}", f"T: {T.tolist()}", "imageSize: [1920, 1200]"]) + "\n"
    (tmp_path / "a.yaml").write_text(text)
    check_against_opencv(load_calibration(tmp_path / "a.yaml"))


@pytest.mark.parametrize("head", ["", "%YAML:1.0\n---\n"])
@pytest.mark.parametrize("flow", [None, False, True])
@pytest.mark.parametrize("form", ["lists", "matrices", "matrices without a type"])
def test_yaml_as_pyyaml_writes_it(tmp_path: Path, head: str, flow: bool | None, form: str) -> None:
    content: dict[str, object] = {"imageSize": [1920, 1200]}
    values = {"cameraMatrix1": K1, "distCoeffs1": D1, "cameraMatrix2": K2, "distCoeffs2": D2, "R": R, "T": T}
    for key, value in values.items():
        matrix = np.atleast_2d(value)
        as_map = {"rows": matrix.shape[0], "cols": matrix.shape[1], "dt": "d", "data": matrix.ravel().tolist()}
        if form == "matrices without a type":
            del as_map["dt"]
        content[key] = value.tolist() if form == "lists" else as_map
    (tmp_path / "a.yaml").write_text(head + yaml.dump(content, default_flow_style=flow))
    loaded = load_calibration(tmp_path / "a.yaml")
    check_against_opencv(loaded)
    assert loaded.image_size2_px == (1920, 1200)


def test_yaml_bombs_and_objects_are_refused(tmp_path: Path) -> None:
    rows = "\n".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 30))
    bomb = f"a0: &a0 [1, 1]\n{rows}\ncameraMatrix1: *a29\n"
    for k, text in enumerate((bomb, "cameraMatrix1: !!python/object/apply:os.getcwd []\n")):
        path = tmp_path / f"{k}.yaml"
        path.write_text(text)
        assert refused(path).code == "calibration_unreadable"


@pytest.mark.parametrize("length", [4, 5, 8, 12, 14])
def test_coefficient_vectors_of_every_length(tmp_path: Path, length: int) -> None:
    d1, d2 = (np.concatenate([d, np.zeros(9)])[:length] for d in (D1, D2))
    loaded = load_calibration(opencv_file(tmp_path / "a.yml", distCoeffs1=d1, distCoeffs2=d2[None]))
    check_against_opencv(loaded, d1, d2)
    if length >= 8:  # k4, k5, k6
        d2[5:8] = 0.8, -2.0, 30.0
        rational = load_calibration(opencv_file(tmp_path / "b.yml", distCoeffs1=d1, distCoeffs2=d2))
        check_against_opencv(rational, d1, d2)
        assert check_calibration(rational).volume.max_px < 1e-9


@pytest.mark.parametrize(
    ("place", "term"), [(8, "s1"), (9, "s2"), (10, "s3"), (11, "s4"), (12, "tau_x_rad"), (13, "tau_y_rad")]
)
def test_thin_prism_and_tilt_are_kept_in_all_forms_that_have_them(tmp_path: Path, place: int, term: str) -> None:
    d2 = np.zeros(12 if place < 12 else 14)
    d2[:5], d2[place] = D2, 0.01
    loaded = load_calibration(opencv_file(tmp_path / "a.yml", distCoeffs2=d2))
    check_against_opencv(loaded, d2=d2)
    assert check_calibration(loaded).volume.max_px < 1e-9
    assert not hasattr(loaded.pair.cam1.lens, term)
    for form in ("opencv", "json"):
        made = convert_calibration(loaded, form, (tmp_path / "a.yml").read_bytes())
        again = parse_calibration(made.data, name="again")
        check_against_opencv(again, d2=d2)
        assert made.report.exact
        assert made.report.read_back.max_px < 1e-9
    lens = again.pair.cam2.lens
    own = {key: getattr(lens, key) for key in lens.parameter_names}
    assert opencv_lens_of(own) == lens
    for form in ("paper", "dice", "matchid", "vic3d"):
        with pytest.raises(CalibrationError, match=f"cam2 has {term} = 0.01") as caught:
            convert_calibration(loaded, form, b"")
        assert caught.value.code == "lens_not_held"


@pytest.mark.parametrize(
    ("changes", "code", "word"),
    [
        ({"T": None}, "calibration_unreadable", "T is missing"),
        ({"cameraMatrix2": K1[:2]}, "calibration_unreadable", "cameraMatrix2"),
        ({"distCoeffs1": D1[:3]}, "calibration_unreadable", "distCoeffs1"),
        ({"R": np.full((3, 3), np.nan)}, "calibration_invalid", "R"),
        ({"cameraMatrix1": np.where(K1 == 981.5, np.inf, K1)}, "calibration_invalid", "cameraMatrix1"),
        ({"R": R * 1.01}, "calibration_invalid", "rotation"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "calibration_invalid", "rotation"),
        ({"T": np.zeros(3)}, "calibration_invalid", "same position"),
        ({"T": np.array([1.0, np.nan, 0.0])}, "calibration_invalid", "T"),
        ({"cameraMatrix1": np.diag([-5.0, 5.0, 1.0])}, "calibration_invalid", "fx"),
        ({"cameraMatrix1": K1.T}, "calibration_invalid", "form"),
        ({"T": "here"}, "calibration_unreadable", "T is not"),
    ],
)
def test_opencv_files_that_are_refused(tmp_path: Path, changes: dict[str, object], code: str, word: str) -> None:
    with np.errstate(invalid="ignore"):
        error = refused(opencv_file(tmp_path / "a.yml", **changes))
    assert error.code == code
    assert word in error.cause


def test_damaged_and_foreign_files(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = opencv_file(tmp_path / "a.yml").read_bytes()
    foreign = (b"", b"{", b"hello", b"[1]", b'{"a": 1}', b'{"cam1": {}}', b'{"cam1": 3, "cam2": 4}')
    damaged = (whole[: len(whole) // 2], b"\xff\xfe\x00cameraMatrix1", b"<ParameterList name='CAMERA'><x>")
    for i, data in enumerate((*foreign, *damaged)):
        path = tmp_path / f"{i}.yml"
        path.write_bytes(data)
        assert refused(path).code == "calibration_unreadable", data
    assert refused(tmp_path / "none.json").code == "file_missing"
    assert refused(tmp_path).code == "calibration_unreadable"
    assert capfd.readouterr().err == ""


DICE_CAMERA = """<ParameterList name="CAMERA {i}">
<Parameter name="CX" type="double" value="{K[0][2]}"/><Parameter name="CY" type="double" value="{K[1][2]}"/>
<Parameter name="FX" type="double" value="{K[0][0]}"/><Parameter name="FY" type="double" value="{K[1][1]}"/>
<Parameter name="K1" type="double" value="{d[0]}"/><Parameter name="K2" type="double" value="{d[1]}"/>
<Parameter name="P1" type="double" value="{d[2]}"/><Parameter name="P2" type="double" value="{d[3]}"/>
<Parameter name="K3" type="double" value="{d[4]}"/>
<Parameter name="LENS_DISTORTION_MODEL" type="string" value="OPENCV_LENS_DISTORTION"/>
<Parameter name="TX" type="double" value="{t[0]}"/><Parameter name="TY" type="double" value="{t[1]}"/>
<Parameter name="TZ" type="double" value="{t[2]}"/>{extra}
{rotation}</ParameterList>"""


def matrix(r: np.ndarray) -> str:
    rows = "".join(
        f'<Parameter name="ROW {i}" type="string" value="{{ {a[0]!r}, {a[1]!r}, {a[2]!r} }}"/>'
        for i, a in enumerate(r.tolist())
    )
    return f'<ParameterList name="rotation_3x3_matrix">{rows}</ParameterList>'


def dice_text(
    *,
    relative: str | None = "true",
    r1: np.ndarray | None = None,
    t1: np.ndarray | None = None,
    rotation: str | None = None,
    translation: np.ndarray = T,
    extra: str = "",
) -> str:
    flag = (
        ""
        if relative is None
        else (f'<Parameter name="extrinsics_relative_camera_to_camera" type="bool" value="{relative}"/>')
    )
    cam0 = DICE_CAMERA.format(
        i=0,
        K=K1.tolist(),
        d=D1.tolist(),
        t=[0, 0, 0] if t1 is None else t1.tolist(),
        rotation="" if r1 is None else matrix(r1),
        extra="",
    )
    cam1 = DICE_CAMERA.format(
        i=1,
        K=K2.tolist(),
        d=D2.tolist(),
        t=translation.tolist(),
        rotation=matrix(R) if rotation is None else rotation,
        extra=extra,
    )
    return f"""<ParameterList><!-- DICe -->
<Parameter name="xml_file_format" type="string" value="DICe_xml_camera_system_file"/>
<Parameter name="system_type_3D" type="string" value="OPENCV"/>{flag}{cam0}{cam1}</ParameterList>"""


def load_text(text: str) -> LoadedCalibration:
    return parse_calibration(text.encode(), name="a.xml")


def test_dice_pair_projects_as_opencv() -> None:
    loaded = load_text(dice_text())
    assert loaded.source == "dice_xml"
    check_against_opencv(loaded)


@pytest.mark.parametrize("relative", [None, "false"])
def test_dice_cameras_placed_in_the_world(relative: str | None) -> None:
    check_against_opencv(load_text(dice_text(relative=relative)))
    r1, t1 = cv2.Rodrigues(np.array([0.3, 0.1, -0.2]))[0], np.array([5.0, -3.0, 300.0])
    # world -> cam 1 is (R, T) after world -> cam 0
    moved = dice_text(relative=relative, r1=r1, t1=t1, rotation=matrix(R @ r1), translation=R @ t1 + T)
    check_against_opencv(load_text(moved))


def test_two_poses_of_one_position_are_refused_though_rounding_leaves_a_length() -> None:
    """Cameras in one place, turned against each other: composed, their poses leave 1e-14 mm."""
    turns = [cv2.Rodrigues(np.array(v))[0] for v in ([0.3, 0.1, -0.2], [0.31, -0.25, 0.4])]
    centre = np.array([12.3, -45.6, 789.1])
    first, second = (-turn @ centre for turn in turns)
    text = dice_text(relative="false", r1=turns[0], t1=first, rotation=matrix(turns[1]), translation=second)
    with pytest.raises(FileFormatError, match="same position") as caught:
        load_text(text)
    assert caught.value.code == "calibration_invalid"


def test_dice_euler_angles_mean_what_its_own_matrix_says(specimen_dir: Path) -> None:
    text = (specimen_dir / "calibration_dice.xml").read_text()
    found = re.findall(r"ALPHA (\S+) BETA (\S+) GAMMA (\S+) \(radians\)", text)[1]
    angles = "".join(
        f'<Parameter name="{k}" type="double" value="{v}"/>'
        for k, v in zip(("ALPHA", "BETA", "GAMMA"), np.degrees([float(v) for v in found]), strict=True)
    )
    expected = load_calibration(specimen_dir / "calibration_dice.xml").pair.cam2_from_cam1.rotation
    got = load_text(dice_text(rotation=angles)).pair.cam2_from_cam1.rotation
    np.testing.assert_allclose(got, expected, atol=2e-6)  # the comment has six digits


def test_the_specimens_calibration(specimen_dir: Path) -> None:
    loaded = load_calibration(specimen_dir / "calibration_dice.xml")
    assert loaded.image_size1_px == loaded.image_size2_px == (1920, 1200)
    assert loaded.pair.baseline_mm == pytest.approx(123.6, abs=0.05)  # as its README states
    assert np.degrees(loaded.pair.stereo_angle_rad) == pytest.approx(19.0, abs=0.3)
    assert isinstance(loaded.pair.cam1.lens, OpenCVLens)
    assert loaded.pair.cam1.lens.k3 == 55.92468005109


@pytest.mark.parametrize(
    ("old", "new", "code", "word"),
    [
        ('value="OPENCV_LENS_DISTORTION"', 'value="VIC3D_LENS_DISTORTION"', "calibration_unsupported", "VIC3D_LENS"),
        ('value="OPENCV_LENS_DISTORTION"', 'value="K1R2_K2R4_K3R6"', "calibration_unsupported", "K1R2_K2R4_K3R6"),
        ('value="OPENCV_LENS_DISTORTION"', 'value="NONE"', "calibration_unsupported", "distortion coefficients"),
        ('value="OPENCV"', 'value="SOMETHING"', "calibration_unsupported", "SOMETHING"),
        ('name="system_type_3D"', 'name="other"', "calibration_unsupported", "none given"),
        ("DICe_xml_camera_system_file", "else", "calibration_unreadable", "DICe_xml"),
        ('value="121.4"', 'value="nan"', "calibration_invalid", "TX"),
        ('value="121.4"', 'value="x"', "calibration_unreadable", "TX"),
        ('name="FX"', 'name="FZ"', "calibration_unreadable", "FX"),
        ('name="CY"', 'name="CX"', "calibration_unreadable", "twice"),
        ("CAMERA 1", "CAMERA 2", "calibration_unsupported", "CAMERA 2"),
        ('name="ROW 2"', 'name="ROW 3"', "calibration_unreadable", "ROW 3"),
    ],
)
def test_dice_files_that_are_refused(old: str, new: str, code: str, word: str) -> None:
    text = dice_text()
    assert old in text
    with pytest.raises(FileFormatError) as caught:
        load_text(text.replace(old, new))
    assert caught.value.code == code
    assert word in caught.value.cause


def test_dice_rational_terms_are_opencvs() -> None:
    # DICe's own source names OpenCV's formula for its OPENCV_LENS_DISTORTION
    more = "".join(f'<Parameter name="K{i}" type="double" value="{v}"/>' for i, v in ((4, 0.8), (5, -2.0), (6, 30.0)))
    check_against_opencv(load_text(dice_text(extra=more)), D1, np.array([*D2, 0.8, -2.0, 30.0]))


@pytest.mark.parametrize("term", ["S1", "T1", "FS"])
def test_dice_lens_terms_that_cannot_be_carried_over(term: str) -> None:
    assert load_text(dice_text(extra=f'<Parameter name="{term}" type="double" value="0.0"/>'))
    with pytest.raises(FileFormatError, match=term) as caught:
        load_text(dice_text(extra=f'<Parameter name="{term}" type="double" value="0.01"/>'))
    assert caught.value.code == "calibration_unsupported"


def test_dice_rotation_given_twice_or_no_rotation_at_all() -> None:
    for extra, rotation in (
        ('<Parameter name="BETA" type="double" value="0.1"/>', None),
        ("", matrix(R * 1.001)),
        ("", matrix(-R)),
    ):
        with pytest.raises(FileFormatError):
            load_text(dice_text(extra=extra, rotation=rotation))


def test_xml_bombs_are_refused() -> None:
    bomb = (
        '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>'
        '<ParameterList><Parameter name="CAMERA" value="&b;"/></ParameterList>'
    )
    with pytest.raises(FileFormatError) as caught:
        load_text(bomb)
    assert caught.value.code == "calibration_unreadable"


# the forms below are made here by the layouts that their programs write, and projected by formulas written out below

BROWN1, BROWN2 = {"k1": 0.08, "k2": -0.9, "k3": 3.1}, {"k1": -0.05, "k2": 0.4, "k3": -2.2}
ANGLES_DEG = (0.7, -18.2, 1.3)
SHIFT_MM = (121.4, 0.574, 23.19)
SKEWS_PX = (-2.5, 3.7)


def turn_of(alpha_deg: float, beta_deg: float, gamma_deg: float) -> np.ndarray:
    """First about x by alpha, then about the fixed y by beta, then about the fixed z by gamma: by Rodrigues."""
    parts = np.radians([alpha_deg, beta_deg, gamma_deg])
    about_x, about_y, about_z = (cv2.Rodrigues(angle * np.eye(3)[k])[0] for k, angle in enumerate(parts))
    return np.asarray(about_z @ about_y @ about_x)


def brown(points: np.ndarray, K: np.ndarray, skew: float, terms: dict[str, float]) -> np.ndarray:
    """Pixels of points in a camera's frame: (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k6 r6), p1 and p2, then skewed."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, k3, k6, p1, p2 = (terms.get(key, 0.0) for key in ("k1", "k2", "k3", "k6", "p1", "p2"))
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k6 * r2**3)
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([K[0, 0] * bent_x + skew * bent_y + K[0, 2], K[1, 1] * bent_y + K[1, 2]], axis=1)


def check_against_brown(
    loaded: LoadedCalibration, terms1: dict[str, float], terms2: dict[str, float], skews: tuple[float, float] = SKEWS_PX
) -> None:
    in_cam2 = POINTS @ turn_of(*ANGLES_DEG).T + np.array(SHIFT_MM)
    for camera, theirs in (
        (loaded.pair.cam1, brown(POINTS, K1, skews[0], terms1)),
        (loaded.pair.cam2, brown(in_cam2, K2, skews[1], terms2)),
    ):
        np.testing.assert_allclose(camera.project(POINTS).xy, theirs, atol=1e-8)


def dice_lines(*, matrix: bool = False, size: bool = True, comments: bool = True, third: str = "k3") -> list[str]:
    names, values = [], []
    for K, skew, terms in ((K1, SKEWS_PX[0], BROWN1), (K2, SKEWS_PX[1], BROWN2)):
        names += ["cx", "cy", "fx", "fy", "fs", "k1", "k2", third]
        values += [K[0, 2], K[1, 2], K[0, 0], K[1, 1], skew, terms["k1"], terms["k2"], terms["k3"]]
    if matrix:
        names += [f"R{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
        values += turn_of(*ANGLES_DEG).ravel().tolist()
    else:
        names += ["alpha", "beta", "gamma"]
        values += ANGLES_DEG
    names, values = [*names, "tx", "ty", "tz"], [*values, *SHIFT_MM]
    lines = [f"{v:.15e}" + (f" # {n}" if comments else "") for n, v in zip(names, values, strict=True)]
    return [*lines, "1200", "1920 # width"] if size else lines


@pytest.mark.parametrize("matrix", [False, True])
@pytest.mark.parametrize("size", [False, True])
@pytest.mark.parametrize("comments", [False, True])
def test_dices_text_in_each_of_its_layouts(matrix: bool, size: bool, comments: bool) -> None:
    text = "\n".join(["# a head", "", *dice_lines(matrix=matrix, size=size, comments=comments)]) + "\n"
    loaded = load_text(text)
    assert loaded.source == "dice_txt"
    assert loaded.image_size1_px == loaded.image_size2_px == ((1920, 1200) if size else None)
    check_against_brown(loaded, BROWN1, BROWN2)
    assert any("r^2" in warning for warning in check_calibration(loaded).warnings)
    wrapped = json.dumps(imported_content(text.encode(), name="a.txt"))
    check_against_brown(load_text(wrapped), BROWN1, BROWN2)


def test_the_third_term_that_dices_own_calibration_wrote_is_opencvs_k6() -> None:
    terms1, terms2 = ({"k1": t["k1"], "k2": t["k2"], "k6": t["k3"]} for t in (BROWN1, BROWN2))
    check_against_brown(load_text("\n".join(dice_lines(matrix=True, third="k6"))), terms1, terms2)


def test_dices_text_without_lens_terms_needs_no_warning() -> None:
    lines = [re.sub(r"^\S+ # k\d", "0.0 # none", line) for line in dice_lines()]
    loaded = load_text("\n".join(lines))
    check_against_brown(loaded, {}, {})
    assert check_calibration(loaded).warnings == []


@pytest.mark.parametrize(
    ("change", "code", "word"),
    [
        (lambda lines: lines[:-3], "calibration_unreadable", "21 numbers"),
        (lambda lines: lines[:12], "calibration_unreadable", "12 numbers"),
        (
            lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]],
            "calibration_unreadable",
            "commented fy, where fx",
        ),
        (lambda lines: [*lines[:9], "x # cy", *lines[10:]], "calibration_unreadable", "line 10 is 'x'"),
        (lambda lines: [*lines[:9], "nan # cy", *lines[10:]], "calibration_invalid", "cy in line 10"),
        (
            lambda lines: ["0 # cx" if "cx" in n else n.replace("6.6386", "-6.6386") for n in lines],
            "calibration_invalid",
            "fx",
        ),
        (lambda lines: [re.sub(r"^\S+ # t", "0.0 # t", n) for n in lines], "calibration_invalid", "same position"),
        (lambda lines: [*lines, "TRANSFORM", *"123456"], "calibration_unsupported", "TRANSFORM"),
    ],
)
def test_dices_texts_that_are_refused(change: Callable[[list[str]], list[str]], code: str, word: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        load_text("\n".join(change(dice_lines())))
    assert caught.value.code == code
    assert word in caught.value.cause


def vic3d_in_dice(model: str = "VIC3D_LENS_DISTORTION", extra: str = "") -> str:
    """A camera system of type VIC3D: both cameras placed in the world by angles in degrees."""
    world, at = turn_of(179.6, 9.2, -0.4), np.array([-63.2, -0.34, 18.7])
    second = turn_of(*ANGLES_DEG) @ world
    poses = (world, at), (second, turn_of(*ANGLES_DEG) @ at + np.array(SHIFT_MM))
    cameras = []
    for i, (K, skew, terms, (R_world, t)) in enumerate(zip((K1, K2), SKEWS_PX, (BROWN1, BROWN2), poses, strict=True)):
        beta = np.degrees(np.arcsin(-R_world[2, 0]))
        alpha, gamma = np.degrees([np.arctan2(R_world[2, 1], R_world[2, 2]), np.arctan2(R_world[1, 0], R_world[0, 0])])
        values = {"CX": K[0, 2], "CY": K[1, 2], "FX": K[0, 0], "FY": K[1, 1], "FS": skew}
        values |= {key.upper(): value for key, value in terms.items()}
        values |= {"ALPHA": alpha, "BETA": beta, "GAMMA": gamma, "TX": t[0], "TY": t[1], "TZ": t[2]}
        lines = [f'<Parameter name="{k}" type="double" value="{float(v)!r}" />' for k, v in values.items()]
        lines.append(f'<Parameter name="LENS_DISTORTION_MODEL" type="string" value="{model}" />{extra}')
        lines.append('<Parameter name="IMAGE_HEIGHT_WIDTH" type="string" value="{ 1200, 1920 }" />')
        cameras.append(f'<ParameterList name="CAMERA {i}">\n' + "\n".join(lines) + "\n</ParameterList>")
    return (
        '<ParameterList>\n<Parameter name="xml_file_format" type="string" value="DICe_xml_camera_system_file" />\n'
        '<Parameter name="system_type_3D" type="string" value="VIC3D" />\n' + "\n".join(cameras) + "\n</ParameterList>"
    )


@pytest.mark.parametrize("model", ["VIC3D_LENS_DISTORTION", "K1R1_K2R2_K3R3", "K1R3_K2R5_K3R7"])
def test_dices_xml_of_type_vic3d_is_read_as_vic3ds_own_numbers(model: str) -> None:
    loaded = load_text(vic3d_in_dice(model))
    assert loaded.source == "dice_xml"
    assert loaded.image_size2_px == (1920, 1200)
    check_against_brown(loaded, BROWN1, BROWN2)
    assert any("VIC-3D's" in warning for warning in check_calibration(loaded).warnings)


def test_dices_xml_of_type_vic3d_refuses_terms_that_vic3d_does_not_have() -> None:
    for model, extra, word in (
        ("K1R2_K2R4_K3R6", "", "K1R2_K2R4_K3R6"),
        ("VIC3D_LENS_DISTORTION", '<Parameter name="P1" type="double" value="0.001" />', "P1"),
        ("VIC3D_LENS_DISTORTION", '<Parameter name="K4" type="double" value="0.001" />', "K4"),
    ):
        with pytest.raises(FileFormatError, match=word) as caught:
            load_text(vic3d_in_dice(model, extra))
        assert caught.value.code == "calibration_unsupported"


def pyvale_lines(separator: str = ",") -> list[str]:
    rows: list[tuple[str, float]] = []
    for k, (K, skew, terms) in enumerate(((K1, SKEWS_PX[0], BROWN1), (K2, SKEWS_PX[1], BROWN2))):
        pixels = {"fx": K[0, 0], "fy": K[1, 1], "fs": skew, "cx": K[0, 2], "cy": K[1, 2]}
        rows += [(f"cam{k}_{key}_px", value) for key, value in pixels.items()]
        bent = {"k1": terms["k1"], "k2": terms["k2"], "p1": 1e-3 * (k + 1), "p2": -5e-4, "k3": terms["k3"]}
        rows += [(f"cam{k}_{key}", value) for key, value in bent.items()]
    rows += zip(("tx_mm", "ty_mm", "tz_mm"), SHIFT_MM, strict=True)
    rows += zip(("theta_deg", "phi_deg", "psi_deg"), ANGLES_DEG, strict=True)
    return [f"{name}{separator}{float(value)!r}" for name, value in rows]


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_pyvales_text(separator: str) -> None:
    loaded = load_text("\r\n".join(pyvale_lines(separator)) + "\r\n")
    assert loaded.source == "pyvale_txt"
    assert loaded.image_size1_px is None
    check_against_brown(loaded, {**BROWN1, "p1": 1e-3, "p2": -5e-4}, {**BROWN2, "p1": 2e-3, "p2": -5e-4})


@pytest.mark.parametrize(
    ("old", "new", "code", "word"),
    [
        ("cam1_k3", "cam1_k4", "calibration_unreadable", "lacks cam1_k3"),
        ("psi_deg", "phi_deg", "calibration_unreadable", "phi_deg occurs twice"),
        ("tx_mm,121.4", "tx_mm,here", "calibration_unreadable", "'here'"),
        ("tx_mm,121.4", "tx_mm", "calibration_unreadable", "line 21"),
        ("tx_mm,121.4", "tx_mm,inf", "calibration_invalid", "tx_mm is inf"),
        ("cam0_fx_px,6", "cam0_fx_px,-6", "calibration_invalid", "fx"),
    ],
)
def test_pyvales_texts_that_are_refused(old: str, new: str, code: str, word: str) -> None:
    text = "\n".join(pyvale_lines())
    assert old in text
    with pytest.raises(FileFormatError) as caught:
        load_text(text.replace(old, new))
    assert caught.value.code == code
    assert word in caught.value.cause


OURS = {
    "phd_px": 12000.0,
    "cx_px": 255.0,
    "cy_px": 241.0,
    "kappa_per_px2": 3e-8,
    "aspect": 0.9617,
    "alpha_rad": 0.8,
    "beta_rad": 0.02,
    "gamma_rad": -0.5,
    "x0_mm": 0.3,
    "y0_mm": -0.2,
    "z0_mm": 400.0,
}


def test_a_file_with_only_the_two_cameras_is_enough(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"cam1": OURS, "cam2": {**OURS, "gamma_rad": 0.5}}))
    loaded = load_calibration(path)
    expected = Camera.from_paper(**OURS).project([[1.0, 2.0, 0.5]]).xy
    np.testing.assert_array_equal(loaded.pair.cam1.project([[1.0, 2.0, 0.5]]).xy, expected)
    assert loaded.image_size1_px is None
    sizes = {"cam1": [512, 480], "cam2": [640, 480]}
    path.write_text(json.dumps({"cam1": OURS, "cam2": {**OURS, "gamma_rad": 0.5}, "image_size_px": sizes}))
    assert load_calibration(path).image_size1_px == (512, 480)
    assert load_calibration(path).image_size2_px == (640, 480)
    assert loaded.source == "calibration_json"


@pytest.mark.parametrize(
    ("key", "value", "code"),
    [
        ("phd_px", float("nan"), "calibration_invalid"),
        ("z0_mm", float("inf"), "calibration_invalid"),
        ("phd_px", -1.0, "calibration_invalid"),
        ("aspect", 0, "calibration_invalid"),
        ("alpha_rad", "0.8", "calibration_unreadable"),
        ("alpha_rad", True, "calibration_unreadable"),
        ("gamma_rad", None, "calibration_unreadable"),
    ],
)
def test_our_own_file_with_a_bad_number(tmp_path: Path, key: str, value: object, code: str) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"cam1": OURS, "cam2": {**OURS, "gamma_rad": 0.5, key: value}}))
    error = refused(path)
    assert error.code == code
    assert key in error.cause
    path.write_text(json.dumps({"cam1": OURS, "cam2": OURS}))
    assert "same position" in refused(path).cause


def test_another_programs_cameras_have_a_geometry_where_their_axes_meet(tmp_path: Path) -> None:
    """The system's origin is camera 1's pinhole: two cameras turned by 20 degrees about a point 500 mm away."""
    focal, distance, angle = 2000.0, 500.0, np.radians(20.0)
    K = np.array([[focal, 0.0, 959.5], [0.0, focal, 599.5], [0.0, 0.0, 1.0]])
    turn = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
    middle = np.array([0.0, 0.0, distance])
    none = np.zeros(5)
    file = opencv_file(
        tmp_path / "pair.yml",
        cameraMatrix1=K,
        cameraMatrix2=K,
        distCoeffs1=none,
        distCoeffs2=none,
        R=turn,
        T=(middle - turn @ middle)[:, None],
    )
    loaded = load_calibration(file)
    with np.errstate(all="raise"):
        found = geometry_of_cameras(loaded.pair, ((1920, 1200), (1920, 1200)))
    assert found is not None
    assert np.degrees(found.stereo_angle_rad) == pytest.approx(20.0)
    for view in found.views.values():  # the plane is turned by half the angle to each of them
        assert view.standoff_mm == pytest.approx(distance)
        assert view.field_of_view_mm is not None
        assert view.field_of_view_mm[1] == pytest.approx(1200 * distance / focal)
        edge = np.arctan(960.0 / focal)
        lengths = [distance * np.sin(edge) / np.cos(angle / 2 + sign * edge) for sign in (-1, 1)]
        assert view.field_of_view_mm[0] == pytest.approx(sum(lengths))
