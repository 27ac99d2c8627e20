"""The page tells of a camera that was bumped, compares calibrations in space and checks a known distance."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import expect

from stereorig.core.cameras.camera import Camera
from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.page_bench import Watched
from tests.support.service_rig import SMALL, new_test, true_cameras, wait_for_job, wait_for_rig

pytestmark = pytest.mark.timeout(500)
API = "/api/v1"
SLOW = 60_000
BUMP_DEG = 0.01  # about camera 2's rows: a pixel across the epipolar lines


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    made = Service(parse_config(SMALL), tmp_path_factory.mktemp("moved") / "data").start()
    yield made
    made.close()


@pytest.fixture(scope="module")
def cameras() -> dict[str, dict[str, float]]:
    return true_cameras(SMALL)


def imported(client: httpx.Client, cameras: dict[str, Any], label: str) -> str:
    sent = client.post(
        f"{API}/calibrations:import", files={"file": ("c.json", json.dumps(cameras))}, data={"label": label}
    )
    assert sent.status_code == 201, sent.text
    return str(sent.json()["id"])


@pytest.fixture(scope="module")
def calibrations(client: httpx.Client, cameras: dict[str, dict[str, float]]) -> tuple[str, str]:
    """The rig's own cameras, and the same with camera 2 turned."""
    turned = {**cameras, "cam2": {**cameras["cam2"], "beta_rad": cameras["cam2"]["beta_rad"] + np.radians(0.1)}}
    return imported(client, cameras, "own"), imported(client, turned, "turned")


def test_a_bump_between_steps_is_told_with_its_consequence_and_remedy(
    page: Watched, client: httpx.Client, calibrations: tuple[str, str]
) -> None:
    wait_for_rig(client)
    test_id = new_test(client, name="bumped", calibration_id=calibrations[0])
    for turn in (0.0, BUMP_DEG):
        params = {"bump_cam2": [turn, 0.0, 0.0, 0.0, 0.0, 0.0]}
        client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0, "params": params}).raise_for_status()
        client.post(f"{API}/tests/{test_id}/steps", json={}).raise_for_status()
    asked = {"region": {"rectangle": [60, 60, 180, 170]}, "subset_px": 25, "spacing_px": 10}
    made = client.post(f"{API}/tests/{test_id}/analyses", json=asked).json()
    assert wait_for_job(client, made["job"])["state"] == "succeeded"
    path = f"/tests/{test_id}/analyses/{made['analysis_id']}"
    at_rest, bumped = client.get(f"{API}{path}").json()["summary"]["steps"]
    motion = bumped["camera_motion"]
    assert motion["camera_moved"] is True
    shown = page.open(f"#/results/{test_id}/{made['analysis_id']}?step=1")
    told = shown.locator('[data-role="camera-motion"]')
    seen = motion["text"].replace(" um ", " µm ").replace("+-", "±").replace("sigma", "σ")
    seen = seen.replace("microstrain", "µm/m")
    expect(told).to_contain_text(seen, timeout=SLOW)
    assert "um in shape" in motion["text"]
    expect(told).to_contain_text("stereorig calibration repair")
    about = shown.locator('[data-role="about"]')
    about.locator("summary").first.click()
    expect(about.locator("li").filter(has_text=seen)).to_have_count(1)
    expect(about.get_by_role("row").filter(has_text="moved").first).to_be_visible()
    # the reference itself has nothing against it
    assert at_rest["camera_motion"]["camera_moved"] is not True
    shown.get_by_role("button", name="Step before").click()
    expect(told).to_have_count(0)
    report = client.get(f"{API}{path}/report").text
    assert motion["text"] in report
    assert 'id="camera-motion"' in report
    page.sound()


def test_two_calibrations_are_compared_in_space_and_a_distance_is_checked(
    page: Watched, client: httpx.Client, calibrations: tuple[str, str], cameras: dict[str, dict[str, float]]
) -> None:
    own, turned = calibrations
    shown = page.open(f"#/calibrate/{own}")
    for one in calibrations:
        shown.get_by_label(f"Compare {one}").check()
    shown.get_by_role("button", name="Compare the two chosen").click()
    in_space = shown.get_by_role("dialog").locator('[data-role="in-space"]')
    # the list is newest first
    reply = client.get(f"{API}/calibrations/{turned}/comparison", params={"with": own}).json()
    expect(in_space).to_contain_text(reply["text"], timeout=SLOW)
    # the comparison does not stay over another screen
    shown.evaluate("location.hash = '#/jobs'")
    expect(shown.get_by_role("heading", level=1, name="Jobs and system")).to_be_visible()
    expect(shown.get_by_role("dialog")).to_have_count(0)
    shown.go_back()
    # what is missing is said beside it
    shown.get_by_text("Known distance", exact=True).first.click()
    shown.get_by_role("button", name="Check the distance").click()
    distance = shown.locator(".field", has=shown.get_by_role("spinbutton", name="Known distance"))
    expect(distance.get_by_role("alert")).to_have_text("The known distance is needed here.")
    marks = shown.get_by_role("group", name="Marks in cam2, px")
    expect(marks.get_by_role("alert")).to_have_text("Give mark 1, x, in px.")
    # two marks 1 mm apart, imaged by the cameras themselves
    shown.get_by_role("spinbutton", name="Known distance").fill("1")
    ends = np.array([[-0.5, 0.2, 0.0], [0.5, 0.2, 0.0]])
    for cam, numbers in cameras.items():
        marks = Camera.from_paper(**numbers).project(ends).xy
        for k, (x, y) in enumerate(marks):
            shown.get_by_label(f"{cam}, mark {k + 1}, x").fill(repr(float(x)))
            shown.get_by_label(f"{cam}, mark {k + 1}, y").fill(repr(float(y)))
    expect(shown.get_by_role("main").get_by_role("alert")).to_have_count(0)
    shown.get_by_role("button", name="Check the distance").click()
    found = shown.locator('[data-role="known-distance"]')
    expect(found).to_contain_text("agrees", timeout=SLOW)
    kept = client.get(f"{API}/calibrations/{own}").json()["kept_checks"]["known_distance"]
    assert kept["ratio"] == pytest.approx(1.0, abs=1e-9)
    expect(found).to_contain_text(kept["text"])
    page.sound()
