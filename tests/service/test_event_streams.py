"""Event streams that resume: after a lost connection, after a restart, and the message to a reader that lost events."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import httpx
import pytest

from stereorig.server.jobs.events import Event, EventHub
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.store.catalog import Catalog
from stereorig.server.workflows.service import Service
from tests.support.service_rig import new_test, served, tiny_config, wait_for_job, wait_for_rig

API = "/api/v1"


def read_events(client: httpx.Client, path: str, last: int | None = None, max_events: int | None = None) -> list[Any]:
    """Read (id, name, data) until the stream ends or so many have come."""
    found: list[Any] = []
    headers = {} if last is None else {"Last-Event-ID": str(last)}
    with client.stream("GET", API + path, headers=headers) as answer:
        assert answer.status_code == 200
        fields: dict[str, str] = {}
        for line in answer.iter_lines():
            if line == "" and "data" in fields:
                found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
                fields = {}
                if max_events is not None and len(found) >= max_events:
                    break
            elif ": " in line:
                name, _, value = line.partition(": ")
                fields[name] = value
    return found


def collect(hub: EventHub, after: int, count: int) -> list[Event]:
    async def read() -> list[Event]:
        found: list[Event] = []
        async for event in hub.follow(after):
            found.append(event)
            if len(found) == count:
                break
        return found

    return asyncio.run(read())


def test_a_reader_goes_on_where_it_was() -> None:
    hub = EventHub(keep=10)
    hub.number_from(700)
    for n in range(5):
        hub.publish("step", {"n": n})
    assert [e.data["n"] for e in collect(hub, 700, 5)] == [0, 1, 2, 3, 4]
    assert [e.number for e in collect(hub, 703, 2)] == [704, 705]
    assert hub.gap(700) is None
    assert hub.gap(705) is None


@pytest.mark.parametrize("seen", [0, 650, 702, 99_999])
def test_a_reader_that_lost_events_is_told_and_gets_the_rest(seen: int) -> None:
    hub = EventHub(keep=3)
    hub.number_from(700)  # events 703 to 705 are kept
    for n in range(5):
        hub.publish("step", {"n": n})
    if seen == 702:  # the next one is the oldest that is kept
        assert [e.number for e in collect(hub, seen, 3)] == [703, 704, 705]
        return
    gap, *rest = collect(hub, seen, 4)
    assert (gap.name, gap.number, gap.data) == ("gap", 702, {"after": seen, "next": 703})
    assert [e.number for e in rest] == [703, 704, 705]


def test_a_counter_grows_over_restarts_also_where_the_clock_steps_back(tmp_path: Path) -> None:
    counts = []
    for clock in (1000, 2000, 50, 51, 3000):
        catalog = Catalog(tmp_path / "catalog.sqlite").open()
        counts.append(catalog.count_up("starts", clock))
        catalog.close()
    assert counts == [1000, 2000, 2001, 2002, 3000]


def test_a_jobs_stream_resumes_and_ends_with_the_job(client: httpx.Client, service: Service) -> None:
    before = service.hub.last_number
    job = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.7}}).json()["job"]
    wait_for_job(client, job)
    for _ in range(3):
        new_test(client)  # others' events in between
    everything = read_events(client, f"/jobs/{job['id']}/events", before)
    assert [data["id"] for _, name, data in everything if name == "job"] == [job["id"]] * len(everything)
    states = [data["state"] for _, _, data in everything]
    assert states[0] == "queued"
    assert states[-1] == "succeeded"
    middle = everything[1][0]
    assert read_events(client, f"/jobs/{job['id']}/events", middle) == everything[2:]
    # all seen: the job's end is sent once more, so that the reader has it
    last = read_events(client, f"/jobs/{job['id']}/events", service.hub.last_number)
    assert [data["state"] for _, _, data in last] == ["succeeded"]
    assert everything[-1][2]["result"]["axes"]["1"]["position_mm"] == pytest.approx(0.7, abs=0.002)


def test_progress_travels_without_the_result(client: httpx.Client, service: Service) -> None:
    def run(job: Job) -> dict[str, Any]:
        job.result = {"steps": list(range(1000))}
        for n in range(3):
            job.progress(f"stage {n}", n, 3)
        return {"done": True}

    before = service.hub.last_number
    job = service.jobs.submit("analysis", "an analysis", {}, [Phase("compute", run)])
    wait_for_job(client, {"id": job.id})
    sent = [e.data for e in service.hub.after(before) if e.name == "job"]
    assert [d["change"] for d in sent if "result" not in d] == ["progress"] * 3
    assert sent[-1]["result"]["done"] is True


def test_streams_resume_over_a_restart(tmp_path: Path) -> None:
    ids: list[int] = []
    job_id = ""
    for start in range(2):
        service = Service(tiny_config(), tmp_path / "data").start()
        try:
            with served(service) as client:
                wait_for_rig(client)
                if start == 1:
                    test_id = new_test(client)
                    gap, *rest = read_events(client, "/events", ids[-1], max_events=2)
                    assert gap[1] == "gap"
                    assert gap[2]["after"] == ids[-1] < gap[0]
                    while test_id not in str(rest):  # others may have come first
                        rest = read_events(client, "/events", rest[-1][0], max_events=1)
                    # a job of the run before, of whose end the reader has not heard
                    ((number, name, data),) = read_events(client, f"/jobs/{job_id}/events", ids[0])
                    assert (name, data["state"]) == ("job", "succeeded")
                    assert number > ids[-1]
                else:
                    job = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.2}}).json()["job"]
                    job_id = job["id"]
                    ids = [number for number, _, _ in read_events(client, f"/jobs/{job_id}/events")]
                    assert ids == sorted(set(ids))
        finally:
            service.close()
