"""Calibrations to and from other programs: OpenCV projects the numbers that other readers find in the files."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import httpx
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera, RigidTransform
from stereorig.core.cameras.conversion import LensFit, fit_opencv, fit_seidel, image_positions
from stereorig.core.cameras.lens import OpenCVLens, SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import StereorigError
from stereorig.core.field.points.result import Field
from stereorig.server.cli.main import main
from stereorig.server.formats.calibrations.export import FORMS, convert_calibration
from stereorig.server.formats.calibrations.programs.plausibility import check_calibration, shared_points
from stereorig.server.formats.calibrations.recognise import LoadedCalibration, load_calibration, parse_calibration
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.results.calibration_checks import check_against

SIZE = (1280, 1024)
PAPER = {
    "cam1": {
        "phd_px": 9000.0,
        "cx_px": 640.5,
        "cy_px": 508.0,
        "kappa_per_px2": 2.0e-8,
        "aspect": 0.9617,
        "alpha_rad": 0.77,
        "beta_rad": 0.013,
        "gamma_rad": -0.2,
        "x0_mm": 0.2,
        "y0_mm": 0.1,
        "z0_mm": 400.0,
    },
    "cam2": {
        "phd_px": 8900.0,
        "cx_px": 633.0,
        "cy_px": 515.5,
        "kappa_per_px2": -1.5e-8,
        "aspect": 0.9617,
        "alpha_rad": 0.78,
        "beta_rad": -0.01,
        "gamma_rad": 0.21,
        "x0_mm": -0.2,
        "y0_mm": -0.1,
        "z0_mm": 405.0,
    },
    "image_size_px": {"cam1": list(SIZE), "cam2": list(SIZE)},
}
# two cameras of a public VIC-3D project (test data of DICe, BSD-3): an example of such files
VIC3D = """<?xml version="1.0" encoding="ISO-8859-1"?>
<!DOCTYPE vpml>
<project dir="C:/Versuche/Größe">
 <calibration lri="calibration">
  <camera id="0">9.550537385e+02 6.452301624e+02 6.636033383e+03 6.636440175e+03 -5.693077075e-04 -1.957515272e-04 8.739544595e-01 -2.691426143e+01<orientation>1.799332210e+02 9.415993919e+00 -5.775865407e-02 -5.820738494e+01 1.641145944e-01 2.016820788e+01</orientation>
  </camera>
  <camera id="1">9.713275619e+02 6.157965508e+02 6.609847619e+03 6.609166930e+03 7.051020868e-01 -5.225966870e-03 1.077694686e+00 -3.005404073e+01<orientation>-1.799418875e+02 -9.416050875e+00 4.747312256e-02 5.984373321e+01 2.184759676e-01 2.104719884e+01</orientation>
  </camera>
 </calibration>
 <projectaois><aoinode><polygonmask width="1920" height="1200"/></aoinode></projectaois>
