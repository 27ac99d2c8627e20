"""Analyses that stop and go on, and analyses that follow a test: each step comes out as in one that did neither."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.server.formats.images import encode_tiff, read_image
from stereorig.server.workflows.analysis import run
from tests.support.copied_tests import write_test_folder
from tests.support.patience import Deadline
from tests.support.running_analyses import API, BODY, Host, begin, contents, folder_of, wait_for_steps
from tests.support.service_rig import a_second, wait_for_job

STEPS = 5


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plate under growing pressure, as a folder that was copied."""
    folder = tmp_path_factory.mktemp("taken") / "t000001-abcdef"
    write_test_folder(folder, STEPS, load_a_step=150.0)
    return folder


@pytest.fixture(scope="module")
def host(taken: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Host]:
    made = Host(tmp_path_factory.mktemp("host") / "data")
    shutil.copytree(taken, made.data / "tests" / taken.name)
    made.start()
    yield made
    made.stop()


@pytest.fixture(scope="module")
def test_url(taken: Path) -> str:
    return f"{API}/tests/{taken.name}"


def succeed(client: httpx.Client, job: dict[str, Any]) -> dict[str, Any]:
    done = wait_for_job(client, job)
    assert done["state"] == "succeeded", done["problem"]
    return done


@pytest.fixture(scope="module")
def plain(host: Host, test_url: str) -> str:
    """Every step in one go."""
    url, job = begin(host.client, test_url)
    succeed(host.client, job)
    return url


def assert_close(actual: Any, expected: Any) -> None:
    """The same in words and to rounding in figures: code that is compiled twice rounds twice."""
    if isinstance(actual, dict):
        for name, value in actual.items():
            assert_close(value, expected[name])
    else:
        assert actual == (pytest.approx(expected, rel=1e-9) if isinstance(actual, float) else expected)


def assert_same_results(host: Host, one: str, two: str) -> None:
    """Bit by bit, in every variable of every step; and in the summaries."""
    for n in range(STEPS):
        a, b = (contents(folder_of(host, url) / f"step_{n:04d}.nc") for url in (one, two))
        assert a.keys() == b.keys()
        assert len(a) >= 20
        for name in a:
            assert a[name].dtype == b[name].dtype
            assert a[name].tobytes() == b[name].tobytes(), (n, name)
    summaries = [host.client.get(url).json()["summary"]["steps"] for url in (one, two)]
    timings = ("wall_s", "compute_s", "write_s", "seconds")
    for a_step, b_step in zip(*summaries, strict=True):
        assert_close({k: v for k, v in a_step.items() if k not in timings}, b_step)
    w = contents(folder_of(host, one) / f"step_{STEPS - 1:04d}.nc")["w_mm"]
    assert np.nanmax(np.abs(w)) > 0.05  # a plate that bends


@pytest.mark.parametrize(
    ("update", "given"),
    [("auto", [[], [0], [0, 1], [0, 2], [0, 3]]), ("always", [[], [0], [0, 1], [0, 1, 2], [0, 1, 2, 3]])],
)
def test_a_step_is_given_the_references_and_the_step_before_it_not_all_before_it(
    host: Host, test_url: str, monkeypatch: pytest.MonkeyPatch, update: str, given: list[list[int]]
) -> None:
    seen: dict[int, list[int]] = {}
    task_of = run.task_of

    def noted(tests: Any, document: Any, n: int, done: Any, *more: Any, **named: Any) -> Any:
        seen[n] = list(done)
        task = task_of(tests, document, n, done, *more, **named)
        assert list(task.earlier) == [k for k in done if k != 0]
        return task

    monkeypatch.setattr(run, "task_of", noted)
    succeed(host.client, begin(host.client, test_url, reference_update=update)[1])
    assert [seen[n] for n in range(STEPS)] == given


# going on -------------------------------------------------------------------------------------------------------


