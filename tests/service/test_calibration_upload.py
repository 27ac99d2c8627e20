"""Calibration from images that a client has: uploaded in free poses, fitted, and fitted again without a bad view."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
import tifffile

from stereorig.core.boards import BoardTarget
from stereorig.core.cameras.stereo import StereoPair
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.board_views import camera_pair, hand_poses, render_views
from tests.support.service_rig import SMALL, served, wait_for_job

API = "/api/v1"
TARGET = BoardTarget(kind="checkerboard", size=(11, 8), pitch_mm=4.0)
SIZE = (612, 512)
PLAN = {"target": {"kind": "checkerboard", "size": [11, 8], "pitch_mm": 4.0}, "phd_px": 1100.0, "label": "own images"}
CAMERAS = camera_pair(focal_px=1000.0, size_px=SIZE)
Files = list[tuple[str, tuple[str, bytes]]]


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    service = Service(parse_config(SMALL), tmp_path_factory.mktemp("upload") / "data").start()
    try:
        with served(service) as made:
            yield made
    finally:
        service.close()


@pytest.fixture(scope="module")
def files() -> Files:
    """Ten pairs of a rendered board; in the fourth, camera 2 saw the board of the fifth."""
    views = render_views(TARGET, hand_poses(TARGET, CAMERAS, range(10), size_px=SIZE), CAMERAS, size_px=SIZE)
    images = {cam: [view.images[cam] for view in views] for cam in ("cam1", "cam2")}
    images["cam2"][3] = images["cam2"][4]
    found: Files = []
    for cam, all_of_it in images.items():
        for n, image in enumerate(all_of_it):
            data = io.BytesIO()
            tifffile.imwrite(data, image, photometric="minisblack")
            found.append((cam, (f"{cam}_{n:03d}.tif", data.getvalue())))
    return found


def send(client: httpx.Client, files: Files, plan: dict[str, Any]) -> httpx.Response:
    return client.post(f"{API}/calibrations:upload", files=files, data={"plan": json.dumps(plan)}, timeout=120.0)


def test_uploaded_boards_give_the_cameras_that_rendered_them(client: httpx.Client, files: Files) -> None:
    good = [one for one in files if "003" not in one[1][0]]
    accepted = send(client, good, PLAN)
    assert accepted.status_code == 202, accepted.text
    job = wait_for_job(client, accepted.json()["job"], 400.0)
    assert job["state"] == "succeeded", job
    calibration = str(accepted.json()["calibration_id"])
    geometry = client.get(f"{API}/calibrations/{calibration}/geometry").json()
    true = StereoPair(*CAMERAS)
    assert geometry["baseline_mm"] == pytest.approx(true.baseline_mm, rel=2e-3)
    assert geometry["stereo_angle_deg"] == pytest.approx(np.degrees(true.stereo_angle_rad), abs=0.1)
    made = client.get(f"{API}/calibrations/{calibration}").json()
    assert made["plan"]["label"] == "own images"
    assert made["image_size_px"] == {"cam1": [*SIZE], "cam2": [*SIZE]}
    views = client.get(f"{API}/calibrations/{calibration}/views").json()["views"]
    assert [(view["index"], view["role"]) for view in views[:3]] == [(0, "free"), (0, "free"), (1, "free")]
    assert len(client.get(f"{API}/calibrations/{calibration}/residuals").json()["views"]) == 18

    again = client.post(f"{API}/calibrations/{calibration}:refit", json={"without": [2]})
    assert again.status_code == 202, again.text
    assert wait_for_job(client, again.json()["job"], 400.0)["state"] == "succeeded"
    second = client.get(f"{API}/calibrations/{again.json()['calibration_id']}").json()
    assert second["plan"]["refitted_from"] == calibration
    assert {view["index"] for view in second["taken"]} == {0, 1, 3, 4, 5, 6, 7, 8}
    assert second["plan"]["label"] == "own images without 2"
    # no view of the rig's own target: what is expected of the rig assumes nothing from it
    expected = client.post(f"{API}/calibrations:expect", json={})
    assert expected.json()["assumed"]["roll_deg"] == 0.0, expected.text


def test_an_upload_that_cannot_be_fitted_is_refused_before_anything_is_kept(client: httpx.Client, files: Files) -> None:
    known = client.get(f"{API}/calibrations").json()["calibrations"]
    small = io.BytesIO()
    tifffile.imwrite(small, np.arange(4096, dtype=np.uint8).reshape(64, 64), photometric="minisblack")
    ones, twos = files[:10], files[10:]
    for sent, plan, code in (
        ([*ones, *twos[:4]], PLAN, "counts_differ"),
        ([*ones, *twos], {**PLAN, "moves": "target"}, "plan_unreadable"),
        ([*ones, *twos], {**PLAN, "target": {"kind": "checkerboard", "pitch_mm": 4.0}}, "plan_unreadable"),
        ([*ones[:2], *twos[:1], ("cam2", ("b.tif", small.getvalue()))], PLAN, "image_size_mismatch"),
        ([*ones[:2], *twos[:1], ("cam2", ("b.tif", b"no image"))], PLAN, "image_unreadable"),
        (
            [*ones[:2], *twos[:2]],
            {**PLAN, "moves": "target", "dz_mm": [0.0], "standoff_mm": 200.0, "angle_deg": [12.0, -12.0]},
            "positions_mismatch",
        ),
    ):
        answer = send(client, sent, plan)
        assert answer.is_client_error
        assert answer.json()["code"] == code, answer.text
    assert client.get(f"{API}/calibrations").json()["calibrations"] == known
    if known:
        answer = client.post(f"{API}/calibrations/{known[0]['id']}:refit", json={"without": [77]})
        assert (answer.status_code, answer.json()["code"]) == (422, "views_missing")
