"""A test is given a calibration, or another one, at any time; analyses keep the one that they were measured with."""

from __future__ import annotations

import copy
import io
import json
import shutil
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.server.cli import main
from stereorig.server.formats.results.reading import read_head
from stereorig.server.report.source import find_source
from stereorig.server.results.staleness import stale_results
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.copied_tests import write_test_folder
from tests.support.service_rig import TINY, new_test, true_cameras, wait_for_job

API = "/api/v1"
Images = dict[str, bytes]
REGION = {"region": {"rectangle": [60, 60, 90, 90]}, "subset_px": 21, "spacing_px": 10, "kind": "profile"}


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Images:
    """A plate, seen by the tiny rig's cameras."""
    folder = tmp_path_factory.mktemp("taken") / "t000001-abcdef"
    write_test_folder(folder, 1)
    return {cam: (folder / "steps" / "0000" / f"{cam}.tif").read_bytes() for cam in ("cam1", "cam2")}


def taken(client: httpx.Client, images: Images, **body: Any) -> str:
    """A test with that pair as its reference."""
    test_id = new_test(client, **body)
    files = {cam: (f"{cam}.tif", data) for cam, data in images.items()}
    client.post(f"{API}/tests/{test_id}/steps:import", files=files).raise_for_status()
    return test_id


def imported(client: httpx.Client, label: str, **changes: float) -> str:
    """A calibration of the rig's own cameras, some of camera 2's numbers changed."""
    cameras: dict[str, Any] = copy.deepcopy(true_cameras(TINY))
    for name, value in changes.items():
        cameras["cam2"][name] += value
    file = ("calibration.json", json.dumps(cameras).encode())
    answer = client.post(f"{API}/calibrations:import", files={"file": file}, data={"label": label})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def measure(client: httpx.Client, test_id: str, **body: Any) -> str:
    answer = client.post(f"{API}/tests/{test_id}/analyses", json={**REGION, **body})
    assert answer.status_code == 202, answer.text
    done = wait_for_job(client, answer.json()["job"])
    assert done["state"] == "succeeded", done["problem"]
    return str(answer.json()["analysis_id"])


def field(client: httpx.Client, test_id: str, analysis: str, n: int = 0) -> np.ndarray:
    url = f"{API}/tests/{test_id}/analyses/{analysis}/steps/{n}/fields/z_mm"
    return np.load(io.BytesIO(client.get(url, params={"format": "npy"}).content))


def patch(client: httpx.Client, test_id: str, **body: Any) -> httpx.Response:
    return client.patch(f"{API}/tests/{test_id}", json=body, headers={"If-Match": "*"})