@pytest.mark.fault(43)
@pytest.mark.parametrize("update", ["auto", "always"])
def test_a_cancelled_analysis_goes_on_as_if_nothing_had_been(
    host: Host, test_url: str, plain: str, update: str
) -> None:
    client = host.client
    if update != "auto":
        plain, job = begin(client, test_url, reference_update=update)
        succeed(client, job)
    url, job = begin(client, test_url, reference_update=update)
    wait_for_steps(client, url, 2)
    limit = a_second(client)
    # as a worker leaves them that is ended while it writes
    half = [folder_of(host, url) / name for name in (".step_0004.nc.0a1b2c3d.part", "step_0004.nc.sha256")]
    for path in half:
        path.write_bytes(b"")
    asked = time.monotonic()
    assert client.post(f"{API}/jobs/{job['id']}:cancel").status_code == 202
    ended = wait_for_job(client, job)
    assert time.monotonic() - asked < limit
    assert ended["state"] == "cancelled"
    assert not any(path.exists() for path in half)
    kept = client.get(url).json()["steps_finished"]
    assert 2 <= len(kept) < STEPS
    before = {n: (folder_of(host, url) / f"step_{n:04d}.nc").stat().st_ino for n in kept}
    key = {"Idempotency-Key": f"rest of {url}"}
    first, again = (client.post(f"{url}:continue", headers=key) for _ in range(2))
    assert first.status_code == again.status_code == 202, first.text
    assert first.json()["job"]["id"] == again.json()["job"]["id"] != job["id"]
    done = succeed(client, first.json()["job"])
    assert done["result"]["steps_finished"] == list(range(STEPS))
    assert {n: (folder_of(host, url) / f"step_{n:04d}.nc").stat().st_ino for n in kept} == before
    assert client.get(url).json()["job_id"] == done["id"]
    assert_same_results(host, plain, url)


def test_a_worker_that_was_killed_is_told_and_its_analysis_goes_on(host: Host, test_url: str, plain: str) -> None:
    client, worker = host.client, host.service.worker
    url, job = begin(client, test_url)
    wait_for_steps(client, url, 1)
    starts = worker.starts
    os.kill(worker.pid, signal.SIGSTOP)
    time.sleep(0.3)  # it may have been between two steps; by now it has been given the next, and does not answer
    os.kill(worker.pid, signal.SIGSEGV)
    os.kill(worker.pid, signal.SIGCONT)
    done = wait_for_job(client, job)
    assert (done["state"], done["problem"]["code"]) == ("failed", "worker_died")
    assert "SIGSEGV" in done["problem"]["detail"]
    assert done["problem"]["context"]["signal"] == 11
    assert done["problem"]["context"]["memory_mib"] > 20.0
    assert worker.starts == starts + 1
    succeed(client, client.post(f"{url}:continue").json()["job"])
    assert_same_results(host, plain, url)


def test_a_damaged_result_is_measured_again(host: Host, test_url: str, plain: str) -> None:
    client = host.client
    url, job = begin(client, test_url, steps=[1, 2, 3, 4])
    wait_for_steps(client, url, 3)
    client.post(f"{API}/jobs/{job['id']}:cancel")
    wait_for_job(client, job)
    path = folder_of(host, url) / "step_0001.nc"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    succeed(client, client.post(f"{url}:continue").json()["job"])
    assert_same_results(host, plain, url)


