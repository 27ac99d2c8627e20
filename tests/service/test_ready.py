"""Whether the service can work now, and the room that it keeps free on its disk."""

from __future__ import annotations

import time
from collections import namedtuple

import httpx
import pytest

import stereorig.server.store.folder
from stereorig.server.base.problem import JobProblem
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline
from tests.support.problems import assert_problem
from tests.support.service_rig import new_test, wait_for_job, wait_for_rig

API = "/api/v1"
Usage = namedtuple("Usage", "total used free")

pytestmark = pytest.mark.warm_worker


@pytest.fixture
def nearly_full(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        stereorig.server.store.folder.shutil, "disk_usage", lambda _: Usage(10**12, 10**12 - 10**6, 10**6)
    )


def test_it_is_ready_once_rig_worker_and_disk_are(service: Service, client: httpx.Client) -> None:
    deadline = Deadline(120.0)
    while not (answer := client.get(f"{API}/readyz")).json()["ready"]:
        assert answer.status_code == 503
        assert {reason["code"] for reason in answer.json()["reasons"]} <= {"worker_starting", "not_connected"}
        assert deadline.left
        time.sleep(0.1)
    assert answer.status_code == 200
    assert answer.json() == {"ready": True}
    assert client.get("/readyz").status_code == 200
    assert "stereorig_ready 1" in client.get("/metrics").text


def test_a_lost_rig_is_a_reason(service: Service, client: httpx.Client) -> None:
    wait_for_rig(client)
    fault = service.rig._fault
    service.rig._fault = JobProblem(code="stage_lost", detail="The controller is silent.", remedy="Look.")
    try:
        answer = client.get("/readyz")
        assert answer.status_code == 503
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["code"] == "not_ready"
        assert answer.json()["reasons"][0] == {"code": "stage_lost", "cause": "The controller is silent."}
    finally:
        service.rig._fault = fault


@pytest.mark.fault(3)
@pytest.mark.usefixtures("nearly_full")
def test_a_disk_that_is_nearly_full_takes_no_step_and_no_job_but_the_stage_still_moves(client: httpx.Client) -> None:
    wait_for_rig(client)
    test_id = new_test(client)
    problem = assert_problem(client.post(f"{API}/tests/{test_id}/steps", json={}), 507, "storage_full")
    assert "256 MiB" in problem["detail"]
    assert_problem(client.post(f"{API}/calibrations", json={}), 507, "storage_full")
    assert_problem(client.post(f"{API}/noise", json={}), 507, "storage_full")
    assert client.get(f"{API}/tests/{test_id}").json()["steps"] == []
    answer = client.get("/readyz")
    assert answer.status_code == 503
    assert [reason["code"] for reason in answer.json()["reasons"] if reason["code"] != "worker_starting"] == [
        "storage_full"
    ]
    moved = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.5}}).json()
    assert wait_for_job(client, moved["job"])["state"] == "succeeded"
    assert client.get(f"{API}/tests/{test_id}").status_code == 200