def test_a_test_without_calibration_is_given_one_and_then_another_and_each_analysis_keeps_its_own(
    client: httpx.Client, service: Service, images: Images, tmp_path: Path
) -> None:
    true, other = imported(client, "true"), imported(client, "other", cx_px=4.0)
    test_id = taken(client, images)
    refused = client.post(f"{API}/tests/{test_id}/analyses", json=REGION)
    assert (refused.status_code, refused.json()["code"]) == (409, "not_calibrated")

    given = patch(client, test_id, calibration_id=true)
    assert given.status_code == 200, given.text
    assert given.json()["calibration_id"] == true
    first = measure(client, test_id)
    assert patch(client, test_id, calibration_id=other).json()["calibration_id"] == other
    second = measure(client, test_id)
    named = measure(client, test_id, calibration_id=true)

    assert client.get(f"{API}/tests/{test_id}").json()["calibration_id"] == other  # naming one changes nothing
    # the same numbers as those of a test that had that calibration from the beginning
    for calibration_id, analyses in ((true, [first, named]), (other, [second])):
        whole = taken(client, images, calibration_id=calibration_id)
        z = field(client, whole, measure(client, whole))
        assert np.isfinite(z).all()
        for analysis in analyses:
            np.testing.assert_array_equal(field(client, test_id, analysis), z)
    assert np.abs(field(client, test_id, first) - field(client, test_id, second)).min() > 0.01  # mm; cx by 4 px

    # everything says with which
    listed = {a["id"]: a["calibration_id"] for a in client.get(f"{API}/tests/{test_id}").json()["analyses"]}
    assert listed == {first: true, second: other, named: true}
    for analysis, calibration_id in listed.items():
        shown = client.get(f"{API}/tests/{test_id}/analyses/{analysis}").json()
        assert (shown["calibration_id"], shown["stale"], shown["stale_reasons"]) == (calibration_id, False, [])
        folder = service.tests.analyses.path(test_id, analysis)
        report = find_source(folder)
        assert report.calibration is not None
        assert report.calibration.sha256 == shown["calibration_sha256"]
        assert report.doubts == []
        table = client.get(f"{API}/tests/{test_id}/analyses/{analysis}/export", params={"format": "csv"}).text
        assert f"calibration_id: {calibration_id}" in table or calibration_id in table.split("\nrow")[0]
        gauges = client.post(
            f"{API}/tests/{test_id}/analyses/{analysis}/gauges", json={"points": [{"xy_px": [70, 70]}]}
        ).json()
        assert gauges["calibration"] == {"id": calibration_id, "sha256": shown["calibration_sha256"]}
    assert verify(service.folder.root).sound

    # the folder by itself: a copy of it is measured with the calibration in force, and the results stay up to date
    copied = tmp_path / test_id
    shutil.copytree(service.tests.path(test_id), copied)
    arguments = ["--roi", "60,60,90,90", "--subset", "21", "--projected"]
    assert main(["measure", str(copied), *arguments]) == 0
    files = sorted((copied / "exports" / "measure").glob("step_*.nc"))
    heads = [read_head(path) for path in files]
    wanted = client.get(f"{API}/tests/{test_id}/analyses/{second}").json()["calibration_sha256"]
    assert heads[0].inputs_sha256["calibration"] == wanted
    assert stale_results(files, heads) == []


def test_a_damaged_copy_of_a_later_calibration_is_found_and_not_measured_with(
    client: httpx.Client, service: Service, images: Images
) -> None:
    test_id = taken(client, images)
    patch(client, test_id, calibration_id=imported(client, "later")).raise_for_status()
    kept = service.tests.calibration_file(test_id)
    sound = kept.read_bytes()
    kept.write_bytes(sound.replace(b'"phd_px": ', b'"phd_px": 1'))
    try:
        refused = client.post(f"{API}/tests/{test_id}/analyses", json=REGION)
        assert (refused.status_code, refused.json()["code"]) == (409, "checksum_mismatch")
        assert [f.path for f in verify(service.folder.root).findings] == [str(kept.relative_to(service.folder.root))]
    finally:
        kept.write_bytes(sound)


@pytest.mark.parametrize("where", ["the test", "an analysis"])
def test_a_calibration_of_another_image_size_is_refused(client: httpx.Client, images: Images, where: str) -> None:
    test_id = taken(client, images)
    other = imported_with_size(client)
    if where == "the test":
        answer = patch(client, test_id, calibration_id=other)
    else:
        answer = client.post(f"{API}/tests/{test_id}/analyses", json={**REGION, "calibration_id": other})
    assert (answer.status_code, answer.json()["code"]) == (422, "image_size_mismatch"), answer.text
    assert other in answer.json()["detail"]
    assert client.get(f"{API}/tests/{test_id}").json()["calibration_id"] is None


def imported_with_size(client: httpx.Client) -> str:
    cameras: dict[str, Any] = true_cameras(TINY)
    for cam in ("cam1", "cam2"):
        cameras[cam]["image_size_px"] = [640, 480]  # the tiny rig's have 160 x 144
    file = ("calibration.json", json.dumps(cameras).encode())
    answer = client.post(f"{API}/calibrations:import", files={"file": file})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


@pytest.mark.parametrize(("calibration_id", "code"), [("c999999-abcdef", "not_found"), ("../..", "not_found")])
def test_an_unknown_calibration_changes_nothing(client: httpx.Client, calibration_id: str, code: str) -> None:
    test_id = new_test(client)
    answer = patch(client, test_id, calibration_id=calibration_id, name="new")
    assert answer.json()["code"] == code
    assert client.get(f"{API}/tests/{test_id}").json()["name"] == "a test"