</project>
"""  # noqa: E501
CALDAT = """Cam0_Fx [pixels];6673.315918
Cam0_Fy [pixels];6669.302734
Cam0_Fs [pixels];0.25
Cam0_Kappa 1;0.032258954
Cam0_Kappa 2;-1.01141417
Cam0_Kappa 3;29.78838921
Cam0_P1;0.0001
Cam0_P2;-0.0002
Cam0_Cx [pixels];872.1577759
Cam0_Cy [pixels];579.9553223
Cam1_Fx [pixels];6607.618164
Cam1_Fy [pixels];6602.857422
Cam1_Fs [pixels];0
Cam1_Kappa 1;0.064598486
Cam1_Kappa 2;-4.531373978
Cam1_Kappa 3;29.78838921
Cam1_P1;0
Cam1_P2;0
Cam1_Cx [pixels];917.9733887
Cam1_Cy [pixels];531.6352539
Tx [mm];122.2488624
Ty [mm];1.848889206
Tz [mm];17.62463774
Theta [deg];0.130689541
Phi [deg];-19.06769369
Psi [deg];0.281404039
"""


def paper() -> LoadedCalibration:
    return parse_calibration(json.dumps(PAPER).encode(), name="paper")


def opencv_pair(**lens: float) -> LoadedCalibration:
    """A pair with OpenCV's lenses, by its own program's YAML."""
    K = np.array([[6600.0, 0.0, 650.0], [0.0, 6610.0, 500.0], [0.0, 0.0, 1.0]])
    R = Rotation.from_euler("xyz", [0.3, -18.0, 0.5], degrees=True).as_matrix()
    d = np.array([[lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]])
    d = d if d[0, 5:].any() else d[:, :5]
    file = cv2.FileStorage("x.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for name, value in (
        ("cameraMatrix1", K),
        ("cameraMatrix2", K),
        ("distCoeffs1", d),
        ("distCoeffs2", d),
        ("R", R),
        ("T", np.array([[122.0], [1.0], [20.0]])),
        ("imageSize", np.array([SIZE])),
    ):
        file.write(name, value)
    return parse_calibration(file.releaseAndGetString().encode(), name="yaml")


def by_cv2(points: Float, pose: RigidTransform, k: Float, d: Float, skew: float = 0.0) -> Float:
    """OpenCV's projection; it leaves the skew out, which is added here."""
    rvec = cv2.Rodrigues(np.array(pose.rotation))[0]
    xy = cv2.projectPoints(points.reshape(-1, 1, 3), rvec, np.array(pose.translation_mm), k, d)[0].reshape(-1, 2)
    return xy + np.stack([skew * (xy[:, 1] - k[1, 2]) / k[1, 1], np.zeros(len(xy))], axis=1)


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Float:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _identity() -> RigidTransform:
    return RigidTransform(np.eye(3), np.zeros(3))