@pytest.mark.fault(51)
def test_what_cannot_go_on_says_why(host: Host, test_url: str, plain: str) -> None:
    client = host.client

    def refused(answer: httpx.Response, status: int, code: str) -> None:
        assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text

    refused(client.post(f"{plain}:continue"), 409, "analysis_finished")
    refused(client.post(f"{plain}:finish"), 409, "not_following")
    refused(client.post(f"{test_url}/analyses/a999999-abcdef:continue"), 404, "not_found")
    refused(client.post(f"{test_url}/analyses/a999999-abcdef:finish"), 404, "not_found")
    refused(client.post(f"{plain}:continue", json={"faster": True}), 422, "invalid_request")
    refused(client.post(f"{test_url}/analyses", json={**BODY, "follow": True, "steps": [1]}), 422, "values_disagree")
    url, job = begin(client, test_url)
    refused(client.post(f"{url}:continue"), 409, "analysis_running")
    refused(client.post(f"{url}:finish"), 409, "not_following")
    client.post(f"{API}/jobs/{job['id']}:cancel")
    wait_for_job(client, job)
    file = folder_of(host, url) / "analysis.json"
    text = file.read_text()
    version = client.get(url).json()["software"]
    file.write_text(text.replace(f'"{version}"', '"0.0.1"'))
    host.service.folder.manifests.take_over(file.parent.parent.parent, [file])
    refused(client.post(f"{url}:continue"), 409, "software_changed")
    accepted = client.post(f"{url}:continue", json={"other_version": True})
    assert accepted.status_code == 202
    client.post(f"{API}/jobs/{accepted.json()['job']['id']}:cancel")
    wait_for_job(client, accepted.json()["job"])
    file.write_text(text.replace('"calibration_sha256": "', '"calibration_sha256": "0'))
    host.service.folder.manifests.take_over(file.parent.parent.parent, [file])
    refused(client.post(f"{url}:continue"), 409, "analysis_stale")


# following ------------------------------------------------------------------------------------------------------


def send(client: httpx.Client, url: str, taken: Path, n: int) -> None:
    images = {cam: (cam, (taken / "steps" / f"{n:04d}" / f"{cam}.tif").read_bytes()) for cam in ("cam1", "cam2")}
    answer = client.post(f"{url}/steps:import", files=images)
    assert (answer.status_code, answer.json()["n"]) == (201, n), answer.text


@pytest.fixture
def growing(host: Host, taken: Path) -> str:
    """A test with its reference alone, the calibration beside it."""
    name = f"t{len(list((host.data / 'tests').iterdir())) + 1:06d}-abcdef"
    folder = host.data / "tests" / name
    shutil.copytree(taken, folder)
    for n in range(1, STEPS):
        shutil.rmtree(folder / "steps" / f"{n:04d}")
    document = (folder / "test.json").read_text().replace(taken.name, name)
    (folder / "test.json").write_text(document)
    return f"{API}/tests/{name}"


def state_of(client: httpx.Client, job: dict[str, Any]) -> tuple[str, str]:
    document = client.get(f"{API}/jobs/{job['id']}").json()
    return document["state"], document["progress"]["phase"]


def wait_until_it_waits(client: httpx.Client, job: dict[str, Any]) -> None:
    deadline = Deadline(240.0)
    while state_of(client, job) != ("running", "waiting for the next step") and deadline.left:
        time.sleep(0.01)
    assert state_of(client, job) == ("running", "waiting for the next step")


def test_an_analysis_follows_its_test_and_leaves_the_lane_to_others(
    host: Host, taken: Path, test_url: str, plain: str, growing: str
) -> None:
    client = host.client
    url, job = begin(client, growing, follow=True)
    wait_for_steps(client, url, 1)
    send(client, growing, taken, 1)
    wait_for_steps(client, url, 2)
    wait_until_it_waits(client, job)
    _, other = begin(client, test_url, steps=[1])
    succeed(client, other)  # while the first one waits
    send(client, growing, taken, 2)
    send(client, growing, taken, 3)
    wait_for_steps(client, url, 4)
    shown = client.get(url).json()
    assert (shown["follow"], shown["steps"], shown["stale"]) == (True, [0, 1, 2, 3], False)
    wait_until_it_waits(client, job)
    send(client, growing, taken, 4)
    assert client.post(f"{url}:finish").status_code == 202
    done = succeed(client, job)
    assert done["result"]["steps_finished"] == list(range(STEPS))
    assert_same_results(host, plain, url)
    assert client.post(f"{url}:finish").json()["code"] == "not_following"


