"""Help at the rig: an exposure that is searched for, and the accepted calibration held against the live pair."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import httpx
import numpy as np
import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.server.formats.images import decode
from stereorig.server.workflows.service import Service
from tests.support.service_rig import SMALL, data_of, true_cameras, wait_for_job

pytestmark = [pytest.mark.timeout(300), pytest.mark.warm_worker]
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


def test_too_little_light_keeps_the_old_exposure(client: httpx.Client) -> None:
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


def test_the_geometry_of_a_calibrated_rig_is_that_of_its_cameras(client: httpx.Client) -> None:
    cameras = true_cameras(SMALL)
    sent = json.dumps(cameras | {"image_size_px": {"cam1": [256, 240], "cam2": [256, 240]}})
    made = client.post(f"{API}/calibrations:import", files={"file": ("c.json", sent)}).json()["id"]
    found = client.get(f"{API}/calibrations/{made}/geometry").json()
    # the rotation of Eq. (1): the optical axis and the pinhole in the system frame, from the parameters by hand
    axes, centres = [], []
    for cam in ("cam1", "cam2"):
        p = cameras[cam]
        a, b, g = (p[n] for n in ("alpha_rad", "beta_rad", "gamma_rad"))
        turn_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        turn_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        turn_y = np.array([[np.cos(g), 0, np.sin(g)], [0, 1, 0], [-np.sin(g), 0, np.cos(g)]])
        rotation = turn_x @ turn_y @ turn_z
        axes.append(rotation[2])
        centres.append(-rotation.T @ np.array([p["x0_mm"], p["y0_mm"], p["z0_mm"]]))
    assert found["stereo_angle_deg"] == pytest.approx(np.degrees(np.arccos(axes[0] @ axes[1])), rel=0.02)
    assert found["baseline_mm"] == pytest.approx(np.linalg.norm(centres[0] - centres[1]), rel=0.02)
    for cam in ("cam1", "cam2"):
        # a plane that the camera sees at an angle: its width is at least that of a frontal one
        frontal = 256 / cameras[cam]["phd_px"] * cameras[cam]["z0_mm"]
        assert frontal * 0.98 < found["cameras"][cam]["field_of_view_mm"][0] < frontal * 1.2
