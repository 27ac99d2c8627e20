"""Channels of the steps are in gauges, every export and the report; a load frame's record gives them by time."""

from __future__ import annotations

import io
import json
import re
import shutil
import zipfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import httpx
import netCDF4
import numpy as np
import pandas as pd
import pytest
import scipy.io
import xarray

from stereorig.core.field.points.smoothing_record import METHOD
from stereorig.server.cli.main import main
from stereorig.server.exports.request import ExportRequest
from stereorig.server.exports.run import export
from stereorig.server.exports.source import find_source
from stereorig.server.formats.gauges.matlab import gauges_mat
from stereorig.server.formats.gauges.table import gauges_csv
from stereorig.server.results.gauges.readings import read_gauges
from stereorig.server.results.gauges.request import GaugeRequest
from tests.support.export_results import write_results
from tests.support.problems import assert_problem
from tests.support.service_rig import new_test

API = "/api/v1"
STEPS = 3
DENSE = '{"step_px": 3, "window_px": 21, "spacing_px": 7.0, "variance_ratio": 4.0}'
TIMES = [f"2026-03-01T12:00:{second:02d}.000000Z" for second in (0, 10, 40)]
CHANNELS = [{"force_kn": 0.0, 'odd "name" °C/$': 20.0}, {"force_kn": 1.5}, {"force_kn": 3.0, 'odd "name" °C/$': 21.5}]


@pytest.fixture
def test_folder(tmp_path: Path) -> Path:
    """A test with an analysis of three steps, whose records have times and channels."""
    folder = tmp_path / "t000001-abcdef"
    write_results(folder / "analyses" / "a000001-000001", STEPS)
    for n in range(STEPS):
        step = folder / "steps" / f"{n:04d}"
        step.mkdir(parents=True, exist_ok=True)
        record = {"n": n, "source": "import", "timestamp_utc": TIMES[n], "load_n": 100.0 * n, "channels": CHANNELS[n]}
        record["channel_u"] = {"force_kn": 0.25}
        (step / "step.json").write_text(json.dumps(record), encoding="utf-8")
    return folder


def exported(folder: Path, form: str, out: Path) -> list[Path]:
    out.mkdir(exist_ok=True)
    return list(export(find_source(folder), ExportRequest(form), out))  # type: ignore[arg-type]


def test_csv_says_channels_units_and_time_in_its_last_column(test_folder: Path, tmp_path: Path) -> None:
    about = json.loads(pd.read_csv(exported(test_folder, "csv", tmp_path)[1]).about[0])
    assert about["channels"] == {"force_kn": 1.5}
    assert about["channel_units"] == {"force_kn": "kN"}
    assert about["channel_u"] == {"force_kn": 0.25}
    assert about["time_s"] == 10.0
    assert about["load_n"] == 100.0


def test_netcdf_hdf5_and_mat_have_them_as_numbers(test_folder: Path, tmp_path: Path) -> None:
    files = exported(test_folder, "nc", tmp_path / "nc")
    with xarray.open_dataset(files[2], engine="netcdf4") as one:
        assert (float(one["channel_force_kn"]), one["channel_force_kn"].attrs["units"]) == (3.0, "kN")
        assert (float(one["time_s"]), float(one["load_n"])) == (40.0, 200.0)
        assert float(one["channel_odd_name_C_"]) == 21.5
        assert (float(one["channel_force_kn_u"]), one["channel_force_kn_u"].attrs["units"]) == (0.25, "kN")
    (stacked,) = exported(test_folder, "h5", tmp_path / "h5")
    with h5py.File(stacked) as data:
        np.testing.assert_array_equal(data["channel_force_kn"][...], [0.0, 1.5, 3.0])
        np.testing.assert_array_equal(data["channel_odd_name_C_"][...], [20.0, np.nan, 21.5])
        np.testing.assert_array_equal(data["time_s"][...], [0.0, 10.0, 40.0])
        assert data["time_s"].attrs["units"] in (b"s", "s")
    (mat,) = exported(test_folder, "mat", tmp_path / "mat")
    held = scipy.io.loadmat(mat, simplify_cells=True)
    np.testing.assert_array_equal(held["channel_force_kn"], [0.0, 1.5, 3.0])
    np.testing.assert_array_equal(held["time_s"], [0.0, 10.0, 40.0])
    assert (held["load_n"][1], held["channel_force_kn_u"][1]) == (100.0, 0.25)
    assert held["about"]["units"]["channel_force_kn"] == "kN"