def test_a_step_that_fails_while_an_analysis_follows_is_named_and_the_rest_is_measured(
    host: Host, taken: Path, plain: str, growing: str
) -> None:
    client, hub = host.client, host.service.hub
    before = hub.last_number
    url, job = begin(client, growing, follow=True)
    wait_until_it_waits(client, job)
    blank = np.full(read_image(taken / "steps" / "0001" / "cam1.tif").shape, 90, dtype=np.uint8)
    images = {}
    for k, cam in enumerate(("cam1", "cam2")):
        blank[0, 0] = 91 + k  # outside the region; without it the import itself is refused
        images[cam] = (cam, encode_tiff(blank))
    assert client.post(f"{growing}/steps:import", files=images).status_code == 201
    deadline = Deadline(240.0)
    while not client.get(url).json()["steps_failed"] and deadline.left:
        assert state_of(client, job)[0] == "running"
        time.sleep(0.01)
    wait_until_it_waits(client, job)  # for more, as if nothing had been
    assert client.get(url).json()["steps_finished"] == [0]
    send(client, growing, taken, 2)
    wait_for_steps(client, url, 2)
    send(client, growing, taken, 3)
    wait_for_steps(client, url, 3)
    assert client.post(f"{url}:finish").status_code == 202
    done = succeed(client, job)
    assert done["result"]["steps_finished"] == [0, 2, 3]
    shown = client.get(url).json()
    assert (shown["state"], shown["summary"]["state"]) == ("succeeded", "succeeded")
    for told in (shown["steps_failed"], shown["summary"]["steps_failed"], done["result"]["steps_failed"]):
        assert list(told) == ["1"]
        assert told["1"]["code"] == "not_seeded"
        assert told["1"]["remedy"]
    (event,) = (e for e in hub.after(before) if e.name == "step_failed")
    assert (event.data["n"], event.data["job_id"]) == (1, job["id"])
    assert event.data["problem"]["code"] == "not_seeded"
    assert not (folder_of(host, url) / "step_0001.nc").exists()
    for n in (2, 3):
        ours, theirs = (contents(folder_of(host, one) / f"step_{n:04d}.nc") for one in (url, plain))
        # from other start values, each fit ends within a thousandth of a pixel of 0.07 mm
        np.testing.assert_allclose(ours["w_mm"], theirs["w_mm"], atol=1e-3)


@pytest.mark.fault(43)
def test_a_follower_that_waits_is_cancelled_at_once_and_goes_on_when_asked(
    host: Host, taken: Path, plain: str, growing: str
) -> None:
    client = host.client
    url, job = begin(client, growing, follow=True)
    wait_until_it_waits(client, job)
    limit = a_second(client)
    asked = time.monotonic()
    assert client.post(f"{API}/jobs/{job['id']}:cancel").json()["state"] == "cancelled"
    assert time.monotonic() - asked < limit
    send(client, growing, taken, 1)
    assert client.get(url).json()["steps_finished"] == [0]
    rest = client.post(f"{url}:continue").json()["job"]
    wait_for_steps(client, url, 2)
    for n in range(2, STEPS):
        send(client, growing, taken, n)
    client.post(f"{url}:finish")
    succeed(client, rest)
    assert_same_results(host, plain, url)


@pytest.mark.fault(2)
def test_a_follower_outlives_a_restart_as_interrupted_and_goes_on(
    host: Host, taken: Path, plain: str, growing: str
) -> None:
    url, job = begin(host.client, growing, follow=True)
    wait_until_it_waits(host.client, job)
    client = host.start()
    assert client.get(f"{API}/jobs/{job['id']}").json()["state"] == "interrupted"
    assert client.get(url).json()["state"] == "interrupted"
    for n in range(1, STEPS):
        send(client, growing, taken, n)
    rest = client.post(f"{url}:continue").json()["job"]
    wait_for_steps(client, url, STEPS)
    client.post(f"{url}:finish")
    succeed(client, rest)
    assert_same_results(host, plain, url)
