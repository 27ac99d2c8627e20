"""Computations that wait: no more than the rig file allows, and one too many is refused with a time to retry."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from stereorig.server.workflows.service import Service
from tests.support.copied_tests import write_test_folder
from tests.support.patience import Deadline
from tests.support.service_rig import served, tiny_config, wait_for_job, wait_for_rig

API = "/api/v1"
TEST = "t000007-abcdef"
WAITING = 2  # compute_queue of the tiny rig
BODY: dict[str, Any] = {"region": {"rectangle": [25, 25, 130, 115]}, "subset_px": 21, "spacing_px": 2, "strain": None}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    data = tmp_path_factory.mktemp("queue") / "data"
    write_test_folder(data / "tests" / TEST, 30)
    service = Service(tiny_config(), data).start()
    try:
        with served(service) as made:
            wait_for_rig(made)
            yield made
    finally:
        service.close()


@pytest.fixture
def jobs(client: httpx.Client) -> Iterator[list[dict[str, Any]]]:
    """One analysis that runs and as many as may wait; ended afterwards."""
    made: list[dict[str, Any]] = []
    for _ in range(1 + WAITING):
        answer = client.post(f"{API}/tests/{TEST}/analyses", json=BODY)
        assert answer.status_code == 202, answer.text
        made.append(answer.json()["job"])
        deadline = Deadline(60.0)
        while client.get(f"{API}/jobs/{made[0]['id']}").json()["state"] == "queued":  # the first one leaves the queue
            assert deadline.left
            time.sleep(0.01)
    yield made
    for job in made:
        client.post(f"{API}/jobs/{job['id']}:cancel")
    for job in made:
        wait_for_job(client, job)


@pytest.mark.fault(26)
@pytest.mark.parametrize("operation", ["analyses", "calibrations", "noise"])
def test_one_too_many_is_told_when_to_come_again(
    client: httpx.Client, jobs: list[dict[str, Any]], operation: str
) -> None:
    path, body = {
        "analyses": (f"/tests/{TEST}/analyses", BODY),
        "calibrations": ("/calibrations", {"positions_mm": [0.0, 5.0]}),
        "noise": ("/noise", {"frames": 2}),
    }[operation]
    before = {kind: client.get(f"{API}/{kind}").json()[kind] for kind in ("calibrations", "noise", "jobs")}
    analyses = client.get(f"{API}/tests/{TEST}/analyses").json()["analyses"]
    refused = client.post(API + path, json=body, headers={"Idempotency-Key": f"again {operation}"})
    assert refused.status_code == 503, refused.text
    assert refused.headers["content-type"] == "application/problem+json"
    assert int(refused.headers["retry-after"]) >= 1
    assert refused.json()["code"] == "queue_full"
    assert "Retry-After" in refused.json()["remedy"]
    # nothing was begun, and the hardware is free
    assert {kind: len(client.get(f"{API}/{kind}").json()[kind]) for kind in before} == {
        kind: len(found) for kind, found in before.items()
    }
    assert client.get(f"{API}/tests/{TEST}/analyses").json()["analyses"] == analyses
    assert client.get(f"{API}/rig").json()["holder"] is None
    # what is no computation goes on: the stage moves, and stops
    moved = client.post(f"{API}/stage/moves", json={"by_mm": {"1": 0.1}})
    assert moved.status_code == 202, moved.text
    assert client.post(f"{API}/stage:stop").status_code == 200
    wait_for_job(client, moved.json()["job"])
    # the same request again, with its key, once there is room
    client.post(f"{API}/jobs/{jobs[-1]['id']}:cancel").raise_for_status()
    wait_for_job(client, jobs[-1])
    taken = client.post(API + path, json=body, headers={"Idempotency-Key": f"again {operation}"})
    assert taken.status_code == 202, taken.text
    client.post(f"{API}/jobs/{taken.json()['job']['id']}:cancel")
    wait_for_job(client, taken.json()["job"])


def test_the_operations_that_may_be_told_so_say_it(client: httpx.Client) -> None:
    described = client.get(f"{API}/openapi.json").json()["paths"]
    for path in ("/tests/{test_id}/analyses", "/calibrations", "/noise"):
        response = described[API + path]["post"]["responses"]["503"]
        assert "Retry-After" in response["description"]
        assert response["headers"]["Retry-After"]["schema"] == {"type": "integer", "minimum": 1}


def test_the_folder_is_as_before(client: httpx.Client) -> None:
    """No analysis was left behind by what was refused."""
    listed = client.get(f"{API}/tests/{TEST}/analyses").json()["analyses"]
    states = {client.get(f"{API}/tests/{TEST}/analyses/{a['id']}").json()["state"] for a in listed}
    assert states <= {"cancelled", "succeeded"}
