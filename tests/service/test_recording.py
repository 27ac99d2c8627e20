"""A recording: pairs at the full rate in memory, kept as steps around a trigger, each accounted for."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from stereorig.server.config.rig_file import parse_config
from stereorig.server.workflows.service import Service
from tests.service.test_read_channels import Instrument, await_readings, channel
from tests.support.service_rig import data_of, new_test, served, wait_for_job, wait_for_rig
from tests.support.stage_service import wait_until
from tests.support.tiny_rig import TINY

API = "/api/v1"
CYCLE_S = 2.5  # readings that a busy machine sends late by a tenth of a second are 14 degrees late
LINE = "max_skew_ms = 1.0"
# two free cameras of the simulated rig begin at whatever time each was armed
FREE = 'max_skew_ms = 20.0\ntrigger = "free"\nframe_rate_hz = 50.0'


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, Service]]:
    def force(at_s: float) -> str:
        return f"{100.0 * math.cos(2.0 * math.pi * at_s / CYCLE_S):.3f}"

    with Instrument(force) as one, Instrument(lambda at_s: f"{at_s:.4f}") as two:
        text = TINY.replace(LINE, FREE).replace(
            "[sim]\n", f"{channel('force', one)}{channel('clock', two)}\n[sim]\n", 1
        )
        with (
            Service(parse_config(text), data_of(tmp_path_factory.mktemp("record"))) as service,
            served(service) as client,
        ):
            wait_for_rig(client)
            await_readings(client, 10, "force", "clock")
            yield client, service


def recorded(client: httpx.Client, test_id: str, **plan: Any) -> dict[str, Any]:
    answer = client.post(f"{API}/tests/{test_id}/record", json=plan)
    assert answer.status_code == 202, answer.text
    job = wait_for_job(client, answer.json()["job"])
    assert job["state"] == "succeeded", job
    result: dict[str, Any] = job["result"]
    return result


def accounted(result: dict[str, Any]) -> dict[str, Any]:
    account: dict[str, Any] = result["account"]
    assert account["pairs"] == account["kept"] + account["not_chosen"] + sum(account["dropped"].values())
    assert account["kept"] == result.get("n_steps", len(result["steps"]))
    return account


def test_pairs_around_a_level_are_kept_with_their_channels(rig: tuple[httpx.Client, Service]) -> None:
    client, service = rig
    test_id = new_test(client)
    level = time.monotonic() + 1.5
    trigger = {"kind": "level", "channel": "clock", "level": level}
    account = accounted(recorded(client, test_id, trigger=trigger, before_s=0.5, after_s=1.0))
    steps = [service.tests.steps.read(test_id, n).document for n in service.tests.steps.numbers(test_id)]
    assert account["kept"] == len(steps)
    bursts = [step.burst for step in steps if step.burst is not None]
    assert [burst.pair for burst in bursts] == sorted(burst.pair or 0 for burst in bursts)
    times = [burst.trigger_ms or 0.0 for burst in bursts]
    # a busy machine loses frames of the simulated cameras before they are in memory; those that are there are kept
    assert -500.0 <= times[0] < -300.0
    assert 800.0 < times[-1] <= 1000.0
    for step, at_ms in zip(steps, times, strict=True):
        assert abs(step.channels["clock"] - level - at_ms / 1e3) < 0.02 + 5.0 * step.channel_u["clock"]


def test_a_call_triggers_and_the_second_before_it_is_there(rig: tuple[httpx.Client, Service]) -> None:
    client, _ = rig
    test_id = new_test(client)
    assert client.post(f"{API}/tests/{test_id}/record:trigger").json()["code"] == "no_recording"
    job = client.post(f"{API}/tests/{test_id}/record", json={"before_s": 0.4, "after_s": 0.2, "label": "bang"}).json()
    time.sleep(1.0)
    assert client.post(f"{API}/tests/{test_id}/record:trigger").status_code == 200
    result = wait_for_job(client, job["job"])["result"]
    accounted(result)
    assert result["steps"][0]["trigger_ms"] < -200.0
    assert client.get(f"{API}/tests/{test_id}/steps/0").json()["label"] == "bang"


@pytest.mark.parametrize(
    ("trigger", "value"),
    [
        ({"kind": "peak"}, 100.0),
        ({"kind": "valley", "every": 2}, -100.0),
        ({"kind": "phase", "phases_deg": [90.0]}, 0.0),
    ],
)
def test_pairs_at_cycles_of_a_channel_are_kept(
    rig: tuple[httpx.Client, Service], trigger: dict[str, Any], value: float
) -> None:
    client, service = rig
    test_id = new_test(client)
    trigger = {**trigger, "channel": "force"}
    account = accounted(recorded(client, test_id, trigger=trigger, before_s=6.0, after_s=11.0))
    steps = [service.tests.steps.read(test_id, n).document for n in service.tests.steps.numbers(test_id)]
    # on a busy machine a moment may find no pair, or none any more; then that is said
    assert 1 <= len(steps) <= 6
    assert len(steps) + account["moments_without_pair"] + sum(account["dropped"].values()) >= 2
    starts = [step.burst.since_first_ms for step in steps if step.burst is not None]
    every = trigger.get("every", 1) * 1e3 * CYCLE_S
    assert all(abs(at_ms / every - round(at_ms / every)) < 0.1 for at_ms in starts)
    assert all(abs(step.channels["force"] - value) < 50.0 for step in steps)


def test_a_recording_without_a_duration_is_bounded_and_its_answer_has_the_limits(
    rig: tuple[httpx.Client, Service],
) -> None:
    client, _ = rig
    for plan, after_s in (({}, 10.0), ({"before_s": 15.0}, 5.0), ({"after_s": 40.0}, 40.0)):
        answer = client.post(f"{API}/tests/{new_test(client)}/record", json=plan).json()["job"]
        client.post(f"{API}/jobs/{answer['id']}:cancel").raise_for_status()
        limits = answer["result"]["limits"]
        before_s = plan.get("before_s", 1.0)
        assert (limits["rate_hz"], limits["before_s"], limits["after_s"]) == (50.0, before_s, after_s)
        assert limits["most_pairs_in_memory"] >= 50.0 * (before_s + after_s)
        assert limits["most_memory_mib"] == pytest.approx(
            limits["most_pairs_in_memory"] * 2 * 160 * 144 / 2**20, abs=0.1
        )
        assert wait_for_job(client, answer)["state"] == "cancelled"


def test_software_triggers_without_a_rate_do_not_run_away(tmp_path: Path) -> None:
    with (
        Service(parse_config(TINY.replace("exposure_ms = 10.0", "exposure_ms = 0.1")), tmp_path) as service,
        served(service) as client,
    ):
        wait_for_rig(client)
        test_id = new_test(client)
        job = client.post(f"{API}/tests/{test_id}/record", json={"before_s": 0.2, "after_s": 0.5}).json()["job"]
        time.sleep(0.5)
        client.post(f"{API}/tests/{test_id}/record:trigger").raise_for_status()
        result = wait_for_job(client, job)["result"]
        assert result["limits"]["rate_hz"] == 100.0
        assert 2 <= accounted(result)["kept"] <= 72


def test_a_recording_that_does_not_fit_is_refused_by_name(rig: tuple[httpx.Client, Service]) -> None:
    client, _ = rig
    test_id = new_test(client)
    answer = client.post(f"{API}/tests/{test_id}/record", json={"before_s": 3600.0, "after_s": 86400.0})
    assert (answer.status_code, answer.json()["code"]) == (422, "recording_too_large")
    assert "MiB" in answer.json()["detail"]
    answer = client.post(f"{API}/tests/{test_id}/record", json={"trigger": {"kind": "peak", "channel": "x"}})
    assert answer.json()["code"] == "channel_unknown"
    answer = client.post(f"{API}/tests/{test_id}/record", json={"trigger": {"kind": "level"}})
    assert (answer.status_code, answer.json()["code"]) == (422, "trigger_incomplete")
    assert answer.json()["missing"] == ["channel", "level"]


def test_a_recording_that_is_cancelled_keeps_what_it_listed(rig: tuple[httpx.Client, Service]) -> None:
    client, service = rig
    test_id = new_test(client)
    job = client.post(f"{API}/tests/{test_id}/record", json={"before_s": 0.2, "after_s": 600.0}).json()["job"]
    time.sleep(0.5)
    client.post(f"{API}/jobs/{job['id']}:cancel").raise_for_status()
    assert wait_for_job(client, job)["state"] == "cancelled"
    assert service.tests.steps.numbers(test_id) == []
    wait_until(lambda: client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 201, 60.0)
