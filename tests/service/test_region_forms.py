"""Regions of several outlines are measured; the scale of camera 1's image is told before that."""

from __future__ import annotations

from collections.abc import Iterator

import httpx
import numpy as np
import pytest

from stereorig.core.cameras.camera import Camera
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.service_rig import SMALL, new_test, plate_test, true_cameras, wait_for_job

API = "/api/v1"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("scale") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def plate(client: httpx.Client) -> str:
    return plate_test(client)


def test_outlines_that_do_not_touch_are_measured_each(client: httpx.Client, plate: str) -> None:
    circles = np.array([(95.0, 110.0, 22.0), (165.0, 110.0, 18.0)])
    body = {
        "kind": "profile",
        "region": {"outlines": [{"circle": circle} for circle in circles.tolist()]},
        "subset_px": 21,
        "spacing_px": 6,
    }
    begun = client.post(f"{API}/tests/{plate}/analyses", json=body)
    assert begun.status_code == 202, begun.text
    assert wait_for_job(client, begun.json()["job"])["state"] == "succeeded"
    url = f"{API}/tests/{plate}/analyses/{begun.json()['analysis_id']}"
    z_mm = np.array(client.get(f"{url}/steps/0/fields/z_mm").json()["values"], dtype=float)
    # the grid starts at the upper left corner of the box about both
    rows, cols = z_mm.shape
    x, y = np.meshgrid(73.0 + 6.0 * np.arange(cols), 88.0 + 6.0 * np.arange(rows))
    inside = (np.hypot(x[..., None] - circles[:, 0], y[..., None] - circles[:, 1]) <= circles[:, 2]).any(axis=-1)
    assert np.array_equal(np.isfinite(z_mm), inside)
    assert inside.sum() > 60
    assert client.get(url).json()["settings"]["region"]["outlines"][1]["circle"] == [165.0, 110.0, 18.0]


def test_the_scale_is_the_length_that_a_pixel_sees_on_the_plate(client: httpx.Client, plate: str) -> None:
    cameras = true_cameras(SMALL)
    reply = client.get(f"{API}/tests/{plate}/scale", params={"step": 0}).raise_for_status().json()
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
