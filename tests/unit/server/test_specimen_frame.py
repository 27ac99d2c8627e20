"""The specimen's frame: a tension along the image's vertical, the system frame at 45 degrees in the image."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import netCDF4
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError, RegionError
from stereorig.core.gauge.align import align_given, aligned
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.formats.results.reading import read_field, read_head
from stereorig.server.formats.results.strain import read_strain
from stereorig.server.formats.results.writing import Provenance, write_field
from stereorig.server.results.gauges.framed import write_framed
from stereorig.server.results.gauges.frames import SPECIMEN, frame_asked, frame_of_test
from stereorig.server.results.gauges.readings import read_gauges
from stereorig.server.results.gauges.request import Alignment, AreaGauge, GaugeRequest, PlaneAlignment, PointGauge
from stereorig.server.workflows.analysis.framed import FramedResults
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import UPRIGHT
from tests.support.gauge_field import SUBSET, make_field
from tests.support.requirements import ROOT
from tests.support.tension import LATERAL, SHIFT, SYS_FROM_IMAGE, TENSION, pulled, shape

# the file holds positions and displacements as float32: 3e-6 of 2 um between neighbours 0.14 mm apart
TOLERANCE = 3e-6


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("strip")
    made = []
    for n, motion in enumerate((None, pulled)):
        field = make_field(motion, shape=shape)
        strain = None if motion is None else surface_strain(field, StrainOptions(window=5), subset_px=SUBSET)
        given = Provenance({"subset_px": SUBSET}, {"calibration": "aa", "reference_cam1": "bb"}, "1", step=n)
        write_field(folder / f"step_{n:04d}.nc", field, given, strain)
        made.append(folder / f"step_{n:04d}.nc")
    return made


def mean_strain(path: Path) -> Float:
    strain = read_strain(path)
    assert strain is not None
    return np.asarray(np.nanmean(strain.strain, axis=(0, 1)))


def test_the_files_stay_in_the_system_frame_and_the_specimens_reads_the_tension_along_y(
    files: list[Path], tmp_path: Path
) -> None:
    before = files[1].read_bytes()
    made = write_framed(files, SPECIMEN, tmp_path / "out")
    assert files[1].read_bytes() == before
    turned = 0.5 * (TENSION + LATERAL)
    # the tilt of 4 degrees turns X_sys, laid into the surface, by 0.07 degrees: 2.4e-3 of the shear of 1.3e-3
    assert mean_strain(files[1]) == pytest.approx([turned, turned, 0.5 * (LATERAL - TENSION)], abs=5e-6)
    assert mean_strain(made[1]) == pytest.approx([LATERAL, TENSION, 0.0], abs=TOLERANCE)
    field = read_field(made[0])
    # X runs to the right and Y down the image; the origin is the middle of the points
    assert np.diff(field.xyz_mm[..., 0], axis=1) == pytest.approx(0.14, abs=1e-5)
    assert np.diff(field.xyz_mm[..., 1], axis=0) == pytest.approx(0.14, abs=1e-5)
    assert np.abs(field.xyz_mm[..., 2]).max() < 1e-5


def test_a_file_in_the_specimens_frame_says_so_and_names_no_axis_of_the_system(
    files: list[Path], tmp_path: Path
) -> None:
    made = write_framed(files, SPECIMEN, tmp_path / "out")
    assert read_head(made[1]).frame.startswith("aligned by plane, X along camera 1's image rows; before: sys")
    with netCDF4.Dataset(made[1]) as data:
        assert data["w_mm"].long_name.endswith("Z_frame component")
        assert not [v.long_name for v in data.variables.values() if "_sys" in getattr(v, "long_name", "")]
        assert "_sys" not in data.strain_axes


def test_gauges_read_strain_along_the_frames_axes(files: list[Path]) -> None:
    names = ["exx", "eyy", "exy", "e1", "sigma_eyy"]
    whole, point = AreaGauge(name="all"), PointGauge(name="p", xy_px=(90.0, 100.0))
    request = GaugeRequest(areas=[whole], points=[point], variables=names, align=SPECIMEN)
    step = read_gauges(files, request).steps[1]
    area, at = step.areas[0].values, step.points[0].values
    for name, value in (("exx", LATERAL), ("eyy", TENSION), ("exy", 0.0), ("e1", TENSION)):
        assert area[name].mean == pytest.approx(value, abs=TOLERANCE)
        assert at[name].value == pytest.approx(value, abs=TOLERANCE)
    assert at["eyy"].sigma is not None
    assert at["eyy"].sigma > 0.0


RIGHT = SYS_FROM_IMAGE[:, 0]
FRAMES: list[dict[str, object]] = [
    {"kind": "plane", "x_direction": RIGHT.tolist()},
    {"kind": "plane", "x_line_px": [[47.0, 100.0], [130.0, 100.0]]},
    {"kind": "3-2-1", "positions_px": [[50, 70], [130, 70], [90, 140], [50, 100], [130, 100], [90, 100]]},
    {"kind": "given", "rotation": SYS_FROM_IMAGE.T.tolist(), "origin_mm": SHIFT.tolist()},
]


@pytest.mark.parametrize("frame", FRAMES, ids=["direction", "line", "3-2-1", "given"])
def test_every_way_to_lay_the_frame_gives_the_same_strain(
    files: list[Path], tmp_path: Path, frame: dict[str, object]
) -> None:
    asked = frame_asked(json.dumps(frame), SPECIMEN)
    assert asked is not None
    made = write_framed(files, asked, tmp_path / "out")
    assert mean_strain(made[1]) == pytest.approx([LATERAL, TENSION, 0.0], abs=TOLERANCE)


def test_shear_of_a_specimen_askew_in_the_picture_is_the_cameras_roll_and_goes_with_a_line_along_it(
    tmp_path: Path,
) -> None:
    """The simulated strip is pulled along its own axis; camera 1 of that rig is rolled against it by design."""
    camera = SimRig.from_toml(ROOT / "config" / "sim_paper.toml").cam1.camera
    along, across = UPRIGHT.rotation[:, 1], UPRIGHT.rotation[:, 0]
    stretch = np.eye(3) + 2000e-6 * np.outer(along, along) - 660e-6 * np.outer(across, across)
    made = []
    for n, motion in enumerate((None, lambda x: np.asarray(x @ stretch))):
        field = make_field(motion, shape=lambda x, y: camera.back_project_to_plane(np.stack([x, y], axis=-1)).xyz_mm)
        strain = None if motion is None else surface_strain(field, StrainOptions(window=5), subset_px=SUBSET)
        given = Provenance({"subset_px": SUBSET}, {"calibration": "aa", "reference_cam1": "bb"}, "1", step=n)
        write_field(tmp_path / f"step_{n:04d}.nc", field, given, strain)
        made.append(tmp_path / f"step_{n:04d}.nc")
    # the direction of a row through the middle of the points, on the strip
    ends = camera.back_project_to_plane([[95.0, 105.5], [97.0, 105.5], [96.0, 104.5], [96.0, 106.5]]).xyz_mm
    right = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    roll = np.arctan2(right @ along, right @ across)
    assert 0.005 < abs(roll) < 0.05
    green = 0.5 * (stretch @ stretch - np.eye(3))
    down = np.cross([0.0, 0.0, 1.0], right)
    down *= np.sign(down @ (ends[3] - ends[2]))  # as Y runs in the picture
    expected = [right @ green @ right, down @ green @ down, right @ green @ down]
    assert abs(expected[2]) > 20e-6
    assert mean_strain(write_framed(made, SPECIMEN, tmp_path / "rows")[1]) == pytest.approx(expected, abs=TOLERANCE)
    own = frame_asked(json.dumps({"kind": "plane", "x_direction": across.tolist()}), SPECIMEN)
    assert own is not None
    unsheared = [across @ green @ across, along @ green @ along, 0.0]
    assert mean_strain(write_framed(made, own, tmp_path / "own")[1]) == pytest.approx(unsheared, abs=TOLERANCE)


def test_a_frame_is_named_system_specimen_or_written_out() -> None:
    of_test: Alignment = PlaneAlignment(kind="plane", x_direction=(0.0, 1.0, 0.0))
    assert frame_asked(None, of_test) is None
    assert frame_asked("system", of_test) is None
    assert frame_asked("specimen", of_test) == of_test
    assert frame_of_test(None) == SPECIMEN
    assert frame_of_test({"kind": "plane", "x_direction": [0, 1, 0]}) == of_test
    with pytest.raises(InputError, match="names no frame") as refused:
        frame_asked('{"kind": "cube"}', of_test)
    assert refused.value.code == "frame_invalid"


def test_a_rotation_that_is_none_is_refused(files: list[Path], tmp_path: Path) -> None:
    mirrored = np.diag([1.0, 1.0, -1.0]).tolist()
    asked = frame_asked(json.dumps({"kind": "given", "rotation": mirrored}), SPECIMEN)
    assert asked is not None
    with pytest.raises(RegionError, match="right-handed"):
        write_framed(files, asked, tmp_path / "out")


def test_a_step_in_a_frame_is_made_once(files: list[Path], tmp_path: Path) -> None:
    kept = FramedResults(tmp_path / "kept")
    first = kept.file(files[1], SPECIMEN, files[0])
    assert kept.file(files[1], SPECIMEN, files[0]) == first
    assert mean_strain(first) == pytest.approx([LATERAL, TENSION, 0.0], abs=TOLERANCE)
    other = kept.file(files[1], PlaneAlignment(kind="plane"), files[0])
    assert other != first


def test_a_variance_that_vanishes_stays_zero_and_turns_no_sigma_into_nothing() -> None:
    field = make_field(None, shape=shape)
    ray = np.array([0.3, -0.1, 0.95])
    field = replace(field, covariance=np.broadcast_to(1e-6 * np.outer(ray, ray), (*field.shape, 3, 3)).copy())
    for degrees in range(0, 360, 7):
        R = Rotation.from_euler("xyz", [degrees, 2 * degrees, 5.0], degrees=True).as_matrix()
        assert np.isfinite(aligned(field, align_given(R, [0.0, 0.0, 0.0])).sigma_mm).all()
    # the axes' own first row along the ray: nothing is left across it
    across = np.linalg.svd(ray[None])[2]
    across[0] *= np.sign(np.linalg.det(across))
    sigma = aligned(field, align_given(across, [0.0, 0.0, 0.0])).sigma_mm
    assert np.nanmax(sigma[..., 1:]) < 1e-9
