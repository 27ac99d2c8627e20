"""Exports over HTTP: every form, one file or a ZIP of them, made beside the service; refusals before the first byte."""

from __future__ import annotations

import io
import json
import shutil
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

import h5py
import httpx
import netCDF4
import numpy as np
import pandas as pd
import pytest
import scipy.io
from PIL import Image

from stereorig.server.exports.process import FOLDER
from stereorig.server.workflows.service import Service
from tests.support.export_results import write_results
from tests.support.patience import Deadline, busy

FILES = {
    "nc": "application/zip",
    "csv": "application/zip",
    "vtu": "application/zip",
    "mat": "application/x-matlab-data",
    "h5": "application/x-hdf5",
    "png": "application/zip",
    "svg": "application/zip",
    "gif": "image/gif",
    "mp4": "video/mp4",
}


@pytest.fixture(scope="module")
def url(service: Service, tmp_path_factory: pytest.TempPathFactory) -> str:
    """An analysis whose results were put there, with a step whose images are gone since."""
    test = service.tests.create({"name": "Panel", "specimen": "", "notes": ""}, None)
    document = {"kind": "displacement", "steps": [0, 1, 2], "settings": {}, "inputs": {"steps": {"0": {}}}}
    analysis = service.tests.analyses.create(test.id, document)
    write_results(service.tests.analyses.path(test.id, analysis.id))
    return f"/api/v1/tests/{test.id}/analyses/{analysis.id}/export"


