"""Imported calibrations project as OpenCV does with the same numbers; doubtful files are refused with the reason."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from core.cameras.camera import Camera
from core.cameras.lens import OpenCVLens
from core.errors import FileFormatError
from server.formats.calibrations.plausibility import check_calibration
from server.formats.calibrations.recognise import LoadedCalibration, load_calibration, parse_calibration

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
    ("place", "term"), [(8, "s1"), (9, "s2"), (10, "s3"), (11, "s4"), (12, "tau_x"), (13, "tau_y")]
)
def test_thin_prism_and_tilt_are_refused_by_name(tmp_path: Path, place: int, term: str) -> None:
    d2 = np.zeros(12 if place < 12 else 14)
    d2[:5], d2[place] = D2, 0.01
    error = refused(opencv_file(tmp_path / "a.yml", distCoeffs2=d2))
    assert error.code == "calibration_unsupported"
    assert f"distCoeffs2 has {term} = 0.01;" in error.cause


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
        for k, v in zip(("ALPHA", "BETA", "GAMMA"), found, strict=True)
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
        ('value="OPENCV"', 'value="VIC3D"', "calibration_unsupported", "VIC3D"),
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
