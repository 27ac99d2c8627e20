"""What a load frame's script relies on: steps with its own time and channels, bursts, watches, keys."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from stereorig.core.errors import CameraError, StorageError
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline, busy
from tests.support.service_rig import a_second, new_test, served, tiny_config, wait_for_job, wait_for_rig

API = "/api/v1"


def refused(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    body: dict[str, Any] = answer.json()
    assert body["code"] == code
    return body


def steps_of(client: httpx.Client, test_id: str) -> list[int]:
    return [s["n"] for s in client.get(f"{API}/tests/{test_id}/steps").json()["steps"]]


def test_a_cameras_temperature_is_kept_with_a_step_and_that_of_one_that_reports_none_is_not_known(
    client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    test_id, unit = new_test(client), service.rig.pair.units["cam1"]
    monkeypatch.setattr(unit, "_description", replace(unit.description, temperature_c=36.5))
    assert client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 201
    quality = client.get(f"{API}/tests/{test_id}/steps/0").json()["quality"]
    assert (quality["cam1"]["temperature_c"], quality["cam2"].get("temperature_c")) == (36.5, None)
    kept = json.loads((service.tests.path(test_id) / "steps" / "0000" / "step.json").read_text())["quality"]
    assert ("temperature_c" in kept["cam1"], "temperature_c" in kept["cam2"]) == (True, False)


def test_a_step_keeps_the_clients_time_and_channels_and_tells_what_it_is_worth(
    client: httpx.Client, service: Service
) -> None:
    test_id = new_test(client)
    body = {
        "label": "1.25 kN",
        "load_n": 1250.0,
        "timestamp_utc": "2026-03-01T14:00:00.25+02:00",
        "channels": {"stroke_mm": 0.42, "Temperatur °C": 21.3},
    }
    answer = client.post(f"{API}/tests/{test_id}/steps", json=body)
    assert answer.status_code == 201, answer.text
    step = answer.json()
    assert step["timestamp_utc"] == "2026-03-01T12:00:00.250000Z"
    assert step["channels"] == {"stroke_mm": 0.42, "Temperatur °C": 21.3}
    assert client.get(f"{API}/tests/{test_id}/steps/0").json() == step
    quality = step["quality"]
    assert quality["code"] == "ok"
    assert abs(quality["skew_ms"]) <= quality["max_skew_ms"] == 1.0
    pairs = quality["pairs"]
    assert pairs["triggered"] == pairs["paired"] == 1
    assert pairs["unpaired"] == pairs["incomplete"] == pairs["dropped"] == 0
    for cam in ("cam1", "cam2"):
        own = quality[cam]
        assert own["exposure_ms"] == 10.0
        assert 0.1 < own["mean_share"] < 1.0
        assert own["mean_share"] == pytest.approx(own["mean_grey"] / 255.0, abs=1e-4)
        assert own["saturated_share"] == 0.0
        assert own["focus"] > 0.12
        assert own["texture_grey_per_px"] > 1.0
        assert own["frames"]["delivered"] >= 1
        assert own["frames"]["dropped"] == 0
        content = client.get(f"{API}/tests/{test_id}/steps/0/{cam}").content
        assert hashlib.sha256(content).hexdigest() == step["sha256"][cam]


@pytest.mark.fault(48)
def test_a_pair_that_cannot_be_measured_says_so_at_its_top_with_what_to_do(client: httpx.Client) -> None:
    test_id = new_test(client)
    client.patch(f"{API}/cameras/cam2", json={"exposure_ms": 0.01}).raise_for_status()
    try:
        step = client.post(f"{API}/tests/{test_id}/steps", json={}).json()
    finally:
        client.patch(f"{API}/cameras/cam2", json={"exposure_ms": 10.0}).raise_for_status()
    assert step["quality"]["cam2"]["code"] == "dark"
    [told] = [text for text in step["warnings"] if text.startswith("cam2: it is too dark")]
    assert told.endswith("Check lens cap, light, exposure.")
    assert client.get(f"{API}/tests/{test_id}/steps/0").json()["warnings"] == step["warnings"]
    again = client.post(f"{API}/tests/{test_id}/steps", json={}).json()
    assert [text for text in again["warnings"] if text.startswith("cam2: it is too dark")] == []


@pytest.mark.parametrize(
    "change",
    [
        {"timestamp_utc": "2026-03-01T12:00:00"},
        {"timestamp_utc": 1772366400},
        {"timestamp_utc": "yesterday"},
        {"timestamp_utc": "0001-01-01T00:00:00+23:00"},
        {"channels": {"": 1.0}},
        {"channels": {"force": "12"}},
        {"channels": {"force": None}},
        {"channels": {f"c{i}": 1.0 for i in range(51)}},
        {"count": 0},
        {"count": 10001},
        {"count": 2, "interval_ms": -1},
        {"interval_ms": "fast"},
        {"count": 2.5},
    ],
)
def test_what_a_step_cannot_be_is_refused_by_name(client: httpx.Client, change: dict[str, Any]) -> None:
    test_id = new_test(client)
    problem = refused(client.post(f"{API}/tests/{test_id}/steps", json=change), 422, "invalid_request")
    named = [field["field"].split(".")[0] for field in problem["fields"]]
    assert set(named) <= set(change)
    assert steps_of(client, test_id) == []


# bursts ---------------------------------------------------------------------------------------------------------


def test_a_burst_takes_its_steps_at_the_interval_and_tells_each(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    before = service.hub.last_number
    answer = client.post(f"{API}/tests/{test_id}/steps", json={"label": "b", "count": 4, "interval_ms": 250.0})
    assert answer.status_code == 202, answer.text
    job = answer.json()["job"]
    refused(client.post(f"{API}/tests/{test_id}/steps", json={}), 409, "hardware_busy")
    done = wait_for_job(client, job)
    assert done["state"] == "succeeded", done["problem"]
    assert done["kind"] == "burst"
    assert [s["index"] for s in done["result"]["steps"]] == [0, 1, 2, 3]
    assert [s["n"] for s in done["result"]["steps"]] == [0, 1, 2, 3] == steps_of(client, test_id)
    for listed in done["result"]["steps"]:
        step = client.get(f"{API}/tests/{test_id}/steps/{listed['n']}").json()
        assert step["sha256"] == listed["sha256"]
        assert step["label"] == "b"
        assert step["burst"]["job_id"] == job["id"]
    since = [s["since_first_ms"] for s in done["result"]["steps"]]
    assert since[0] == 0.0
    assert since[3] >= 3 * 250.0 - 60.0 * busy()  # the first may have begun a little late
    events = [e for e in service.hub.after(before) if e.name == "step"]
    assert [e.data["n"] for e in events] == [0, 1, 2, 3]
    assert {e.data["job_id"] for e in events} == {job["id"]}


def test_an_attached_burst_answers_when_it_has_ended(client: httpx.Client) -> None:
    test_id = new_test(client)
    answer = client.post(f"{API}/tests/{test_id}/steps", params={"attached": True}, json={"count": 2})
    assert answer.status_code == 202
    assert answer.json()["job"]["state"] == "succeeded"
    assert steps_of(client, test_id) == [0, 1]


@pytest.mark.fault(16)
def test_a_burst_goes_on_after_a_pair_that_is_refused_and_says_which(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    pair, capture, calls = service.rig.pair, service.rig.pair.capture, 0

    def capture_or_refuse(*args: Any, **more: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise CameraError("3 ms apart", code="skew_too_large", skew_ms=3.0)
        return capture(*args, **more)

    pair.capture = capture_or_refuse  # type: ignore[method-assign]
    try:
        answer = client.post(f"{API}/tests/{test_id}/steps", params={"attached": True}, json={"count": 3})
    finally:
        del pair.capture  # type: ignore[method-assign]
    job = answer.json()["job"]
    assert job["state"] == "failed"
    assert job["problem"]["code"] == "burst_incomplete"
    assert job["problem"]["context"]["failed"] == [1]
    assert [s["index"] for s in job["result"]["steps"]] == [0, 2]
    assert [f["index"] for f in job["result"]["failures"]] == [1]
    assert job["result"]["failures"][0]["problem"]["code"] == "skew_too_large"
    assert steps_of(client, test_id) == [0, 1]


@pytest.mark.fault(3)
def test_a_burst_ends_where_the_disk_fails_and_what_it_told_is_there(
    client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    test_id = new_test(client)
    add, calls = service.tests.steps.add_some, 0

    def add_or_fail(*args: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise StorageError("No space left.", code="storage_full")
        return add(*args)

    monkeypatch.setattr(service.tests.steps, "add_some", add_or_fail)
    job = client.post(f"{API}/tests/{test_id}/steps", params={"attached": True}, json={"count": 5}).json()["job"]
    assert (job["state"], job["problem"]["code"]) == ("failed", "storage_full")
    assert [s["n"] for s in job["result"]["steps"]] == [0, 1] == steps_of(client, test_id)


@pytest.mark.fault(43)
def test_a_burst_is_cancelled_within_a_second_and_keeps_its_steps(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    job = client.post(f"{API}/tests/{test_id}/steps", json={"count": 1000, "interval_ms": 30000.0}).json()["job"]
    deadline = Deadline(20.0)
    while not steps_of(client, test_id) and deadline.left:
        time.sleep(0.02)
    limit = a_second(client)
    asked = time.monotonic()
    assert client.post(f"{API}/jobs/{job['id']}:cancel").status_code == 202
    done = wait_for_job(client, job)
    assert time.monotonic() - asked < limit
    assert done["state"] == "cancelled"
    assert [s["n"] for s in done["result"]["steps"]] == [0] == steps_of(client, test_id)
    assert service.hardware.holder is None


# watches --------------------------------------------------------------------------------------------------------


def test_a_watched_channel_takes_a_step_at_each_change(client: httpx.Client) -> None:
    test_id = new_test(client)
    url = f"{API}/tests/{test_id}"
    refused(client.get(f"{url}/watch"), 404, "not_found")
    refused(client.post(f"{url}/channels", json={"channels": {"force_n": 0.0}}), 409, "watch_off")
    watch = client.put(f"{url}/watch", json={"channel": "force_n", "threshold": 100.0, "label": "ramp"}).json()
    assert (watch["active"], watch["last_value"]) == (True, None)
    answers = []
    for force in (0.0, 60.0, 99.9, 100.0, 150.0, 201.0, 150.0, 100.9, 101.0):
        reading = {"channels": {"force_n": force, "stroke_mm": force / 1000.0}, "timestamp_utc": "2026-03-01T12:00:00Z"}
        answer = client.post(f"{url}/channels", json=reading)
        answers.append((answer.status_code, answer.json()["reason"]))
        assert (answer.status_code == 201) == answer.json()["taken"] == (answer.json()["step"] is not None)
    below = (200, "below_threshold")
    changed = (201, "changed")
    # compared with the last step, not the last reading: small changes add up
    assert answers == [(201, "first"), below, below, changed, below, changed, below, changed, below]
    steps = [client.get(f"{url}/steps/{n}").json() for n in steps_of(client, test_id)]
    assert [s["channels"]["force_n"] for s in steps] == [0.0, 100.0, 201.0, 100.9]
    assert steps[1]["channels"]["stroke_mm"] == 0.1
    assert steps[1]["timestamp_utc"] == "2026-03-01T12:00:00.000000Z"
    assert {s["label"] for s in steps} == {"ramp"}
    absent = client.post(f"{url}/channels", json={"channels": {"stroke_mm": 9.0}})
    assert (absent.status_code, absent.json()["reason"]) == (200, "channel_absent")
    shown = client.get(f"{url}/watch").json()
    assert (shown["last_value"], shown["last_step"]) == (100.9, 3)
    assert client.post(f"{url}/watch:end").json()["active"] is False
    assert client.post(f"{url}/watch:end").json()["active"] is False
    refused(client.post(f"{url}/channels", json={"channels": {"force_n": 999.0}}), 409, "watch_off")
    assert len(steps_of(client, test_id)) == 4


def test_the_load_can_be_watched_and_a_threshold_of_zero_takes_every_difference(client: httpx.Client) -> None:
    test_id = new_test(client)
    url = f"{API}/tests/{test_id}"
    client.post(f"{url}/steps", json={"load_n": 5.0})  # a step like any other: it is compared with
    client.put(f"{url}/watch", json={"channel": "load_n", "threshold": 0.0})
    taken = [client.post(f"{url}/channels", json={"load_n": load}).json()["taken"] for load in (5.0, 5.1, 5.1, 5.0)]
    assert taken == [False, True, False, True]


def test_a_reading_that_met_an_error_asks_again(client: httpx.Client, service: Service) -> None:
    test_id = new_test(client)
    url = f"{API}/tests/{test_id}"
    client.put(f"{url}/watch", json={"channel": "force_n", "threshold": 1.0})
    key = {"Idempotency-Key": f"reading {test_id}"}
    with service.hardware.hold("somebody else"):
        busy = client.post(f"{url}/channels", json={"channels": {"force_n": 7.0}}, headers=key)
        refused(busy, 409, "hardware_busy")
    first = client.post(f"{url}/channels", json={"channels": {"force_n": 7.0}}, headers=key)
    again = client.post(f"{url}/channels", json={"channels": {"force_n": 7.0}}, headers=key)
    assert first.status_code == again.status_code == 201
    assert first.json() == again.json()
    assert len(steps_of(client, test_id)) == 1


@pytest.mark.fault(48)
@pytest.mark.parametrize(
    "body",
    [
        {},
        {"channel": "x"},
        {"channel": "x", "threshold": -1},
        {"channel": "x", "threshold": "1"},
        {"channel": "", "threshold": 1},
        {"channel": "x", "threshold": 1, "frames": 0},
    ],
)
def test_watches_that_cannot_be_are_refused(client: httpx.Client, body: dict[str, Any]) -> None:
    test_id = new_test(client)
    refused(client.put(f"{API}/tests/{test_id}/watch", json=body), 422, "invalid_request")


# one effect -----------------------------------------------------------------------------------------------------


@pytest.fixture
def again(tmp_path: Path) -> Iterator[Any]:
    """Start the service on the same data folder, as often as wanted."""
    running: list[Any] = []

    def start() -> tuple[Service, httpx.Client]:
        stop()
        service = Service(tiny_config(), tmp_path / "data").start()
        context = served(service)
        client = context.__enter__()
        running[:] = [service, context]
        wait_for_rig(client)
        return service, client

    def stop() -> None:
        if running:
            service, context = running
            running.clear()
            context.__exit__(None, None, None)
            service.close()

    start.stop = stop  # type: ignore[attr-defined]
    yield start
    stop()


@pytest.mark.fault(49)
@pytest.mark.parametrize("catalogue", ["kept", "lost"])
def test_everything_that_is_made_is_made_once_also_after_a_restart(again: Any, tmp_path: Path, catalogue: str) -> None:
    _, client = again()
    test_id = new_test(client)
    url = f"/tests/{test_id}"
    client.put(f"{API}{url}/watch", json={"channel": "load_n", "threshold": 1.0})
    asked: list[tuple[str, dict[str, Any]]] = [
        ("/tests", {"name": "made once"}),
        (f"{url}/steps", {"label": "one", "load_n": 1.0}),
        (f"{url}/steps", {"label": "many", "count": 3}),
        (f"{url}/channels", {"load_n": 5.0}),
        ("/noise", {"frames": 8}),
    ]
    answers: list[dict[str, Any]] = []
    for k, (path, body) in enumerate(asked):
        answer = client.post(API + path, json=body, headers={"Idempotency-Key": f"key {k}"})
        assert answer.status_code in (201, 202), answer.text
        answers.append(answer.json())
        if "job" in answers[-1]:
            wait_for_job(client, answers[-1]["job"])
    counts = (
        len(client.get(f"{API}/tests").json()["tests"]),
        len(steps_of(client, test_id)),
        len(client.get(f"{API}/noise").json()["noise"]),
    )
    assert counts == (2, 5, 1)
    again.stop()
    if catalogue == "lost":
        for path in (tmp_path / "data").glob("catalog.sqlite*"):
            path.unlink()
    _, client = again()
    for k, (path, body) in enumerate(asked):
        key = {"Idempotency-Key": f"key {k}"}
        answer = client.post(API + path, json=body, headers=key)
        assert answer.status_code in (201, 202), answer.text
        now, then = answer.json(), answers[k]
        if "job" in then:
            assert now["job"]["id"] == then["job"]["id"]
            assert now["job"]["state"] == client.get(f"{API}/jobs/{then['job']['id']}").json()["state"]
            now, then = {**now, "job": None}, {**then, "job": None}
        assert now == then
        refused(
            client.post(API + path, json={**body, "label": "other"}, headers=key),
            *((422, "invalid_request") if path == "/tests" else (409, "idempotency_key_reused")),
        )
    assert counts == (
        len(client.get(f"{API}/tests").json()["tests"]),
        len(steps_of(client, test_id)),
        len(client.get(f"{API}/noise").json()["noise"]),
    )
    # the watch lives on, with its last step
    shown = client.get(f"{API}{url}/watch").json()
    assert (shown["active"], shown["last_value"]) == (True, 5.0)
    assert client.post(f"{API}{url}/channels", json={"load_n": 5.5}).json()["taken"] is False


@pytest.mark.fault(49)
def test_a_step_whose_key_could_not_be_written_is_not_taken_twice(
    client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    test_id = new_test(client)
    key = {"Idempotency-Key": f"unwritten {test_id}"}

    def fails(*_: object) -> None:
        raise StorageError("No space left.", code="storage_full")

    with monkeypatch.context() as patch:
        patch.setattr(service.catalog, "put_request", fails)
        first = client.post(f"{API}/tests/{test_id}/steps", json={}, headers=key)
    assert first.status_code == 201, first.text
    assert client.post(f"{API}/tests/{test_id}/steps", json={}, headers=key).json() == first.json()
    assert steps_of(client, test_id) == [0]
