"""Result files say what they hold to outside readers, and come back to the bit."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr

from stereorig.core.errors import FileFormatError, StorageError
from stereorig.core.field.points.patch import PatchChoice
from stereorig.core.field.points.result import Field
from stereorig.core.field.points.starts import Starts
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.status import PointStatus
from stereorig.server.formats.results.netcdf import NewDataset
from stereorig.server.formats.results.reading import read_field, read_head, read_measured
from stereorig.server.formats.results.starts import with_starts, write_starts
from stereorig.server.formats.results.summary import summarise, to_json
from stereorig.server.formats.results.writing import Provenance, write_field

ROWS, COLS = 4, 6
PROVENANCE = Provenance(
    settings={"subset_px": 33, "region": {"rectangle": [1.0, 2.0, 3.0, 4.0]}},
    inputs={"ref1": "ab" * 32, "µ.tif": "cd" * 32},
    software_version="1.2.3",
    step=7,
    extra={"label": "Größe 1"},
)


def a_field(*, motion: bool, curved: bool = False) -> Field:
    rng = np.random.default_rng(5)
    n = 6 if motion else 3
    root = rng.normal(0, 1e-3, (ROWS, COLS, n, n))
    status = np.zeros((ROWS, COLS), np.int8)
    status[0, 0], status[1, 2], status[2, 2] = PointStatus.LOW_CORRELATION, PointStatus.MASKED, PointStatus.EXTRAPOLATED
    failed = (status != PointStatus.OK) & (status != PointStatus.EXTRAPOLATED)

    def numbers(*shape: int) -> np.ndarray:
        values = rng.normal(0, 1, (ROWS, COLS, *shape))
        values[failed] = np.nan
        return values

    covariance = root @ np.swapaxes(root, -1, -2)
    covariance[failed] = np.nan
    x, y = np.meshgrid(np.arange(COLS) * 10.0 + 40.5, np.arange(ROWS) * 10.0 + 60)
    return Field(
        x_px=x,
        y_px=y,
        status=status,
        xyz_mm=numbers(3),
        normal_sys=numbers(3),
        theta_rad=numbers(),
        phi_rad=numbers(),
        zp_mm=numbers(),
        zncc=numbers(3 if motion else 1),
        epipolar_px=numbers(),
        iterations=rng.integers(0, 9, (ROWS, COLS)).astype(np.int32),
        noise_grey=numbers(),
        covariance=covariance,
        uvw_mm=numbers(3) if motion else None,
        rotation_rad=numbers(3) if motion else None,
        stretch=numbers(3) if motion else None,
        curvature_per_mm=numbers(2) if curved else None,
        patch=PatchChoice(patch="quadratic", asked="auto", reason="curved: Gründe", sample=200, plane_error_mm=1.8e-3)
        if curved
        else None,
        cuts=Cuts([[(1.5, 2.0), (30.25, 40.0), (1e-3, 7.0)], [(50.0, 60.0), (50.0, 61.0)]]) if motion else None,
    )


@pytest.mark.parametrize("curved", [False, True], ids=["plane", "quadratic"])
@pytest.mark.parametrize("motion", [False, True], ids=["shape", "displacement"])
def test_what_was_written_comes_back(tmp_path: Path, motion: bool, curved: bool) -> None:
    field = a_field(motion=motion, curved=curved)
    write_field(tmp_path / "step_0007.nc", field, PROVENANCE)
    back = read_field(tmp_path / "step_0007.nc")
    single = {"zncc", "epipolar_px", "noise_grey", "covariance"}  # kept with seven digits
    for item in dataclasses.fields(Field):
        a, b = getattr(field, item.name), getattr(back, item.name)
        if a is None or item.name == "failed_seeds_px":  # of the summary alone
            assert not b
        elif item.name == "patch":
            assert b == a
        elif item.name == "cuts":
            assert [line.tolist() for line in b.lines_px] == [line.tolist() for line in a.lines_px]
        elif item.name in single:
            np.testing.assert_allclose(b, a, rtol=1e-6)
        else:
            np.testing.assert_array_equal(b, a)
            assert b.dtype == a.dtype
    head = read_head(tmp_path / "step_0007.nc")
    assert head.settings == PROVENANCE.settings
    assert head.inputs_sha256 == PROVENANCE.inputs
    assert head.label == "Größe 1"
    assert head.step == 7
    assert head.attributes.get("patch_reason") == ("curved: Gründe" if curved else None)
    assert summarise(field).document()["patch"] == (field.patch.document() if field.patch else None)


@pytest.mark.parametrize("motion", [False, True])
def test_a_later_process_goes_on_with_the_same_numbers(tmp_path: Path, motion: bool) -> None:
    field = a_field(motion=motion)
    # as it was measured, before points outside the calibrated volume are marked
    status = np.where(field.status == PointStatus.EXTRAPOLATED, PointStatus.OK, field.status).astype(np.int8)
    field = dataclasses.replace(field, status=status, starts=Starts(np.random.default_rng(1).random((24, 6)), None))
    write_field(tmp_path / "a.nc", field, PROVENANCE, measured=field)
    write_starts(tmp_path / "starts.npz", field, exact=True)
    read = with_starts(read_measured(tmp_path / "a.nc"), tmp_path / "starts.npz")
    for item in dataclasses.fields(Field):
        a, b = getattr(field, item.name), getattr(read, item.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype, item.name
            np.testing.assert_array_equal(a, b, err_msg=item.name)
    assert read.starts is not None
    assert field.starts is not None
    np.testing.assert_array_equal(read.starts.w, field.starts.w)


def test_xarray_understands_the_file(tmp_path: Path) -> None:
    field = a_field(motion=True)
    write_field(tmp_path / "a.nc", field, PROVENANCE)
    with xr.open_dataset(tmp_path / "a.nc", engine="netcdf4") as data:
        assert data["u_mm"].dims == ("row", "col")
        assert field.uvw_mm is not None
        np.testing.assert_array_equal(data["w_mm"].values, field.uvw_mm[..., 2])
        np.testing.assert_array_equal(data["z_mm"].values, field.xyz_mm[..., 2])
        assert np.isnan(data["u_mm"].values[0, 0])
        expected = {
            "x_px": "pixel",
            "y_px": "pixel",
            "x_mm": "mm",
            "y_mm": "mm",
            "z_mm": "mm",
            "u_mm": "mm",
            "v_mm": "mm",
            "w_mm": "mm",
            "normal_x": "1",
            "normal_y": "1",
            "normal_z": "1",
            "rotation_x_rad": "rad",
            "rotation_y_rad": "rad",
            "rotation_z_rad": "rad",
            "stretch_11": "1",
            "stretch_22": "1",
            "stretch_12": "1",
            "theta_rad": "rad",
            "phi_rad": "rad",
            "zp_mm": "mm",
            "zncc": "1",
            "epipolar_px": "pixel",
            "iterations": "1",
            "status": "1",
            "covariance": "mm2",
            "noise_grey": "count",
            "cut_x_px": "pixel",
            "cut_y_px": "pixel",
            "cut_line": "1",
            **{f"sigma_{a}_mm": "mm" for a in "xyzuvw"},
        }
        assert {name: variable.attrs["units"] for name, variable in data.variables.items()} == expected
        assert all(variable.attrs["long_name"] for variable in data.variables.values())
        assert data["zncc"].dims == ("row", "col", "comparison")
        meanings = dict(
            zip(data["status"].attrs["flag_values"], data["status"].attrs["flag_meanings"].split(), strict=True)
        )
        assert meanings[int(data["status"][0, 0])] == "low_correlation"
        assert {int(v): m for v, m in meanings.items()} == {s.value: s.name.lower() for s in PointStatus}
        np.testing.assert_allclose(data["sigma_w_mm"], np.sqrt(data["covariance"][..., -1]), rtol=1e-6)
        assert json.loads(data.attrs["settings"])["subset_px"] == 33
        assert data.attrs["software_version"] == "1.2.3"


def test_the_file_keeps_to_the_classic_model(tmp_path: Path) -> None:
    # MATLAB's ncread stumbles over variable-length strings, user types and groups
    write_field(tmp_path / "a.nc", a_field(motion=True), PROVENANCE)
    with netCDF4.Dataset(str(tmp_path / "a.nc")) as dataset:
        assert dataset.data_model == "NETCDF4_CLASSIC"
        assert {str(v.dtype) for v in dataset.variables.values()} == {"float64", "float32", "int32", "int8"}
        assert not dataset.groups


def test_a_new_files_definitions_stay_open_until_all_are_made(tmp_path: Path) -> None:
    # closing them takes half a millisecond each time, and the library does it after every one if it may
    with NewDataset(str(tmp_path / "a.nc"), "w", format="NETCDF4_CLASSIC") as dataset:
        dataset.createDimension("row", 2)
        early, late = (dataset.createVariable(name, "f4", ("row",)) for name in ("early", "late"))
        early.units = "mm"
        with pytest.raises(RuntimeError, match="define mode"):
            early[...] = [1.0, 2.0]
        dataset.put(early, [1.0, 2.0])
        dataset.put(late, [3.0, 4.0])
        dataset.finish()
    with netCDF4.Dataset(str(tmp_path / "a.nc")) as dataset:
        assert dataset.data_model == "NETCDF4_CLASSIC"
        assert dataset["early"].units == "mm"
        np.testing.assert_array_equal(dataset["early"], [1.0, 2.0])
        np.testing.assert_array_equal(dataset["late"], [3.0, 4.0])


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.nc"
    write_field(path, a_field(motion=False), PROVENANCE)
    before = path.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(StorageError) as caught:
        write_field(path, a_field(motion=True), PROVENANCE)
    assert caught.value.code == "storage_failed"
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.nc"
    with pytest.raises(FileFormatError) as caught:
        read_field(path)
    assert caught.value.code == "file_missing"
    write_field(path, a_field(motion=False), PROVENANCE)
    data = path.read_bytes()
    for damaged in (b"", b"text", data[: len(data) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError) as caught:
            read_field(path)
        assert caught.value.code == "file_unreadable"
    for version, code in ((None, "file_unreadable"), (1, "format_too_old"), (99, "format_too_new")):
        with netCDF4.Dataset(str(path), "w") as dataset:
            if version:
                dataset.format_version = version
        with pytest.raises(FileFormatError) as caught:
            read_field(path)
        assert caught.value.code == code
    path = tmp_path / "b.nc"
    path.write_bytes(data)
    with netCDF4.Dataset(str(path), "a") as dataset:
        dataset.renameVariable("zncc", "other")
    with pytest.raises(FileFormatError, match="zncc"):
        read_field(path)


def test_the_summary_counts_and_measures() -> None:
    field = a_field(motion=True)
    summary = summarise(field).document()
    assert summary["points"] == ROWS * COLS - 1  # one is masked
    assert summary["valid"] == ROWS * COLS - 2
    assert summary["status"] == {"ok": ROWS * COLS - 3, "masked": 1, "low_correlation": 1, "extrapolated": 1}
    valid = field.epipolar_px[np.isfinite(field.epipolar_px)]
    assert summary["epipolar_offset_rms_px"] == pytest.approx(np.sqrt(np.mean(valid**2)))
    assert summary["epipolar_residual_rms_px"] == pytest.approx(np.sqrt(np.mean(valid**2)) / 2)
    assert summary["displacement_mm"]["w"]["max"] == pytest.approx(np.nanmax(field.uvw_mm[..., 2]))  # type: ignore[index]
    json.loads(to_json(summary))


def test_plane_residual_of_a_tilted_plane_with_known_noise() -> None:
    field = a_field(motion=False)
    i, j = np.meshgrid(np.arange(ROWS), np.arange(COLS), indexing="ij")
    off = 0.01 * (-1.0) ** (i + j)  # alternating: orthogonal to every plane on an even grid
    normal = np.array([0.6, 0.0, 0.8])
    a, b = np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0])
    xyz = 5.0 * i[..., None] * a + 5.0 * j[..., None] * b + off[..., None] * normal + 100.0
    whole = dataclasses.replace(field, xyz_mm=xyz, status=np.zeros((ROWS, COLS), np.int8))
    assert summarise(whole).plane_residual_rms_mm == pytest.approx(0.01, rel=1e-3)


def test_a_field_without_valid_points_has_a_summary() -> None:
    field = dataclasses.replace(a_field(motion=True), status=np.full((ROWS, COLS), PointStatus.NOT_SEEDED, np.int8))
    summary = json.loads(to_json(summarise(field).document()))
    assert summary["valid"] == 0
    assert summary["epipolar_offset_rms_px"] is None
    assert summary["displacement_mm"] == {"u": None, "v": None, "w": None}
