"""Help at the rig: an exposure that is searched for, and the accepted calibration held against the live pair."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from server.config.rig_file import parse_config
from server.formats.images import decode
from server.workflows.service import Service
from tests.support.service_rig import SMALL, data_of, true_cameras, wait_for_job

pytestmark = pytest.mark.timeout(300)
API = "/api/v1"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), data_of(tmp_path_factory.mktemp("help"))).start()
    yield made
    made.close()


def brightest(client: httpx.Client, cam: str) -> tuple[float, float]:
    """Level that a thousandth of the pixels is above, and the share at full scale, from the picture itself."""
    frame = decode(client.get(f"{API}/cameras/{cam}/frame").content, name=cam).pixels
    return float(np.sort(frame.ravel())[-frame.size // 1000]) / 255.0, float(np.mean(frame == 255))


def test_the_exposure_is_searched_from_dark_and_from_bright(client: httpx.Client) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "plate"}).raise_for_status()
    for start_ms in (0.3, 60.0):
        client.patch(f"{API}/cameras/cam1", json={"exposure_ms": start_ms}).raise_for_status()
        found = client.post(f"{API}/cameras/cam1:expose", json={"level": 0.7})
        assert found.status_code == 200, found.text
        level, saturated = brightest(client, "cam1")
        # the search's tolerance, and the noise of one picture
        assert level == pytest.approx(0.7, rel=0.05)
        assert saturated == 0.0
        assert (
            client.get(f"{API}/cameras/cam1").json()["settings"]["exposure_ms"]
            == found.json()["settings"]["exposure_ms"]
        )
    assert client.get(f"{API}/cameras/cam2").json()["settings"]["exposure_ms"] == 10.0


def test_light_that_does_not_suffice_leaves_the_exposure_as_it_was(client: httpx.Client) -> None:
    client.patch(f"{API}/cameras/cam2", json={"exposure_ms": 10.0}).raise_for_status()
    refused = client.post(f"{API}/cameras/cam2:expose", json={"longest_ms": 0.5})
    assert refused.status_code == 409
    problem = refused.json()
    assert problem["code"] == "light_too_weak"
    assert "0.5 ms" in problem["detail"]
    assert client.get(f"{API}/cameras/cam2").json()["settings"]["exposure_ms"] == 10.0
    nothing = client.post(f"{API}/cameras/cam2:expose", json={"shortest_ms": 5.0, "longest_ms": 2.0})
    assert (nothing.status_code, nothing.json()["code"]) == (422, "out_of_range")


def test_the_accepted_calibration_is_held_against_the_live_pair(client: httpx.Client) -> None:
    for cam in ("cam1", "cam2"):
        client.patch(f"{API}/cameras/{cam}", json={"exposure_ms": 10.0}).raise_for_status()
    none = client.get(f"{API}/rig/calibration-check")
    assert (none.status_code, none.json()["code"]) == (409, "no_calibration_accepted")
    made = client.post(
        f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(true_cameras(SMALL)))}
    ).json()["id"]
    client.put(f"{API}/calibrations/{made}/review", json={"decision": "accepted"}).raise_for_status()

    def check() -> dict[str, object]:
        for _ in range(600):
            answer = client.get(f"{API}/rig/calibration-check")
            assert answer.status_code == 200, answer.text
            if answer.json()["level"] != "busy":  # the worker compiles its kernels once per machine
                break
            time.sleep(0.2)
        return dict(answer.json())

    client.put(f"{API}/sim/scene", json={"scene": "plate"}).raise_for_status()
    still = check()
    assert still["calibration_id"] == made
    assert still["level"] == "ok", still
    assert still["offset_px"] < 0.05  # type: ignore[operator]  # the rig's own cameras: noise alone
    assert still["points"] > 100  # type: ignore[operator]
    # a camera tilted by hundredths and by tenths of a degree about its x: 6000 px of pinhole distance
    for deg, px in ((0.003, 0.31), (0.05, 5.2)):
        client.put(
            f"{API}/sim/scene", json={"scene": "plate", "params": {"bump_cam2": [deg, 0, 0, 0, 0, 0]}}
        ).raise_for_status()
        moved = check()
        assert moved["level"] == "failed", moved
        assert moved["offset_px"] == pytest.approx(px, rel=0.15)
    client.put(
        f"{API}/sim/scene", json={"scene": "grid", "params": {"bump_cam2": [0, 0, 0, 0, 0, 0]}}
    ).raise_for_status()
    client.patch(f"{API}/cameras/cam1", json={"exposure_ms": 0.01}).raise_for_status()
    assert check()["level"] == "no_texture"
    client.patch(f"{API}/cameras/cam1", json={"exposure_ms": 10.0}).raise_for_status()
    job = client.post(f"{API}/stage/moves", json={"dz_mm": {"cam1": 1.0, "cam2": 1.0}}).json()["job"]
    assert wait_for_job(client, job)["state"] == "succeeded"
    away = check()
    assert away["level"] == "off_zero"
    assert "dZ = +1.000 mm" in str(away["text"])
