"""What spares a script its loops: waiting for a job in the request, one word for a cause, the calibration in force."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from stereorig.core.errors import MeasurementError
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.service import Service
from tests.support.problems import assert_problem
from tests.support.service_rig import TINY, true_cameras

API = "/api/v1"


@pytest.fixture
def held(service: Service) -> Iterator[tuple[str, threading.Event]]:
    """A job that works until it is let go."""
    go = threading.Event()

    def run(job: Job) -> dict[str, Any]:
        while not go.wait(0.01):
            job.check()
        return {"answer": 42}

    job = service.jobs.submit("analysis", "an analysis", {}, [Phase("compute", run)])
    yield job.id, go
    go.set()


def test_a_wait_ends_with_the_job(client: httpx.Client, held: tuple[str, threading.Event]) -> None:
    job_id, go = held
    threading.Timer(0.3, go.set).start()
    began = time.monotonic()
    done = client.get(f"{API}/jobs/{job_id}", params={"wait": 30}).json()
    assert (done["state"], done["result"]) == ("succeeded", {"answer": 42})
    assert time.monotonic() - began < 15.0  # half of the wait: it did not wait to its end


def test_a_wait_ends_with_its_time(client: httpx.Client, held: tuple[str, threading.Event]) -> None:
    job_id, _ = held
    began = time.monotonic()
    shown = client.get(f"{API}/jobs/{job_id}", params={"wait": 0.3}).json()
    assert shown["state"] in ("queued", "running")
    assert time.monotonic() - began >= 0.3


def test_a_cancel_waits_for_the_end(client: httpx.Client, held: tuple[str, threading.Event]) -> None:
    job_id, _ = held
    assert client.post(f"{API}/jobs/{job_id}:cancel", params={"wait": 30}).json()["state"] == "cancelled"
    assert client.get(f"{API}/jobs/{job_id}", params={"wait": 30}).json()["state"] == "cancelled"


@pytest.mark.parametrize("wait", [-1, 61, "nan", "long"])
def test_a_wait_that_cannot_be_is_refused(client: httpx.Client, wait: object) -> None:
    problem = assert_problem(client.get(f"{API}/jobs/j000001-abcdef", params={"wait": wait}), 422, "invalid_request")
    assert problem["fields"][0]["field"] == "wait"


def test_what_starts_a_job_waits_for_it(client: httpx.Client) -> None:
    home = client.post(f"{API}/stage:home", params={"wait": 60}).json()["job"]
    assert home["state"] == "succeeded"
    moved = client.post(f"{API}/stage/moves", params={"wait": 60}, json={"positions_mm": {"1": 0.5}}).json()["job"]
    assert moved["result"]["axes"]["1"]["position_mm"] == pytest.approx(0.5, abs=1e-3)
    assert client.post(f"{API}/stage/moves", params={"wait": 60}, json={"positions_mm": {"1": 0.0}}).is_success


def test_a_cause_has_one_name_in_requests_and_jobs(client: httpx.Client, service: Service) -> None:
    def run(_: Job) -> None:
        raise MeasurementError("Nothing matched.", code="not_seeded", remedy="Look.")

    job = service.jobs.submit("analysis", "an analysis", {}, [Phase("compute", run)])
    of_job = client.get(f"{API}/jobs/{job.id}", params={"wait": 30}).json()["problem"]
    assert of_job["detail"] == "Nothing matched."
    of_request = client.get(f"{API}/jobs/nothing").json()
    assert {"code", "detail", "remedy"} <= set(of_job) & set(of_request)


# calibrations --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def calibrations(client: httpx.Client) -> dict[str, str]:
    """One accepted, one not decided on, one cancelled, in this order."""
    made = {}
    file = json.dumps(true_cameras(TINY))
    for name in ("accepted", "undecided"):
        made[name] = client.post(f"{API}/calibrations:import", files={"file": ("true.json", file)}).json()["id"]
    url = f"{API}/calibrations/{made['accepted']}/review"
    assert client.put(url, json={"decision": "accepted"}).status_code == 200
    begun = client.post(f"{API}/calibrations").json()
    made["cancelled"] = begun["calibration_id"]
    ended = client.post(f"{API}/jobs/{begun['job']['id']}:cancel", params={"wait": 60}).json()
    assert ended["state"] == "cancelled"
    return made


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({"accepted": True}, ["accepted"]),
        ({"accepted": False}, ["undecided", "cancelled"]),
        ({"state": "complete"}, ["accepted", "undecided"]),
        ({"state": "cancelled"}, ["cancelled"]),
        ({"state": "complete", "accepted": False}, ["undecided"]),
        ({"state": "failed"}, []),
    ],
)
def test_calibrations_are_listed_by_decision_and_state(
    client: httpx.Client, calibrations: dict[str, str], asked: dict[str, Any], expected: list[str]
) -> None:
    listed = client.get(f"{API}/calibrations", params=asked).json()["calibrations"]
    assert [one["id"] for one in listed] == [calibrations[name] for name in expected]


def test_a_filter_holds_from_page_to_page(client: httpx.Client, calibrations: dict[str, str]) -> None:
    first = client.get(f"{API}/calibrations", params={"state": "complete", "limit": 1})
    assert [one["id"] for one in first.json()["calibrations"]] == [calibrations["accepted"]]
    second = client.get(first.headers["Link"].partition("<")[2].partition(">")[0]).json()
    assert [one["id"] for one in second["calibrations"]] == [calibrations["undecided"]]
    assert second["next_cursor"] is None


def test_latest_is_the_newest_accepted_whatever_was_begun_since(
    client: httpx.Client, calibrations: dict[str, str]
) -> None:
    made = client.post(f"{API}/tests", json={"name": "a test", "calibration_id": "latest"})
    assert made.status_code == 201, made.text
    assert made.json()["calibration_id"] == calibrations["accepted"]


def test_a_cancelled_calibration_is_called_so_everywhere(client: httpx.Client, calibrations: dict[str, str]) -> None:
    one = client.get(f"{API}/calibrations/{calibrations['cancelled']}").json()
    assert (one["state"], one["problem"]["code"]) == ("cancelled", "cancelled")
    refused = client.post(f"{API}/tests", json={"name": "x", "calibration_id": calibrations["cancelled"]})
    assert "is cancelled" in assert_problem(refused, 409, "calibration_not_complete")["detail"]


# addresses -----------------------------------------------------------------------------------------------------------


def test_every_verb_stands_after_a_colon(client: httpx.Client) -> None:
    verbs = {"cancel", "restore", "stop", "abort", "home", "enable", "disable", "reconnect", "exported", "import"}
    paths = client.get(f"{API}/openapi.json").json()["paths"]
    assert not [path for path in paths if path.rpartition("/")[2] in verbs | {"leave-configuration", "finish"}]


def test_another_client_reads_in_words_what_holds_the_hardware(client: httpx.Client) -> None:
    moving = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 4.0, "2": -4.0}}).json()["job"]
    refused = assert_problem(client.post(f"{API}/stage:home"), 409, "hardware_busy")
    assert refused["detail"] == "The hardware is held by a move of axis 1 to 4 mm and axis 2 to -4 mm."
    client.post(f"{API}/jobs/{moving['id']}:cancel", params={"wait": 30})