def seen_through(data: bytes, form: str, points_cam1: Float) -> tuple[Float, Float]:
    """What both cameras see of points in camera 1's frame, by numbers that other readers take from the file."""
    if form == "opencv":
        file = cv2.FileStorage(data.decode(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        k1, k2, d1, d2, R, T = (
            file.getNode(n).mat() for n in ("cameraMatrix1", "cameraMatrix2", "distCoeffs1", "distCoeffs2", "R", "T")
        )
        pose = RigidTransform(R, T.ravel())
        return by_cv2(points_cam1, _identity(), k1, d1), by_cv2(points_cam1, pose, k2, d2)
    if form == "dice":
        root = ElementTree.fromstring(data)
        seen = []
        for camera in root.findall("ParameterList"):
            values = {p.get("name"): p.get("value") for p in camera.findall("Parameter")}
            n = {k: float(v) for k, v in values.items() if re.fullmatch(r"[-+.\de]+", str(v))}  # type: ignore[arg-type]
            rows = [p.get("value", "").strip("{} ").split(",") for p in camera.findall("ParameterList/Parameter")]
            pose = RigidTransform(np.array(rows, dtype=float), np.array([n["TX"], n["TY"], n["TZ"]]))
            d = np.array([n[k] for k in ("K1", "K2", "P1", "P2", "K3")])
            seen.append(by_cv2(points_cam1, pose, _matrix(n["FX"], n["FY"], n["CX"], n["CY"]), d))
        return seen[0], seen[1]
    if form == "matchid":
        n = {k: float(v) for k, v in (line.split(";") for line in data.decode().splitlines())}
        turn = Rotation.from_euler("xyz", [n["Theta [deg]"], n["Phi [deg]"], n["Psi [deg]"]], degrees=True)
        pose = RigidTransform(turn.as_matrix(), np.array([n["Tx [mm]"], n["Ty [mm]"], n["Tz [mm]"]]))
        seen = []
        for cam, where in (("Cam0", _identity()), ("Cam1", pose)):
            d = np.array([n[f"{cam}_{k}"] for k in ("Kappa 1", "Kappa 2", "P1", "P2", "Kappa 3")])
            k = _matrix(*(n[f"{cam}_{k} [pixels]"] for k in ("Fx", "Fy", "Cx", "Cy")))
            seen.append(by_cv2(points_cam1, where, k, d, n[f"{cam}_Fs [pixels]"]))
        return seen[0], seen[1]
    cameras = ElementTree.fromstring(data).findall(".//camera")
    poses, lenses = [], []
    for camera in cameras:
        turn = [float(v) for v in camera.find("orientation").text.split()]  # type: ignore[union-attr]
        poses.append(RigidTransform(Rotation.from_euler("xyz", turn[:3], degrees=True).as_matrix(), np.array(turn[3:])))
        lenses.append([float(v) for v in camera.text.split()])  # type: ignore[union-attr]
    world = poses[0].inverse().apply(points_cam1)
    seen = []
    for pose, (cx, cy, fx, fy, skew, *k) in zip(poses, lenses, strict=True):
        d = np.array([k[0], k[1], 0.0, 0.0, k[2]])
        seen.append(by_cv2(world, pose, _matrix(fx, fy, cx, cy), d, skew))
    return seen[0], seen[1]


@pytest.mark.parametrize("form", ["opencv", "dice", "matchid", "vic3d"])
@pytest.mark.parametrize("what", ["paper", "opencv", "tangential", "rational", "matchid"])
def test_other_readers_see_what_was_calibrated(form: Any, what: str) -> None:
    loaded = {
        "paper": paper,
        "opencv": lambda: opencv_pair(k1=0.09, k2=-2.8, k3=50.0),
        "tangential": lambda: opencv_pair(k1=0.09, p1=4e-4, p2=-3e-4),
        "rational": lambda: opencv_pair(k1=0.62, k2=-2.1, p1=4e-4, k3=9.0, k4=5.4, k5=80.0, k6=-700.0),
        "matchid": lambda: parse_calibration(CALDAT.encode(), name="caldat"),
    }[what]()
    made = convert_calibration(loaded, form, b"")
    size = SIZE if what != "matchid" else (1745, 1161)
    points = shared_points(loaded.pair, size, size)
    assert len(points) > 100
    seen = seen_through(made.data, form, loaded.pair.cam1.cam_from_sys.apply(points))
    for k, camera in enumerate((loaded.pair.cam1, loaded.pair.cam2)):
        off = np.linalg.norm(seen[k] - camera.project(points).xy, axis=1).max()
        assert off < made.report.lens[f"cam{k + 1}"].max_px * 1.02 + 1e-8
    exact = what == "opencv" or (form == "matchid" and what != "rational")
    exact |= (form == "opencv" and what == "rational") or (form != "vic3d" and what == "tangential")
    left, back = made.report.lens["cam1"].max_px, made.report.read_back
    if what == "paper":  # its series goes on after r^6
        assert 0.0 < left < 1e-6
        assert back.max_px < 1e-6
        assert back.max_mm < 1e-7
    elif exact:
        assert made.report.exact is True
        assert back.max_px < 1e-8
        assert back.max_mm < 1e-8
    else:  # nothing inexact is reported as exact
        assert made.report.exact is False
        assert left > 1e-3
        assert back.max_mm > 1e-6


@pytest.mark.parametrize("form", FORMS)
def test_a_calibration_comes_back(form: Any) -> None:
    loaded = paper()
    made = convert_calibration(loaded, form, json.dumps(PAPER).encode())
    again = parse_calibration(made.data, name="again")
    assert again.pair.baseline_mm == pytest.approx(loaded.pair.baseline_mm, rel=1e-12)
    assert again.pair.stereo_angle_rad == pytest.approx(loaded.pair.stereo_angle_rad, abs=1e-9)
    assert again.image_size1_px == (None if form in ("matchid", "vic3d") else SIZE)
    assert made.report.frame == ("target" if form in ("json", "paper") else "camera 1")
    assert made.report.source_sha256 == loaded.sha256


def test_an_imported_calibration_in_the_papers_parameters() -> None:
    loaded = opencv_pair(k1=0.09, k2=-2.8)
    made = convert_calibration(loaded, "paper", b"")
    cam1 = json.loads(made.data)["cam1"]
    assert cam1["z0_mm"] == pytest.approx(122.0 / np.tan(np.radians(18.0)), rel=0.1)
    again = parse_calibration(made.data, name="paper")
    points = shared_points(loaded.pair, SIZE, SIZE)
    here = again.pair.cam1.sys_from_cam.apply(points)
    off = np.linalg.norm(again.pair.cam2.project(here).xy - loaded.pair.cam2.project(points).xy, axis=1)
    assert 1e-3 < off.max() < made.report.lens["cam2"].max_px * 1.02


# lens fits ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", [1e-9, 1e-7, -2e-7])
def test_a_seidel_lens_in_opencvs_terms(kappa: float) -> None:
    lens = SeidelLens(9000.0, 640.0, 512.0, kappa, 0.96)
    fit = fit_opencv(lens, SIZE)
    rng = np.random.default_rng(3)
    xy = rng.uniform((-0.5, -0.5), (SIZE[0] - 0.5, SIZE[1] - 0.5), (4000, 2))
    n = lens.normalised_from_image(xy).xy
    off = np.linalg.norm(fit.lens.image_from_normalised(n).xy - xy, axis=1)
    assert off.max() <= fit.max_px * 1.05 + 1e-9
    assert np.sqrt(np.mean(off**2)) <= fit.rms_px * 1.5 + 1e-9
    assert fit.max_px < (kappa * 820.0**2) ** 4 * 820.0  # the next term of the series of 1 / (1 + k r^2)
    assert fit.pixels_with_ray == 1.0


def test_a_rational_lens_in_five_terms_says_what_is_left() -> None:
    lens = OpenCVLens(1100.0, 1107.0, 640.0, 512.0, 0.0, 0.62, 0.21, 4e-4, -7e-4, 0.012, 0.94, 0.38, 0.05)
    fit = fit_opencv(lens, SIZE)
    assert isinstance(fit.lens, OpenCVLens)
    assert (fit.lens.k4, fit.lens.k5, fit.lens.k6) == (0.0, 0.0, 0.0)
    xy = np.random.default_rng(3).uniform((-0.5, -0.5), (SIZE[0] - 0.5, SIZE[1] - 0.5), (4000, 2))
    K = _matrix(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px)
    d = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, lens.k4, lens.k5, lens.k6])
    settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-13)
    n = cv2.undistortPoints(xy[:, None], K, d, criteria=settled)[:, 0]
    off = np.linalg.norm(fit.lens.image_from_normalised(n).xy - xy, axis=1)
    assert 1e-3 < off.max() < fit.max_px * 1.05
    assert np.sqrt(np.mean(off**2)) == pytest.approx(fit.rms_px, rel=0.2)  # other positions: half of it at the rim
    # no other five terms do better, by a minimiser that knows nothing of Jacobians or of the start
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "skew_px", "k1", "k2", "p1", "p2", "k3")
    scale = np.array([1100.0, 1100.0, 640.0, 512.0, 1.0, 1.0, 1.0, 1e-3, 1e-3, 1.0])
    start = np.array([getattr(fit.lens, name) for name in names])
    grid = image_positions(SIZE)
    rays = cv2.undistortPoints(grid[:, None], K, d, criteria=settled)[:, 0]

    def left(x: Float) -> Float:
        return (OpenCVLens(*(start + x * scale)).image_from_normalised(rays).xy - grid).ravel()

    best = least_squares(left, np.zeros(10), x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.sqrt(2.0 * np.mean(best.fun**2)) == pytest.approx(fit.rms_px, rel=1e-6)
    # where the format has the terms, the lens is kept
    assert fit_opencv(lens, SIZE, rational=True) == LensFit(lens, 0.0, 0.0, 1.0)
    five = OpenCVLens(750.0, 755.0, 640.0, 512.0, 0.0, -0.2, 0.05)
    assert fit_opencv(five, SIZE, rational=True).lens == fit_opencv(five, SIZE).lens == five


def test_a_five_term_fit_does_not_fold_on_its_way() -> None:
    # 116 degrees across; full steps of Gauss and Newton fold the polynomial inside the image here, where it stays
    lens = OpenCVLens(1100.0, 1100.0, 640.0, 512.0, 0.0, -0.2, 0.14, 4e-4, -7e-4, -0.05, 0.11, 0.52, -0.21)
    assert fit_opencv(lens, SIZE).rms_px == pytest.approx(2.124, abs=1e-3)  # by scipy's least_squares, from no terms


@pytest.mark.parametrize(("k4", "count"), [(0.0, 5), (0.3, 8)])
def test_opencvs_file_has_as_many_coefficients_as_the_lens(k4: float, count: int) -> None:
    made = convert_calibration(opencv_pair(k1=0.09, k4=k4), "opencv", b"")
    file = cv2.FileStorage(made.data.decode(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert file.getNode("distCoeffs1").mat().shape == file.getNode("distCoeffs2").mat().shape == (1, count)
    assert file.getNode("distCoeffs1").mat()[0, 5:].tolist() == [k4, 0.0, 0.0][: count - 5]
    assert made.report.exact is True


def test_an_opencv_lens_in_the_papers_terms_says_what_is_left() -> None:
    lens = OpenCVLens(6600.0, 6610.0, 640.0, 512.0, k1=0.09, k2=-2.8, p1=3e-4)
    fit = fit_seidel(lens, SIZE)
    n = lens.normalised_from_image(np.array([[0.0, 0.0], [1279.0, 0.0], [640.0, 512.0]])).xy
    off = np.linalg.norm(fit.lens.image_from_normalised(n).xy - lens.image_from_normalised(n).xy, axis=1)
    assert 0.01 < off.max() <= fit.max_px
    # what the paper's model can hold comes back
    own = fit_opencv(SeidelLens(6600.0, 640.0, 512.0, 3e-9, 1.01), SIZE).lens
    back = fit_seidel(own, SIZE)
    assert back.max_px < 1e-9
    assert isinstance(back.lens, SeidelLens)
    assert back.lens.kappa_per_px2 == pytest.approx(3e-9, rel=1e-6)


def test_a_lens_that_folds_back_is_refused() -> None:
    with pytest.raises(StereorigError) as caught:
        fit_seidel(OpenCVLens(1000.0, 1000.0, 640.0, 512.0, k1=-5.0), SIZE)
    assert caught.value.code == "lens_unfittable"


# imports -----------------------------------------------------------------------------------------------------------


def test_vic3d_cameras_look_at_one_place() -> None:
    loaded = parse_calibration(VIC3D.encode("latin-1"), name="vic")
    assert loaded.source == "vic3d_xml"
    assert loaded.image_size1_px == loaded.image_size2_px == (1920, 1200)
    # by the angles that the file gives: 9.416 and -9.416 degrees about Y
    assert np.degrees(loaded.pair.stereo_angle_rad) == pytest.approx(18.832, abs=0.01)
    assert loaded.pair.cam1.lens.kernel_parameters()[1:6] == pytest.approx(
        [6636.033383, 6636.440175, -5.693077075e-04, 955.0537385, 645.2301624]
    )
    # another order of the angles makes the axes diverge: they meet in front of them, half a baseline / tan away
    met = loaded.pair.triangulate(np.array([959.5, 599.5]), np.array([959.5, 599.5]))
    assert met.valid
    z = loaded.pair.cam1.cam_from_sys.apply(met.xyz_mm)[2]
    assert z == pytest.approx(0.5 * loaded.pair.baseline_mm / np.tan(np.radians(9.416)), rel=0.05)
    # the world is near the middle between both cameras, the first at +X of it
    poses = []
    for turn in re.findall(r"<orientation>(.*?)</orientation>", VIC3D):
        n = [float(v) for v in turn.split()]
        R = Rotation.from_euler("xyz", n[:3], degrees=True).as_matrix()
        poses.append(-R.T @ np.array(n[3:]))
    assert np.linalg.norm(poses[0] - poses[1]) == pytest.approx(loaded.pair.baseline_mm, rel=1e-9)
    assert abs(poses[0] + poses[1])[:2].max() < 2.0
    checked = check_calibration(loaded)
    assert checked.volume.points > 100
    assert checked.volume.max_px < 1e-6


def test_a_newer_vic3d_file_reads_the_same() -> None:
    old, new = r"(\S+ \S+ \S+ \S+ \S+) (\S+ \S+ \S+)<o", r"<intrinsics>\1</intrinsics><distortion>\2</distortion><o"
    newer = re.sub(r'(?<=<camera id="\d">)' + old, new, VIC3D)
    assert "<intrinsics>" in newer
    one, two = (parse_calibration(text.encode("latin-1"), name="vic").pair for text in (VIC3D, newer))
    for a, b in ((one.cam1, two.cam1), (one.cam2, two.cam2)):
        np.testing.assert_array_equal(a.lens.kernel_parameters(), b.lens.kernel_parameters())
        np.testing.assert_array_equal(a.cam_from_sys.rotation, b.cam_from_sys.rotation)


def test_caldat_angles_and_prefixes() -> None:
    loaded = parse_calibration(CALDAT.encode(), name="caldat")
    R = Rotation.from_euler("xyz", [0.130689541, -19.06769369, 0.281404039], degrees=True).as_matrix()
    np.testing.assert_allclose(loaded.pair.cam2_from_cam1.rotation, R, atol=1e-12)
    lens = loaded.pair.cam1.lens
    assert isinstance(lens, OpenCVLens)
    assert (lens.skew_px, lens.k3, lens.p1, lens.p2) == (0.25, 29.78838921, 0.0001, -0.0002)
    other = re.sub("Cam1_", "Cam2_", CALDAT).replace("Cam0_", "Cam1_").replace(" [pixels]", "").replace(";", " = ")
    again = parse_calibration(other.encode(), name="caldat")
    np.testing.assert_array_equal(again.pair.cam1.lens.kernel_parameters(), lens.kernel_parameters())
    warned = check_calibration(loaded).warnings
    assert any("image size" in w for w in warned)


@pytest.mark.parametrize(
    ("text", "code", "word"),
    [
        (CALDAT.replace("Cam0_Fx [pixels];6673.315918\n", ""), "calibration_unreadable", "Fx"),
        (CALDAT.replace("6673.315918", "nan"), "calibration_invalid", "nan"),
        (CALDAT.replace("6673.315918", "-1"), "calibration_invalid", "fx"),
        (CALDAT.replace("Phi [deg];-19.06769369\n", ""), "calibration_unreadable", "Phi"),
        (CALDAT + "Cam2_Fx;1\n", "calibration_unreadable", "cam2"),
        (CALDAT + "Tx [mm];1\n", "calibration_unreadable", "twice"),
        (CALDAT.replace("122.2488624", "long"), "calibration_unreadable", "long"),
        (VIC3D.replace("9.415993919e+00", ""), "calibration_unreadable", "orientation"),
        (VIC3D.replace("6.636033383e+03", "x"), "calibration_unreadable", "numbers"),
        (VIC3D.replace("6.636033383e+03", "-6.6e3"), "calibration_invalid", "fx"),
        (VIC3D.replace('id="1"', 'id="0"'), "calibration_unreadable", "id"),
        (VIC3D.replace("-2.691426143e+01<", "-2.691426143e+01 0.5<"), "calibration_unsupported", "lens terms"),
        (VIC3D.replace("</project>", ""), "calibration_unreadable", "XML"),
        (VIC3D.replace("<!DOCTYPE vpml>", '<!DOCTYPE v [<!ENTITY a "b">]>'), "calibration_unreadable", "Entit"),
    ],
)
def test_damaged_files_are_refused(text: str, code: str, word: str) -> None:
    with pytest.raises(StereorigError) as caught:
        parse_calibration(text.encode("latin-1"), name="file")
    assert caught.value.code == code
    assert word in str(caught.value)


def test_cameras_that_see_nothing_in_common_are_warned_of() -> None:
    misaligned = json.loads(json.dumps(PAPER))
    misaligned["cam2"]["y0_mm"] += 600.0
    warned = check_calibration(parse_calibration(json.dumps(misaligned).encode(), name="x"))
    assert any("in common" in w for w in warned.warnings)


# against measured points ------------------------------------------------------------------------------------------


def _measured(folder: Path, pair: StereoPair, sha256: str, offset: Float, x: Float, y: Float) -> Path:
    """A result of points on a plane, seen off their epipolar lines by what is given."""
    xyz = pair.cam1.back_project_to_plane(np.stack([x, y], axis=-1), point_sys_mm=_in_view(pair)).xyz_mm
    zero = np.zeros(x.shape)
    field = Field(
        x_px=x,
        y_px=y,
        status=np.zeros(x.shape, np.int8),
        xyz_mm=xyz,
        normal_sys=np.zeros_like(xyz),
        theta_rad=zero,
        phi_rad=zero,
        zp_mm=zero,
        zncc=np.ones((*x.shape, 1)),
        epipolar_px=offset,
        noise_grey=zero,
        iterations=np.zeros(x.shape, np.int32),
        covariance=np.broadcast_to(np.eye(3) * 1e-6, (*x.shape, 3, 3)),
    )
    folder.mkdir(exist_ok=True)
    write_field(folder / "step_0000.nc", field, Provenance({"subset_px": 21}, {"calibration": sha256}, "1.0"))
    return folder / "step_0000.nc"


def _in_view(pair: StereoPair) -> Float:
    return shared_points(pair, SIZE, SIZE).mean(axis=0)


def test_measured_points_tell_a_wrong_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loaded = opencv_pair()
    made = convert_calibration(loaded, "opencv", b"")
    file = tmp_path / "own.yaml"
    file.write_bytes(made.data)
    own = load_calibration(file)
    x, y = np.meshgrid(np.arange(300.0, 900.0, 60.0), np.arange(250.0, 750.0, 50.0))
    offset = 0.05 * np.sin(np.arange(x.size).reshape(x.shape))
    path = _measured(tmp_path / "results", own.pair, own.sha256, offset, x, y)
    found = check_against(own, [path], file)
    stored_rms = np.sqrt(np.mean(offset.astype("f4").astype(float) ** 2))
    assert found.this_calibration == found.measured_with
    assert found.this_calibration.rms_px == pytest.approx(stored_rms, rel=1e-6)
    # a camera turned by a milliradian about its axis of sight's normal: seen by the fundamental matrix too
    wrong = StereoPair(
        own.pair.cam1,
        Camera(
            own.pair.cam2.lens,
            RigidTransform(
                Rotation.from_rotvec([1e-3, 0, 0]).as_matrix() @ own.pair.cam2.cam_from_sys.rotation,
                own.pair.cam2.cam_from_sys.translation_mm,
            ),
        ),
    )
    turned = LoadedCalibration(wrong, SIZE, SIZE, "opencv_yaml", "", {})
    seen = check_against(turned, [path], file).this_calibration
    K = own.pair.cam1.lens.kernel_parameters()
    matrix = _matrix(K[1], K[2], K[4], K[5])
    pose = wrong.cam2_from_cam1
    t = pose.translation_mm
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(matrix).T @ cross @ pose.rotation @ np.linalg.inv(matrix)
    xy1 = np.stack([x.ravel(), y.ravel()], axis=1)
    xyz = own.pair.cam1.back_project_to_plane(xy1, point_sys_mm=_in_view(own.pair)).xyz_mm
    lines = cv2.computeCorrespondEpilines(xy1.reshape(-1, 1, 2), 1, F).reshape(-1, 3)
    xy2 = own.pair.cam2.project(xyz).xy
    distance = np.sum(lines[:, :2] * xy2, axis=1) + lines[:, 2]
    assert seen.rms_px == pytest.approx(np.sqrt(np.mean(distance**2)), rel=0.02)
    assert seen.rms_px > 5.0
    other = convert_calibration(opencv_pair(k1=0.01), "opencv", b"")
    (tmp_path / "other.yaml").write_bytes(other.data)
    with pytest.raises(StereorigError) as caught:
        check_against(own, [path], tmp_path / "other.yaml")
    assert caught.value.code == "calibration_changed"
    arguments = ["calibration", "check", str(file), "--points", str(path.parent), "--measured-with", str(file)]
    assert main(arguments) == 0
    assert "measured points of step_0000.nc: 100 points" in capsys.readouterr().out
    assert main(arguments[:-2]) == 1
    assert "option_missing" in capsys.readouterr().err


# command line and API ---------------------------------------------------------------------------------------------


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in.caldat").write_text(CALDAT, encoding="utf-8")
    out = tmp_path / "new" / "out.xml"
    assert main(["calibration", "convert", str(tmp_path / "in.caldat"), str(out), "--to", "vic3d"]) == 0
    printed = capsys.readouterr().out
    assert "fitted, residual" in printed
    assert "lens polynomial is not published" in printed
    report = json.loads((tmp_path / "new" / "out.xml.report.json").read_text(encoding="utf-8"))
    assert report["lens"]["cam1"]["max_px"] > 0.01  # its p1 and p2 have no place there
    assert report["lens"]["cam2"]["max_px"] == 0.0
    assert load_calibration(out).source == "vic3d_xml"
    assert main(["calibration", "convert", str(out), str(tmp_path / "back.json"), "--to", "json"]) == 0
    assert load_calibration(tmp_path / "back.json").pair.baseline_mm == pytest.approx(123.527, abs=0.01)
    assert main(["calibration", "check", str(tmp_path / "missing.xml")]) == 1
    assert "file_missing" in capsys.readouterr().err


def test_over_http(client: httpx.Client) -> None:
    reply = client.post("/api/v1/calibrations:import", files={"file": ("p.xml", VIC3D.encode("latin-1"))})
    assert reply.status_code == 201, reply.text
    assert reply.json()["plan"]["check"]["volume"]["points"] > 100
    url = f"/api/v1/calibrations/{reply.json()['id']}/export"
    for form in FORMS:
        got = client.get(url, params={"format": form})
        assert got.status_code == 200, got.text
        assert "attachment" in got.headers["content-disposition"]
        again = parse_calibration(got.content, name=form)
        assert again.pair.baseline_mm == pytest.approx(123.205, abs=0.01)
        report = client.get(f"{url}/report", params={"format": form}).json()
        assert float(got.headers["x-lens-residual-px"]) == pytest.approx(
            max(v["max_px"] for v in report["lens"].values()), rel=0.01, abs=1e-12
        )
    assert client.get(url, params={"format": "pdf"}).json()["code"] == "invalid_request"
    assert client.get(url.replace("c0", "c9"), params={"format": "dice"}).status_code == 404


PYVALE = "\n".join(
    [f"cam{k}_{name},{value}" for k in (0, 1) for name, value in
     (("fx_px", 6638.6), ("fy_px", 6639.8), ("fs_px", 0.4), ("cx_px", 981.5), ("cy_px", 610.0), ("k1", 0.09),
      ("k2", -2.8), ("p1", 1e-3), ("p2", -2e-3), ("k3", 55.0))]
    + ["tx_mm,121.4", "ty_mm,0.57", "tz_mm,23.2", "theta_deg,0.2", "phi_deg,-18.9", "psi_deg,0.4"]
)  # fmt: skip
DICE_TXT = "\n".join(
    2 * ["981.5 # cx", "610 # cy", "6638.6 # fx", "6639.8 # fy", "0.4 # fs", "0.09 # k1", "-2.8 # k2", "55 # k3"]
    + ["0.2 # alpha", "-18.9 # beta", "0.4 # gamma", "121.4 # tx", "0.57 # ty", "23.2 # tz", "1200", "1920"]
)


@pytest.mark.parametrize(("text", "kind"), [(PYVALE, "pyvale_txt"), (DICE_TXT, "dice_txt")])
def test_text_calibrations_through_both_doors(
    client: httpx.Client, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, kind: str
) -> None:
    file, out = tmp_path / "in.txt", tmp_path / "out.json"
    file.write_text(text, encoding="utf-8")
    assert main(["calibration", "convert", str(file), str(out), "--to", "json"]) == 0
    loaded = load_calibration(out)
    assert loaded.source == kind
    assert loaded.pair.values() == load_calibration(file).pair.values()
    assert main(["calibration", "check", str(file)]) == 0
    printed = capsys.readouterr().out
    assert ("r^2, r^4, r^6" in printed) == (kind == "dice_txt")
    reply = client.post("/api/v1/calibrations:import", files={"file": ("in.txt", text.encode())})
    assert reply.status_code == 201, reply.text
    assert reply.json()["plan"]["check"]["volume"]["max_px"] < 1e-6
    broken = client.post(
        "/api/v1/calibrations:import", files={"file": ("in.txt", text.replace("610", "6x", 1).encode())}
    )
    assert broken.status_code == 422
    assert broken.json()["code"] == "calibration_unreadable"
    still = client.post("/api/v1/calibrations:import", files={"file": ("in.txt", _in_one_place(text).encode())})
    assert still.status_code == 422
    assert still.json()["code"] == "calibration_invalid"
    assert "same position" in still.text


def _in_one_place(text: str) -> str:
    for number in ("121.4", "0.57", "23.2"):
        text = text.replace(number, "0.0")
    return text
