"""The scale of camera 1's image, told before anything is measured."""

from __future__ import annotations

import json
from collections.abc import Iterator

import httpx
import numpy as np
import pytest

from core.cameras.camera import Camera
from server.config.rig_file import parse_config
from server.workflows.service import Service
from tests.support.service_rig import SMALL, new_test, true_cameras

API = "/api/v1"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("scale") / "data").start()
    yield made
    made.close()


def test_the_scale_is_the_length_that_a_pixel_sees_on_the_plate(client: httpx.Client) -> None:
    cameras = true_cameras(SMALL)
    sent = client.post(f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(cameras))})
    test_id = new_test(client, name="plate", calibration_id=str(sent.json()["id"]))
    client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0}).raise_for_status()
    client.post(f"{API}/tests/{test_id}/steps", json={"label": "reference"}).raise_for_status()
    reply = client.get(f"{API}/tests/{test_id}/scale", params={"step": 0}).raise_for_status().json()
    # the plate lies in Z = 0: two points on it 1 mm apart, across camera 1's line of sight, by the rig's own camera
    camera = Camera.from_paper(**cameras["cam1"])
    axis = camera.cam_from_sys.rotation[2]
    across = np.cross(axis, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    ends = camera.project(np.stack([-0.5 * across, 0.5 * across])).xy
    # the matches' middle is not the origin: over this tilted plate, depth and with it the scale change by some percent
    assert reply["mm_per_px"] == pytest.approx(1.0 / np.linalg.norm(ends[1] - ends[0]), rel=0.04)
    assert reply["distance_mm"] == pytest.approx(camera.cam_from_sys.apply(np.zeros(3))[2], rel=0.04)
    assert reply["matches"] >= 12


def test_without_a_calibration_there_is_no_scale(client: httpx.Client) -> None:
    test_id = new_test(client, name="images only")
    client.post(f"{API}/tests/{test_id}/steps", json={"label": "reference"}).raise_for_status()
    answer = client.get(f"{API}/tests/{test_id}/scale")
    assert answer.status_code == 409, answer.text
