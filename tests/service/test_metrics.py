"""Figures for Prometheus, read as another program's parser reads them."""

from __future__ import annotations

import time
from collections.abc import Callable

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from stereorig.core.errors import StageError, StorageError
from stereorig.server.base.metrics import Metrics
from stereorig.server.base.streams import Streams
from stereorig.server.workflows.service import Service
from tests.support.patience import Deadline
from tests.support.service_rig import new_test, wait_for_job, wait_for_rig

API = "/api/v1"
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]

pytestmark = pytest.mark.warm_worker


def scrape(client: httpx.Client) -> Samples:
    answer = client.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


def value(samples: Samples, name: str, **labels: str) -> float:
    return samples.get((f"stereorig_{name}", frozenset(labels.items())), 0.0)


def await_value(client: httpx.Client, name: str, wanted: Callable[[float], bool], **labels: str) -> None:
    deadline = Deadline(20.0)
    while not wanted(value(scrape(client), name, **labels)):
        assert deadline.left, value(scrape(client), name, **labels)
        time.sleep(0.05)


def test_captures_frames_jobs_and_stops_are_counted_and_timed(client: httpx.Client, service: Service) -> None:
    wait_for_rig(client)
    before = scrape(client)
    test_id = new_test(client)
    for _ in range(3):
        assert client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 201
    job = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.4}}).json()["job"]
    assert wait_for_job(client, job)["state"] == "succeeded"
    assert client.post(f"{API}/stage:stop").status_code == 200
    after = scrape(client)

    def more(name: str, **labels: str) -> float:
        return value(after, name, **labels) - value(before, name, **labels)

    assert more("capture_seconds_count", source="capture") == 3
    assert 0.0 < more("capture_seconds_sum", source="capture") < 60.0
    assert more("frames_total", camera="cam1", what="delivered") >= 3
    assert more("pairs_total", what="paired") >= 3
    assert more("jobs_finished_total", kind="move", state="succeeded") == 1
    assert more("job_seconds_count", kind="move") == 1
    assert more("job_wait_seconds_count", kind="move") == 1
    assert more("stage_stop_seconds_count") == 1
    route = "/api/v1/tests/{test_id}/steps"
    assert more("requests_total", method="POST", route=route, status="201") == 3
    assert more("request_seconds_count", method="POST", route=route) == 3
    assert value(after, "axis_position_mm", axis="1") == pytest.approx(0.4, abs=0.01)
    assert value(after, "axis_state", axis="1", state="ready") == 1
    assert value(after, "stage_up") == 1


def test_it_tells_how_things_stand(client: httpx.Client, service: Service) -> None:
    wait_for_rig(client)
    samples = scrape(client)
    assert value(samples, "disk_free_bytes") > 0
    assert value(samples, "disk_size_bytes") > value(samples, "disk_free_bytes")
    assert value(samples, "disk_reserve_bytes") == 256 * 2**20
    assert value(samples, "compute_queue_limit") == 2
    assert value(samples, "worker_starts_total") >= 1
    assert value(samples, "worker_resident_bytes") > 10e6
    assert value(samples, "uptime_seconds") > 0
    assert samples["process_resident_memory_bytes", frozenset()] > 10e6
    assert any(name == "stereorig_build_info" for name, _ in samples)


def test_a_lost_stage_is_said_and_the_rest_still_stands(
    client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_for_rig(client)

    def silent() -> dict[str, object]:
        raise StageError("The controller is silent.", code="stage_lost")

    monkeypatch.setattr(service.rig, "describe_stage", silent)
    samples = scrape(client)
    assert samples["stereorig_stage_up", frozenset()] == 0
    assert not any(name == "stereorig_axis_position_mm" for name, _ in samples)
    assert value(samples, "disk_free_bytes") > 0


def test_without_a_rig_its_figures_are_missing_and_not_zero(
    client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_for_rig(client)
    monkeypatch.setattr(service.rig, "_devices", None)
    samples = scrape(client)
    assert not any(name in ("stereorig_frames_total", "stereorig_pairs_total") for name, _ in samples)
    assert value(samples, "uptime_seconds") > 0


def test_a_capture_that_fails_is_counted_by_its_code(
    client: httpx.Client, service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    wait_for_rig(client)
    test_id = new_test(client)

    def full(_reserve: float) -> None:
        raise StorageError("No room.", code="storage_full")

    before = value(scrape(client), "captures_failed_total", source="capture", code="storage_full")
    monkeypatch.setattr(service.folder, "require_room", full)
    assert client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 507
    assert value(scrape(client), "captures_failed_total", source="capture", code="storage_full") == before + 1


def test_what_a_client_makes_up_becomes_no_label(client: httpx.Client) -> None:
    for path in ("/made/up", "/..%2f", f"{API}/tests/whatever/steps", f"{API}/jobs/x{'y' * 30}"):
        client.get(path)
    client.request("BREW", f"{API}/rig")
    labels = {pair for _, pairs in scrape(client) for pair in pairs}
    assert not any(part in text for _, text in labels for part in ("made", "whatever", "BREW", "yyy"))
    assert ("route", "none") in labels
    assert ("route", "/api/v1/jobs/{job_id}") in labels
    assert ("method", "other") in labels


def test_open_streams_are_counted_and_one_too_many_is_refused(client: httpx.Client, service: Service) -> None:
    wait_for_rig(client)
    service.streams = Streams(live_view=1, events=1)
    try:
        for kind, path in (("events", "/events"), ("live_view", "/cameras/cam1/stream.mjpg")):
            with client.stream("GET", f"{API}{path}") as first:
                assert first.status_code == 200
                await_value(client, "streams", lambda n: n == 1.0, kind=kind)
                refused = client.get(f"{API}{path}")
                assert refused.status_code == 503
                assert refused.json()["code"] == "too_many_streams"
                assert int(refused.headers["retry-after"]) >= 1
            await_value(client, "streams", lambda n: n == 0.0, kind=kind)  # the client went away
    finally:
        service.streams = Streams(live_view=8, events=200)


def test_a_job_is_timed_from_its_start_and_counted_once() -> None:
    metrics = Metrics()
    for state in ("queued", "running", "running", "succeeded", "succeeded"):
        metrics.on_event("job", {"id": "j000001-abcdef", "kind": "analysis", "state": state})
    metrics.on_event("job", {"id": "j000002-abcdef", "kind": "analysis", "state": "queued"})
    metrics.on_event("job", {"id": "j000002-abcdef", "kind": "analysis", "state": "cancelled"})
    text = metrics.text().decode()
    assert 'stereorig_jobs_finished_total{kind="analysis",state="succeeded"} 1.0' in text
    assert 'stereorig_jobs_finished_total{kind="analysis",state="cancelled"} 1.0' in text
    assert 'stereorig_job_seconds_count{kind="analysis"} 1.0' in text  # one that never began took no time
