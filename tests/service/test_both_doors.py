"""One folder measured by the service, by the command line and by the library: the same to the last bit."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import xarray

import stereorig as dic
from stereorig.core.names import CAMERAS
from stereorig.core.status import PointStatus
from stereorig.server.cli import main
from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.files import recorded_sha256
from stereorig.server.formats.images import encode_tiff
from stereorig.server.workflows.service import Service
from tests.support.calibrated_volume import content
from tests.support.copied_tests import CONFIG, TIME
from tests.support.field_bench import take
from tests.support.service_rig import served, wait_for_job

API = "/api/v1"
STEPS = 5
ROI = [40.0, 40.0, 224.0, 184.0]
TIMES = {"created", "cam1_file", "cam2_file", "label", "test_step"}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a test: a plate that turns, half of it outside the calibrated volume."""
    folder = tmp_path_factory.mktemp("doors") / "data"
    test = folder / "tests" / "t000001-abcdef"
    (test / "analyses").mkdir(parents=True)
    (folder / "format.json").write_text('{"format": 1}')
    (test / "calibration.json").write_text(json.dumps(content()))
    for n in range(STEPS):
        step = test / "steps" / f"{n:04d}"
        step.mkdir(parents=True)
        sha256 = {}
        for cam, image in zip(
            ("cam1", "cam2"), take("block", motion=(0.1 * n, 0, 0, 0, 0, 0.12 * n), seed=n), strict=True
        ):
            (step / f"{cam}.tif").write_bytes(encode_tiff(image))
            sha256[cam] = hashlib.sha256((step / f"{cam}.tif").read_bytes()).hexdigest()
        record = {
            "label": "",
            "load_n": None,
            "source": "import",
            "captured_utc": "2026-03-01T12:00:00Z",
            "quality": {},
        }
        (step / "step.json").write_text(json.dumps({"n": n, "test_id": test.name, "sha256": sha256, **record}))
    document = {"id": test.name, "name": "copied", "calibration_id": None, "created_utc": TIME}
    (test / "test.json").write_text(json.dumps(document))
    return folder


def by_the_service(data: Path, body: dict[str, Any]) -> Path:
    service = Service(parse_config(CONFIG), data).start()
    try:
        with served(service) as client:
            made = client.post(f"{API}/tests/t000001-abcdef/analyses", json=body)
            assert made.status_code == 202, made.text
            ended = wait_for_job(client, made.json()["job"])
            assert ended["state"] == "succeeded", ended["problem"]
            return data / "tests" / "t000001-abcdef" / "analyses" / str(made.json()["analysis_id"])
    finally:
        service.close()


def by_the_library(data: Path, settings: dict[str, Any]) -> list[dic.Result]:
    test = data / "tests" / "t000001-abcdef"
    pairs = [[dic.read_image(test / "steps" / f"{n:04d}" / f"{cam}.tif") for cam in CAMERAS] for n in range(STEPS)]
    measurement = dic.Measurement(test / "calibration.json", *pairs[0], dic.AnalysisSettings.model_validate(settings))
    return [measurement.shape, *(measurement.displacement(*pair) for pair in pairs[1:])]


def same_as_its_file(result: dic.Result, path: Path) -> None:
    with xarray.open_dataset(path) as stored:
        made = result.dataset
        # what later steps go on from is in the file alone
        assert set(made.variables) == {name for name in stored.variables if not str(name).startswith("measured_")}
        for name in made.variables:
            if made[name].dtype == object:  # text, whose bytes are addresses
                assert made[name].values.tolist() == stored[name].values.tolist(), (path.name, name)
            else:
                assert made[name].values.tobytes() == stored[name].values.tobytes(), (path.name, name)
            assert made[name].attrs.keys() == stored[name].attrs.keys()
            assert made[name].dims == stored[name].dims
        for name in ("w_mm", "sigma_w_mm", "exx", "sigma_exx") if result.step else ("z_mm", "sigma_z_mm"):
            found = np.asarray(result[name], dtype=made[name].dtype)
            assert found.tobytes() == stored[name].values.tobytes(), (path.name, name)