def _content(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.parametrize("form", FILES)
def test_every_form_comes_as_a_file(client: httpx.Client, service: Service, url: str, form: str) -> None:
    reply = client.get(url, params={"format": form, "width_px": 300})
    assert reply.status_code == 200, reply.text
    assert reply.headers["content-type"] == FILES[form]
    assert "attachment; filename=" in reply.headers["content-disposition"]
    assert "step 0" in reply.headers["x-stale"]
    if FILES[form] == "application/zip":
        names = sorted(_content(reply.content))
        steps = [1, 2] if form in ("png", "svg") else [0, 1, 2]
        wanted = [f"_step_{n:04d}" for n in steps] + ([".pvd"] if form == "vtu" else [])
        assert len(names) == len(wanted)
        assert all(any(w in name for name in names) for w in wanted)
    assert not list((service.folder.root / FOLDER).iterdir())  # nothing is left behind


def test_files_hold_what_was_asked_for(client: httpx.Client, url: str) -> None:
    one = client.get(url, params={"format": "csv", "step": 2, "variables": "exx,u_mm"})
    assert one.headers["content-type"].startswith("text/csv")
    table = pd.read_csv(io.StringIO(one.text))
    header = list(table)
    assert {"u_mm", "exx"} < set(header)
    assert "v_mm" not in header
    assert json.loads(table.about[0])["calibration_sha256"].startswith("c0c0")
    stack = client.get(url, params={"format": "h5", "steps": "0,2"})
    with h5py.File(io.BytesIO(stack.content)) as file:
        np.testing.assert_array_equal(file["step"][...], [0, 2])
    mat = scipy.io.loadmat(io.BytesIO(client.get(url, params={"format": "mat", "steps": "1-2"}).content))
    assert mat["step"].ravel().tolist() == [1, 2]
    png = client.get(url, params={"format": "png", "step": 1, "variables": "exx", "limits": "-0.001,0.002"})
    assert png.headers["content-type"] == "image/png"
    with Image.open(io.BytesIO(png.content)) as picture:
        assert picture.width == 900
    stored = client.get(url, params={"step": 1})
    assert stored.headers["content-type"] == "application/x-netcdf"
    assert stored.content[:4] == b"\x89HDF"


def test_dense_fields_are_exported_on_request(client: httpx.Client, service: Service) -> None:
    test = service.tests.create({"name": "Dense", "specimen": "", "notes": ""}, None)
    document = {"kind": "displacement", "steps": [0, 1, 2], "settings": {}, "inputs": {"steps": {"0": {}}}}
    analysis = service.tests.analyses.create(test.id, document)
    folder = service.tests.analyses.path(test.id, analysis.id)
    write_results(folder)
    url = f"/api/v1/tests/{test.id}/analyses/{analysis.id}/export"
    none = client.get(url, params={"format": "csv", "dense": "true"})
    assert (none.status_code, none.json()["code"]) == (404, "dense_missing")
    (folder / "dense").mkdir()
    for n in (0, 1):
        shutil.copy(folder / f"step_000{n}.nc", folder / "dense" / f"step_000{n}.nc")
    every = client.get(url, params={"format": "csv", "dense": "true"})
    names = sorted(_content(every.content))
    assert names == [f"Dense_{analysis.id}_step_000{n}_Stufe-{n}.csv" for n in (0, 1)]
    one = client.get(url, params={"format": "nc", "step": 1, "dense": "true"})
    assert one.content == (folder / "dense" / "step_0001.nc").read_bytes()
    assert client.get(url, params={"step": 2, "dense": "true"}).json()["code"] == "dense_missing"


@pytest.mark.parametrize(
    ("params", "status", "code"),
    [
        ({"format": "exe"}, 422, "invalid_request"),
        ({"format": "csv", "step": 9}, 404, "not_found"),
        ({"format": "csv", "steps": "5-3"}, 422, "step_invalid"),
        ({"format": "csv", "steps": "0;1"}, 422, "invalid_request"),
        ({"format": "csv", "variables": "nix"}, 404, "field_missing"),
        ({"format": "nc", "variables": "w_mm"}, 422, "option_conflict"),
        ({"format": "png", "limits": "2,1"}, 422, "figure_style_invalid"),
        ({"format": "png", "limits": "1.2.3,4"}, 422, "figure_style_invalid"),
        ({"format": "png", "percentiles": "90,10"}, 422, "figure_style_invalid"),
        ({"format": "png", "colours": "jet"}, 422, "invalid_request"),
        ({"format": "png", "over_image": "true"}, 404, "image_missing"),
        ({"format": "gif", "fps": 0}, 422, "invalid_request"),
    ],
)
def test_refusals_are_problems(
    client: httpx.Client, service: Service, url: str, params: dict[str, Any], status: int, code: str
) -> None:
    reply = client.get(url, params=params)
    assert (reply.status_code, reply.json()["code"]) == (status, code), reply.text
    assert reply.json()["remedy"]
    folder = service.folder.root / FOLDER
    assert not folder.exists() or not list(folder.iterdir())


def test_no_finished_step(client: httpx.Client, service: Service) -> None:
    test = service.tests.create({"name": "", "specimen": "", "notes": ""}, None)
    analysis = service.tests.analyses.create(test.id, {"kind": "profile", "steps": [0], "settings": {}})
    reply = client.get(f"/api/v1/tests/{test.id}/analyses/{analysis.id}/export", params={"format": "csv"})
    assert (reply.status_code, reply.json()["code"]) == (404, "no_results")


def test_the_service_answers_while_films_are_made_and_refuses_too_many(client: httpx.Client, url: str) -> None:
    answers: list[int] = []
    base = str(client.base_url)

    def film() -> None:
        with httpx.Client(base_url=base, timeout=120.0, trust_env=False) as other:
            answers.append(other.get(url, params={"format": "gif", "width_px": 400}).status_code)

    threads = [threading.Thread(target=film) for _ in range(6)]
    for thread in threads:
        thread.start()
    slowest = 0.0
    while any(thread.is_alive() for thread in threads):
        begun = time.monotonic()
        assert client.get("/healthz").status_code == 200
        slowest = max(slowest, time.monotonic() - begun)
        time.sleep(0.02)
    assert slowest < 1.0 * busy()
    assert answers.count(200) == 4  # made one after the other
    assert answers.count(503) == 2


def test_a_client_that_goes_away_ends_its_export(client: httpx.Client, service: Service, url: str) -> None:
    with httpx.Client(base_url=str(client.base_url), trust_env=False) as other, pytest.raises(httpx.ReadTimeout):
        other.get(url, params={"format": "gif", "width_px": 2500}, timeout=httpx.Timeout(5.0, read=0.2))
    deadline = Deadline(30.0)
    folder: Path = service.folder.root / FOLDER
    while list(folder.iterdir()):
        assert deadline.left
        time.sleep(0.1)
    assert client.get(url, params={"format": "csv", "step": 0}).status_code == 200


def test_what_a_kill_left_is_removed_at_the_start(tmp_path: Path) -> None:
    from stereorig.server.exports.process import ExportProcess

    (tmp_path / FOLDER / "tmpabc").mkdir(parents=True)
    (tmp_path / FOLDER / "tmpabc" / "half.zip").write_bytes(b"x")
    made = ExportProcess(tmp_path)
    made.clear()
    assert not (tmp_path / FOLDER).exists()
    made.close()


def test_gauges_come_as_a_table_and_for_matlab(client: httpx.Client, url: str) -> None:
    gauges = url.replace("/export", "/gauges")
    body = {
        "points": [{"name": "p", "xy_px": [61.0, 81.0]}, {"xy_px": [40.0 + 7 * 25, 60.0 + 7 * 3]}],
        "variables": ["w_mm"],
    }
    read = client.post(gauges, json=body)
    assert read.status_code == 200, read.text
    table = client.post(gauges, json=body, params={"format": "csv"})
    lines = [line.split(",") for line in table.text.splitlines() if not line.startswith("#")]
    mat = client.post(gauges, json=body, params={"format": "mat"})
    found = scipy.io.loadmat(io.BytesIO(mat.content), simplify_cells=True)
    assert list(found["gauges"]) == lines[0]
    assert list(found["gauges"]["gauge"]) == [line[lines[0].index("gauge")] for line in lines[1:]]
    at = lines[0].index("value")
    values = [float(line[at]) if line[at] else np.nan for line in lines[1:]]
    np.testing.assert_array_equal(found["gauges"]["value"], values)
    w = [s["points"][0]["values"]["w_mm"]["value"] for s in read.json()["steps"][1:]]
    np.testing.assert_allclose(w, [-0.05, -0.10], atol=1e-9)
    assert set(w) <= set(values)
    assert any(len(m) for m in found["gauges"]["missing"])  # the second lies at a failed point
    assert found["about"]["frame"].startswith("sys: X_sys")


def test_a_film_as_a_job_has_progress_and_a_file_and_can_be_cancelled(client: httpx.Client, url: str) -> None:
    asked = {"format": "gif", "width_px": 300, "colours": "diverging", "levels": 6, "limits": "-0.2,0.2"}
    begun = client.post(f"{url}s", params=asked)
    assert begun.status_code == 202, begun.text
    job = begun.json()["job"]
    assert (job["kind"], job["subject"]["analysis_id"]) == ("export", url.split("/")[-2])
    early = client.get(f"/api/v1/jobs/{job['id']}/file")
    ended = client.get(f"/api/v1/jobs/{job['id']}", params={"wait": 60}).json()
    assert ended["state"] == "succeeded", ended
    assert (ended["progress"]["done"], ended["progress"]["total"]) == (2, 2)  # the reference has no displacement
    made = client.get(f"/api/v1/jobs/{job['id']}/file")
    assert made.content == client.get(url, params=asked).content
    assert len(made.content) == ended["result"]["bytes"]
    if early.status_code != 200:
        assert (early.status_code, early.json()["code"]) == (404, "not_found")
    other = client.post(f"{url}s", params={"format": "gif", "width_px": 4000}).json()["job"]
    stopped = client.post(f"/api/v1/jobs/{other['id']}:cancel", params={"wait": 30}).json()
    assert stopped["state"] == "cancelled"
    assert client.get(f"/api/v1/jobs/{other['id']}/file").status_code == 404
    refused = client.post(f"{url}s", params={"format": "csv", "step": 9})
    assert (refused.status_code, refused.json()["code"]) == (404, "not_found")


@pytest.mark.parametrize("frame", ["system", "plane"])
def test_dense_fields_come_by_a_job_as_at_once_in_the_axes_of_the_ordinary_field(
    client: httpx.Client, service: Service, frame: str
) -> None:
    test = service.tests.create({"name": "Dense job", "specimen": "", "notes": ""}, None)
    document = {"kind": "displacement", "steps": [0, 1], "settings": {}, "inputs": {"steps": {"0": {}}}}
    analysis = service.tests.analyses.create(test.id, document)
    folder = service.tests.analyses.path(test.id, analysis.id)
    write_results(folder, 2, reference_step="0")
    shutil.copytree(folder, folder / "dense")
    for path in (folder / "dense").glob("step_*.nc"):
        with netCDF4.Dataset(path, "a") as file:
            file["z_mm"][...] += 0.5
    url = f"/api/v1/tests/{test.id}/analyses/{analysis.id}/export"
    asked = {"format": "h5", "frame": frame if frame == "system" else '{"kind": "plane"}'}

    def z_mm(data: bytes) -> Any:
        with h5py.File(io.BytesIO(data)) as file:
            return file["z_mm"][...]

    at_once = z_mm(client.get(url, params={**asked, "dense": "true"}).content)
    job = client.post(f"{url}s", params={**asked, "dense": "true"}).json()["job"]
    ended = client.get(f"/api/v1/jobs/{job['id']}", params={"wait": 30}).json()
    assert ended["state"] == "succeeded", ended
    by_job = z_mm(client.get(f"/api/v1/jobs/{job['id']}/file").content)
    np.testing.assert_array_equal(by_job, at_once)
    # the dense field lies 0.5 mm beyond the ordinary one, whose shape the axes are laid through
    ordinary = z_mm(client.get(url, params=asked).content)
    assert np.nanmedian(np.abs(by_job - ordinary)) == pytest.approx(0.5, abs=0.02)