def test_the_time_series_for_paraview_goes_by_seconds(test_folder: Path, tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    exported(test_folder, "vtu", tmp_path)
    (series,) = tmp_path.glob("*.pvd")
    reader = pyvista.get_reader(series)
    assert list(reader.time_values) == [0.0, 10.0, 40.0]
    reader.set_active_time_value(10.0)
    grid = reader.read()[0]
    assert grid.field_data["force_kn"][0] == 1.5
    assert grid.field_data["force_kn_u"][0] == 0.25
    assert grid.field_data["TimeValue"][0] == 10.0


def test_a_time_that_is_not_known_leaves_the_steps_numbers(test_folder: Path, tmp_path: Path) -> None:
    record = test_folder / "steps" / "0001" / "step.json"
    document = json.loads(record.read_text(encoding="utf-8"))
    record.write_text(json.dumps({**document, "timestamp_utc": None}), encoding="utf-8")
    exported(test_folder, "vtu", tmp_path)
    (series,) = tmp_path.glob("*.pvd")
    assert re.findall(r'timestep="([^"]*)"', series.read_text()) == ["0", "1", "2"]


def test_gauges_have_them_beside_each_reading(test_folder: Path) -> None:
    files = sorted((test_folder / "analyses" / "a000001-000001").glob("step_*.nc"))
    readings = read_gauges(files, GaugeRequest.model_validate({"areas": [{"name": "all"}]}))
    document = readings.document()
    assert document["channel_units"]["force_kn"] == "kN"  # type: ignore[index]
    assert [step["channels"]["force_kn"] for step in document["steps"]] == [0.0, 1.5, 3.0]  # type: ignore[attr-defined]
    assert [step["time_s"] for step in document["steps"]] == [0.0, 10.0, 40.0]  # type: ignore[attr-defined]
    table = pd.read_csv(io.BytesIO(gauges_csv(readings)), comment="#")
    assert sorted(set(table["force_kn"])) == [0.0, 1.5, 3.0]
    assert set(table.loc[table["step"] == 2, 'odd "name" °C/$']) == {21.5}
    assert set(table["force_kn_u"]) == {0.25}
    assert table.loc[table["step"] == 1, 'odd "name" °C/$'].isna().all()
    held = scipy.io.loadmat(io.BytesIO(gauges_mat(readings)), simplify_cells=True)["gauges"]
    assert set(held["force_kn"]) == {0.0, 1.5, 3.0}


@pytest.mark.parametrize("dense", [False, True])
def test_an_export_in_the_specimens_axes_and_one_of_dense_fields_have_them_too(
    test_folder: Path, tmp_path: Path, dense: bool
) -> None:
    folder = test_folder / "analyses" / "a000001-000001"
    if dense:
        shutil.copytree(folder, folder / "dense")
        for path in (folder / "dense").glob("*.nc"):
            with netCDF4.Dataset(path, "a") as file:
                file.setncatts({"method": METHOD, "dense": DENSE, "neighbours": "by shared pixels"})
    for form, asked in (("csv", ["--frame", "specimen"]), ("h5", ["--frame", "specimen"]), ("nc", [])):
        out = tmp_path / form
        found = str(folder / "dense" if dense else folder)
        assert main(["export", found, "--format", form, "--out", str(out), *asked]) == 0
    (table,) = (tmp_path / "csv").glob("*step_0001*")
    about = json.loads(pd.read_csv(table).about[0])
    assert about["channels"] == {"force_kn": 1.5}
    # a dense field says that it is one, by its name too
    assert (about.get("method") == METHOD, "a000001-000001_dense_step" in table.name) == (dense, dense)
    with h5py.File(next((tmp_path / "h5").glob("*.h5"))) as data:
        np.testing.assert_array_equal(data["channel_force_kn"][...], [0.0, 1.5, 3.0])
        np.testing.assert_array_equal(data["time_s"][...], [0.0, 10.0, 40.0])
    (stored,) = (tmp_path / "nc").glob("*step_0002*")
    with xarray.open_dataset(stored, engine="netcdf4") as one:
        assert float(one["channel_force_kn"]) == 3.0


def test_results_of_no_test_have_none(test_folder: Path, tmp_path: Path) -> None:
    alone = tmp_path / "alone" / "results"
    shutil.copytree(test_folder / "analyses" / "a000001-000001", alone)
    assert "channels" not in json.loads(pd.read_csv(exported(alone, "csv", tmp_path / "csv")[1]).about[0])
    stored, copy = alone / "step_0001.nc", exported(alone, "nc", tmp_path / "nc")[1]
    assert copy.read_bytes() == stored.read_bytes()


# a load frame's record ------------------------------------------------------------------------------------------------


@pytest.fixture
def captured(client: httpx.Client) -> tuple[str, list[float]]:
    """A test with two steps, and the times at which they were taken."""
    test_id = new_test(client)
    steps = [client.post(f"{API}/tests/{test_id}/steps", json={"channels": {"own_v": 1.0}}).json() for _ in range(2)]
    times = [datetime.fromisoformat(step["captured_utc"]).timestamp() for step in steps]
    return test_id, times


def record(times: list[float], begin: float) -> bytes:
    """The force is 10 kN a second from the record's beginning."""
    rows = [f"{t - begin:.6f},{10.0 * (t - begin):.6f},7" for t in np.arange(times[0] - 0.5, times[-1] + 0.5, 0.05)]
    return "\n".join(["Time (s),Force (kN),Valve", *rows]).encode()


def send(client: httpx.Client, test_id: str, content: bytes, **form: object) -> httpx.Response:
    data = {name: str(value) for name, value in form.items()}
    return client.post(f"{API}/tests/{test_id}/channels:import", files={"file": ("frame.csv", content)}, data=data)


def test_a_record_gives_each_step_its_channels_and_load(
    client: httpx.Client, captured: tuple[str, list[float]]
) -> None:
    test_id, times = captured
    begin = times[0] - 2.0
    answer = send(client, test_id, record(times, begin), at_step=0, at_s=2.0, load="force_kn")
    assert answer.status_code == 200, answer.text
    assert answer.json()["channels"] == {"force_kn": "kN", "valve": "1"}
    for n, taken in enumerate(times):
        step = client.get(f"{API}/tests/{test_id}/steps/{n}").json()
        # six digits of the record's times, and of its forces
        assert step["channels"]["force_kn"] == pytest.approx(10.0 * (taken - begin), abs=2e-5)
        assert step["load_n"] == pytest.approx(1e3 * step["channels"]["force_kn"])
        assert step["channels"]["own_v"] == 1.0
    listed = client.get(f"{API}/tests/{test_id}/steps").json()["steps"]
    assert listed[1]["load_n"] == client.get(f"{API}/tests/{test_id}/steps/1").json()["load_n"]
    # the same record again changes nothing; another one is not taken by accident
    assert send(client, test_id, record(times, begin), at_step=0, at_s=2.0).status_code == 200
    other = send(client, test_id, record(times, begin), at_step=0, at_s=2.01)
    assert "force_kn" in str(assert_problem(other, 422, "channels_there")["detail"])
    assert send(client, test_id, record(times, begin), at_step=0, at_s=2.01, replace=True).status_code == 200


def test_the_clock_of_a_record_can_be_named_in_utc(client: httpx.Client, captured: tuple[str, list[float]]) -> None:
    test_id, times = captured
    begin = times[0] - 2.0
    starts = datetime.fromtimestamp(begin, UTC).isoformat()
    found = send(client, test_id, record(times, begin), starts_utc=starts).json()["steps"]
    assert found[0]["time_s"] == pytest.approx(2.0, abs=1e-5)


@pytest.mark.parametrize(
    ("form", "code"),
    [
        ({}, "channels_unaligned"),
        ({"at_step": 7}, "channels_unaligned"),
        ({"at_step": 0, "at_s": 9999}, "channels_unaligned"),
        ({"at_step": 0, "at_s": 2.0, "load": "torque_nm"}, "channel_unknown"),
        ({"at_step": 0, "at_s": 2.0, "load": "valve"}, "load_unit"),
        ({"at_step": 0, "time_column": "Hour"}, "channels_unreadable"),
    ],
)
def test_a_record_that_cannot_be_aligned_changes_nothing(
    client: httpx.Client, captured: tuple[str, list[float]], form: dict[str, object], code: str
) -> None:
    test_id, times = captured
    assert_problem(send(client, test_id, record(times, times[0] - 2.0), **form), 422, code)
    assert client.get(f"{API}/tests/{test_id}/steps/0").json()["channels"] == {"own_v": 1.0}


def test_a_packed_export_holds_what_a_record_brought_later(test_folder: Path, tmp_path: Path) -> None:
    record_file = test_folder / "steps" / "0001" / "step.json"
    document = json.loads(record_file.read_text(encoding="utf-8"))
    document["channels"]["stroke_mm"] = 0.25
    record_file.write_text(json.dumps(document), encoding="utf-8")
    from stereorig.server.exports.run import export_packed

    with zipfile.ZipFile(export_packed(find_source(test_folder), ExportRequest("csv"), tmp_path)) as packed:
        texts = [packed.read(name).decode() for name in sorted(packed.namelist())]
    assert ["stroke_mm" in text for text in texts] == [False, True, False]


UNITS = "Time (s),Load (lbf),Gauge (nm),Clip (mN),Odd (furlong)\n"


def test_a_record_keeps_its_units_in_the_step_and_its_forces_become_the_load(
    client: httpx.Client, captured: tuple[str, list[float]]
) -> None:
    test_id, times = captured
    # the force is 100 N a second of the record
    rows = [
        f"{t:.1f},{100 * t / 4.4482216152605:.6f},{t},{t},{t}" for t in np.arange(0.0, times[1] - times[0] + 9, 0.5)
    ]
    content = (UNITS + "\n".join(rows)).encode("utf-16")
    answer = send(client, test_id, content, at_step=0, at_s=2.0, load="load_lbf")
    assert answer.status_code == 200, answer.text
    units = {"load_lbf": "lbf", "gauge_nm": "nm", "clip_mn": "mN", "odd_furlong": "furlong"}
    assert answer.json()["channels"] == units
    step = client.get(f"{API}/tests/{test_id}/steps/0").json()
    assert step["channel_units"] == units
    assert step["load_n"] == pytest.approx(200.0, abs=1e-3)
    refused = send(client, test_id, content, at_step=0, at_s=2.0, load="gauge_nm")
    assert "is in nm, not" in str(assert_problem(refused, 422, "load_unit")["detail"])
    # the same title in another unit would make two units of one channel
    other = content.decode("utf-16").replace("mN", "MN").encode()
    assert_problem(send(client, test_id, other, at_step=0, at_s=2.0), 422, "channels_there")
    assert send(client, test_id, other, at_step=0, at_s=2.0, replace=True).json()["channels"]["clip_mn"] == "MN"


@pytest.mark.fault(64)
def test_a_preview_shows_what_was_recognised_and_changes_nothing(
    client: httpx.Client, captured: tuple[str, list[float]]
) -> None:
    test_id, times = captured
    rows = [f"{t / 2:.1f};{1 + t / 1e3:.3f}".replace(".", ",") for t in range(2 * int(times[1] - times[0] + 9))]
    content = "\n".join(["Prüfung;P-07", "Prüfzeit;Kraft", "s;kN", *rows, "0,0;OVER", *rows, "Maximum;1,2"]).encode(
        "cp1252"
    )
    form = {"at_step": 0, "at_s": 2.0, "load": "kraft_kn"}

    def preview(**more: object) -> dict[str, Any]:
        data = {name: str(value) for name, value in {**form, **more}.items()}
        url = f"{API}/tests/{test_id}/channels:preview"
        answer = client.post(url, files={"file": ("frame.csv", content)}, data=data)
        assert answer.status_code == 200, answer.text
        return answer.json()  # type: ignore[no-any-return]

    found = preview()
    read = found["read"]
    assert (read["encoding"], read["left_above"], read["left_below"]) == ("cp1252", 1, 1)
    assert [(one["name"], one["unit"], one["decimal"]) for one in read["columns"]] == [
        (None, "s", ","),
        ("kraft_kn", "kN", ","),
    ]
    assert [one["option"] for one in read["questions"]] == ["segment"]
    assert "segment" in found["refused"]
    assert_problem(send(client, test_id, content, **form), 422, "channels_unsure")
    found = preview(segment=2)
    assert found["refused"] == ""
    assert found["steps"][0]["channels"]["kraft_kn"] == pytest.approx(1.004)
    assert client.get(f"{API}/tests/{test_id}/steps/0").json()["channels"] == {"own_v": 1.0}
    assert send(client, test_id, content, **form, segment=2).json()["read"] == found["read"]


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "cp1252", "cp932", "gb18030", "euc-kr", "cp1251"])
def test_every_encoding_is_there_behind_the_walls(
    client: httpx.Client, captured: tuple[str, list[float]], encoding: str
) -> None:
    time = {"cp932": "時間", "gb18030": "时间", "euc-kr": "시간", "cp1251": "время", "cp1252": "Prüfzeit"}.get(
        encoding, "Zeit"
    )
    url = f"{API}/tests/{captured[0]}/channels:preview"
    content = f"{time};F (N)\n0,5;1\n1,5;2\n".encode(encoding)
    found = client.post(url, files={"file": ("frame.csv", content)}).json()
    assert [(one["title"], one["kind"]) for one in found["read"]["columns"]] == [(time, "time"), ("F", "numbers")]