@pytest.mark.normal_depth("always")
@pytest.mark.parametrize("update", ["never", "always"])
def test_a_folder_measured_through_both_doors_is_the_same_to_the_last_bit(
    data: Path, tmp_path: Path, update: str
) -> None:
    settings = {"subset_px": 25, "spacing_px": 12, "patch": "affine", "reference_update": update, "smoothing_window": 3}
    region = {"rectangle": ROI, "cracks": [[[60, 60], [100, 60]]]}
    one = by_the_service(data, {**settings, "region": region, "strain": {"window": 5}})
    command = [
        "measure",
        str(data / "tests" / "t000001-abcdef"),
        "--out",
        str(tmp_path),
        "--strain",
        "5",
        "--smooth",
        "3",
    ]
    command += ["--roi", ",".join(map(str, ROI)), "--crack", "60,60,100,60", "--subset", "25", "--step", "12"]
    assert main([*command, "--patch", "affine", "--reference-update", update]) == 0
    for n, result in enumerate(by_the_library(data, {**settings, "region": region, "strain": {"window": 5}})):
        same_as_its_file(result, tmp_path / f"step_{n:04d}.nc")
    outside, later = 0, set()
    for n in range(STEPS):
        with netCDF4.Dataset(one / f"step_{n:04d}.nc") as a, netCDF4.Dataset(tmp_path / f"step_{n:04d}.nc") as b:
            assert list(a.variables) == list(b.variables)
            for name in a.variables:
                a[name].set_auto_mask(False)
                b[name].set_auto_mask(False)
                assert np.asarray(a[name][...]).tobytes() == np.asarray(b[name][...]).tobytes(), (n, name)
                assert a[name].__dict__.keys() == b[name].__dict__.keys(), (n, name)
            assert set(a.ncattrs()) ^ set(b.ncattrs()) <= TIMES
            for name in set(a.ncattrs()) & set(b.ncattrs()) - TIMES:
                assert np.array_equal(a.getncattr(name), b.getncattr(name)), (n, name)
            outside += int((a["status"][...] == PointStatus.EXTRAPOLATED).sum())
            later |= set() if n == 0 else {int(a.reference_step)}
    assert outside > 20
    # with always, each step is matched against the one before, whose covariance it inherits
    assert later == ({0} if update == "never" else set(range(STEPS - 1)))
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (one, tmp_path)]
    assert summaries[0]["settings"] == summaries[1]["settings"]
    assert summaries[0].keys() - summaries[1].keys() == {"analysis_id", "job_id"}
    timed = {"compute_s", "write_s", "wall_s", "seconds", "cam1", "cam2", "sha256"}
    for x, y in zip(*(s["steps"] for s in summaries), strict=True):
        assert {k: v for k, v in x.items() if k not in timed} == {k: v for k, v in y.items() if k not in timed}


def test_smoothing_changes_nothing_that_later_references_go_on_from(data: Path, tmp_path: Path) -> None:
    """Each step is matched against the one before: through either door what it hands on is what was measured."""
    settings = {"subset_px": 25, "spacing_px": 12, "patch": "affine", "reference_update": "always", "strain": None}
    one = by_the_service(data, {**settings, "region": {"rectangle": ROI}, "smoothing_window": 5})
    command = ["measure", str(data / "tests" / "t000001-abcdef"), "--roi", ",".join(map(str, ROI)), "--strain", "off"]
    command += ["--subset", "25", "--step", "12", "--patch", "affine", "--reference-update", "always"]
    assert main([*command, "--out", str(tmp_path / "smooth"), "--smooth", "5"]) == 0
    assert main([*command, "--out", str(tmp_path / "plain")]) == 0
    smoothed = 0.0
    for n in range(1, STEPS):
        name = f"step_{n:04d}.nc"
        with xarray.open_dataset(tmp_path / "plain" / name) as plain:
            for folder in (one, tmp_path / "smooth"):
                with xarray.open_dataset(folder / name) as found:
                    for key in ("status", "zncc", "x_mm", "y_mm", "z_mm", "rotation_x_rad", "iterations"):
                        if key in plain:
                            assert found[key].values.tobytes() == plain[key].values.tobytes(), (folder, n, key)
                    for axis in "uvw":
                        measured = found[f"measured_{axis}_mm"].values
                        expected = plain[f"{axis}_mm"].values
                        assert np.array_equal(measured.astype(expected.dtype), expected, equal_nan=True), (folder, n)
                        smoothed = max(smoothed, float(np.nanmax(np.abs(found[f"{axis}_mm"].values - expected))))
    assert smoothed > 1e-5  # mm: the smoothing itself does something here


def test_dense_fields_are_the_same_through_both_doors(data: Path, tmp_path: Path) -> None:
    settings = {"subset_px": 25, "spacing_px": 12, "patch": "affine", "reference_update": "never", "strain": None}
    one = by_the_service(data, {**settings, "region": {"rectangle": ROI}, "dense_step_px": 3})
    command = ["measure", str(data / "tests" / "t000001-abcdef"), "--out", str(tmp_path), "--strain", "off"]
    command += ["--roi", ",".join(map(str, ROI)), "--subset", "25", "--step", "12", "--patch", "affine"]
    assert main([*command, "--reference-update", "never", "--dense", "3"]) == 0
    for n in range(STEPS):
        name = f"dense/step_{n:04d}.nc"
        assert recorded_sha256(one / name) == hashlib.sha256((one / name).read_bytes()).hexdigest()
        with netCDF4.Dataset(one / name) as a, netCDF4.Dataset(tmp_path / name) as b:
            assert a.method == b.method == "dense, shared windows"
            assert a["status"].shape[0] == 49
            assert (a["status"][...] == PointStatus.OK).mean() + (
                a["status"][...] == PointStatus.EXTRAPOLATED
            ).mean() > 0.8
            for variable in a.variables:
                assert np.asarray(a[variable][...]).tobytes() == np.asarray(b[variable][...]).tobytes(), (n, variable)
