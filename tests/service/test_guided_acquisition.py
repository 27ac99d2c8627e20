"""A guided acquisition over the API, on a simulated rig whose board is held by hand."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline
from tests.support.problems import assert_problem
from tests.support.service_rig import data_of, served, wait_for_job, wait_for_rig
from tests.support.small_board_rig import SMALL_BOARD

API = "/api/v1"


@pytest.fixture
def client(tmp_path: Path) -> Iterator[httpx.Client]:
    with Service(parse_config(SMALL_BOARD), data_of(tmp_path)) as service, served(service) as client:
        wait_for_rig(client)
        yield client


def hold(client: httpx.Client, pose: list[float]) -> None:
    """Hold the board in a pose."""
    body = {"scene": "charuco", "params": {"pose": pose}}
    assert client.put(f"{API}/sim/scene", json=body).status_code == 200


def guided(client: httpx.Client, calibration_id: str, ready: Any, seconds: float = 90.0) -> dict[str, Any]:
    """Ask until something holds."""
    deadline = Deadline(seconds)
    while deadline.left:
        state: dict[str, Any] = client.get(f"{API}/calibrations/{calibration_id}/guide").json()
        if ready(state):
            return state
        time.sleep(0.05)
    raise AssertionError(f"not within {seconds} s: {state}")


def test_follows_its_proposals_to_the_goal_and_fits(client: httpx.Client) -> None:
    hold(client, [0.0] * 6)
    answer = client.post(f"{API}/calibrations:guide", json={"goal_um": 6.0, "label": "by hand"})
    assert answer.status_code == 202, answer.text
    calibration_id = answer.json()["calibration_id"]
    # the cameras are held like by any job
    assert_problem(client.post(f"{API}/calibrations:guide", json={}), 409, "hardware_busy")
    taken = 0
    for _ in range(20):
        state = guided(
            client,
            calibration_id,
            lambda s, n=taken: s["state"] != "acquiring" or (s["guidance"] and s["guidance"]["taken"] > n),
        )
        if state["state"] != "acquiring":
            break
        taken = state["guidance"]["taken"]
        if state["guidance"]["reached"]:
            break
        proposal = state["guidance"]["proposal"]
        assert proposal is not None
        hold(client, proposal["pose"])
    ended = wait_for_job(client, answer.json()["job"])
    assert ended["state"] == "succeeded", ended["problem"]
    assert ended["result"]["reached"]
    made = client.get(f"{API}/calibrations/{calibration_id}").json()
    assert made["state"] == "complete"
    assert made["verdict"]["level"] in ("good", "warning")
    assert made["stage"]["moves"] == "free"
    state = client.get(f"{API}/calibrations/{calibration_id}/guide").json()
    assert state["guidance"]["uncertainty"]["z_um"] <= 6.0
    assert sum(state["guidance"]["coverage"]["depths"]) == state["guidance"]["used"]
    views = client.get(f"{API}/calibrations/{calibration_id}/views").json()["views"]
    assert {v["role"] for v in views} == {"free"}
    assert len(views) == 2 * ended["result"]["views"]
    residuals = client.get(f"{API}/calibrations/{calibration_id}/residuals").json()["views"]
    assert {v["frame"] for v in residuals} <= {v["index"] for v in views}


def test_views_survive_a_cancel_and_can_be_fitted(client: httpx.Client) -> None:
    answer = client.post(f"{API}/calibrations:guide", json={"automatic": False}).json()
    calibration_id = answer["calibration_id"]
    poses: list[list[float]] = [
        [0.0] * 6,
        [0, 30, 0, 0, 0, 0],
        [30, 0, 0, 0, 0, 5],
        [0, -30, 0, 5, 0, 0],
        [-25, 20, 0, 0, 0, -8],
    ]
    for k, pose in enumerate(poses):
        hold(client, pose)
        looks = guided(client, calibration_id, lambda s: s["looks"] > 0 and s["live"])["looks"]
        # two live pairs on, no older pose can be in the newest
        guided(client, calibration_id, lambda s, n=looks: s["looks"] >= n + 2 and s["live"]["seen"])
        assert client.post(f"{API}/calibrations/{calibration_id}/guide/views").status_code == 202
        guided(client, calibration_id, lambda s, n=k: s["guidance"]["taken"] == n + 1)
    # the newest look may be older than the last view
    looks = guided(client, calibration_id, lambda s: True)["looks"]
    live = guided(client, calibration_id, lambda s: s["looks"] >= looks + 2 and s["live"]["still"])["live"]
    assert live["like_view"] == len(poses) - 1
    assert not live["new"]
    assert len(live["cameras"]["cam1"]["points_px"]) == 54
    client.post(f"{API}/jobs/{answer['job']['id']}:cancel")
    assert wait_for_job(client, answer["job"])["state"] == "cancelled"
    assert len(client.get(f"{API}/calibrations/{calibration_id}/views").json()["views"]) == 2 * len(poses)
    assert_problem(client.post(f"{API}/calibrations/{calibration_id}/guide/views"), 409, "guide_ended")
    fitted = client.post(f"{API}/calibrations/{calibration_id}/guide:finish")
    assert fitted.status_code == 202, fitted.text
    assert wait_for_job(client, fitted.json()["job"])["state"] == "succeeded"
    assert client.get(f"{API}/calibrations/{calibration_id}").json()["state"] == "complete"
    assert_problem(client.post(f"{API}/calibrations/{calibration_id}/guide:finish"), 409, "calibration_complete")


def test_a_target_that_cannot_be_found_ends_a_calibration_before_anything_moves(client: httpx.Client) -> None:
    assert client.put(f"{API}/sim/scene", json={"scene": "plate"}).status_code == 200
    before = client.get(f"{API}/stage").json()["axes"][0]["position_mm"]
    answer = client.post(f"{API}/calibrations", json={}).json()
    ended = wait_for_job(client, answer["job"])
    assert ended["state"] == "failed"
    assert ended["problem"]["code"] == "target_not_found"
    assert "before anything moved" in ended["problem"]["detail"]
    assert client.get(f"{API}/stage").json()["axes"][0]["position_mm"] == before
    views = client.get(f"{API}/calibrations/{answer['calibration_id']}/views").json()["views"]
    assert [v["role"] for v in views] == ["first_look"] * 2


def test_one_stage_under_the_target_calibrates_a_board(client: httpx.Client) -> None:
    hold(client, [0.0] * 6)
    answer = client.post(f"{API}/calibrations", json={}).json()
    ended = wait_for_job(client, answer["job"])
    assert ended["state"] == "succeeded", ended["problem"]
    made = client.get(f"{API}/calibrations/{answer['calibration_id']}").json()
    assert made["stage"]["moves"] == "target"
    assert made["target"]["kind"] == "charuco"
    views = client.get(f"{API}/calibrations/{answer['calibration_id']}/views").json()["views"]
    assert views[0]["dz_mm"] == views[1]["dz_mm"]


def test_a_cancelled_calibration_offers_the_way_back(client: httpx.Client) -> None:
    hold(client, [0.0] * 6)
    answer = client.post(f"{API}/calibrations", json={"positions_mm": [-8.0, 8.0]}).json()
    deadline = Deadline(60.0)
    while client.get(f"{API}/stage").json()["axes"][0]["position_mm"] > -1.0 and deadline.left:
        time.sleep(0.02)
    client.post(f"{API}/jobs/{answer['job']['id']}:cancel")
    ended = wait_for_job(client, answer["job"])
    assert ended["state"] == "cancelled"
    back = ended["problem"]["context"]["way_back"]
    assert back["dz_mm"]["cam1"] < -0.5
    kept = client.get(f"{API}/calibrations/{answer['calibration_id']}").json()
    assert kept["problem"]["context"]["way_back"] == back
    test_id = client.post(f"{API}/tests", json={"name": "off"}).json()["id"]
    step = client.post(f"{API}/tests/{test_id}/steps", json={}).json()
    assert "dZ = " in step["warnings"][0]
    wait_for_job(client, client.post(f"{API}/stage/moves", json=back["move"]).json()["job"])
    assert client.post(f"{API}/tests/{test_id}/steps", json={}).json()["warnings"] == []
