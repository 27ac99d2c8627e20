"""The service killed at work: what was acknowledged is there after the next start, and nothing is left running."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from tests.support.copied_tests import CONFIG, write_test_folder
from tests.support.patience import Deadline
from tests.support.requirements import ROOT
from tests.support.service_rig import TINY


def start(tmp_path: Path) -> tuple[subprocess.Popen[str], httpx.Client]:
    command = [
        sys.executable,
        "-m",
        "stereorig.server.cli",
        "serve",
        "--config",
        str(tmp_path / "rig.toml"),
        "--port",
        "0",
    ]
    process = subprocess.Popen(
        [*command, "--data", str(tmp_path / "data")],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    url = next(word for word in line.split() if word.startswith("http://"))
    return process, httpx.Client(base_url=f"{url}/api/v1", timeout=60.0, trust_env=False)


def children_of(pid: int) -> list[int]:
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(path.parent.name))
    return found


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.fault(1)
@pytest.mark.fault(2)
def test_killed_while_it_analyses_and_captures(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(CONFIG)
    write_test_folder(tmp_path / "data" / "tests" / "t000007-abcdef", 40)
    process, client = start(tmp_path)
    try:
        test = "/tests/t000007-abcdef"
        assert len(client.get(test).json()["steps"]) == 40
        body = {"region": {"rectangle": [25, 25, 130, 115]}, "subset_px": 21, "spacing_px": 2}
        accepted = client.post(f"{test}/analyses", json=body).json()
        url = f"{test}/analyses/{accepted['analysis_id']}"
        deadline = Deadline(240.0)
        while len(client.get(url).json()["steps_finished"]) < 2 and deadline.left:
            time.sleep(0.02)
        announced = client.get(url).json()["steps_finished"]
        new = client.post("/tests", json={"name": "new"}).json()["id"]
        acknowledged = [client.post(f"/tests/{new}/steps", json={}).json() for _ in range(3)]
        children = children_of(process.pid)
        assert children
    finally:
        process.kill()
        process.communicate()
        client.close()
    deadline = Deadline(10.0)
    while any(is_running(pid) for pid in children) and deadline.left:
        time.sleep(0.05)
    assert not any(is_running(pid) for pid in children)

    process, client = start(tmp_path)
    try:
        job = client.get(f"/jobs/{accepted['job']['id']}").json()
        assert job["state"] == "interrupted"
        shown = client.get(url).json()
        assert shown["state"] == "interrupted"
        assert set(announced) <= set(shown["steps_finished"])
        for n in announced:
            assert client.get(f"{url}/steps/{n}/fields/z_mm").status_code == 200
        for step in acknowledged:
            assert client.get(f"/tests/{new}/steps/{step['n']}").json() == step
            for cam in ("cam1", "cam2"):
                content = client.get(f"/tests/{new}/steps/{step['n']}/{cam}").content
                assert hashlib.sha256(content).hexdigest() == step["sha256"][cam]
        assert [s["n"] for s in shown["summary"]["steps"]] == shown["steps_finished"]
        # a new analysis can start at once, and comes to its end
        fresh = client.post(f"{test}/analyses", json={**body, "spacing_px": 20, "steps": [0, 1]})
        assert fresh.status_code == 202, fresh.text
        deadline = Deadline(240.0)
        while (new_job := client.get(f"/jobs/{fresh.json()['job']['id']}").json())["state"] in ("queued", "running"):
            assert deadline.left, new_job
            time.sleep(0.02)
        assert new_job["state"] == "succeeded", new_job["problem"]
        rest = client.post(f"{url}:continue", headers={"Idempotency-Key": "rest"})
        assert rest.status_code == 202, rest.text
        assert (
            client.post(f"{url}:continue", headers={"Idempotency-Key": "rest"}).json()["job"]["id"]
            == (rest.json()["job"]["id"])
        )
        kept = shown["steps_finished"]
        deadline = Deadline(240.0)
        while len(client.get(url).json()["steps_finished"]) < len(kept) + 1 and deadline.left:
            time.sleep(0.02)
        finished = client.get(url).json()["steps_finished"]
        assert len(finished) > len(kept)
        assert finished == list(range(len(finished)))
        assert client.post(f"/jobs/{rest.json()['job']['id']}:cancel").status_code == 202
        again = client.post(f"{test}/analyses", json={**body, "steps": [1]})
        assert again.status_code == 202
        assert client.post(f"/jobs/{again.json()['job']['id']}:cancel").status_code == 202
        deadline = Deadline(60.0)
        for ending in (rest, again):  # what still runs may be writing
            while client.get(f"/jobs/{ending.json()['job']['id']}").json()["finished_utc"] is None:
                assert deadline.left
                time.sleep(0.02)
        assert not list((tmp_path / "data").rglob(".*.part"))
    finally:
        process.terminate()
        _, errors = process.communicate(timeout=240)
        client.close()
    assert process.returncode == 0
    assert errors == ""


@pytest.mark.fault(6)
def test_a_second_service_on_the_same_folder_ends_and_names_the_first(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(TINY)
    process, client = start(tmp_path)
    try:
        second = subprocess.run(
            [
                sys.executable,
                "-m",
                "stereorig.server.cli",
                "serve",
                "--config",
                str(tmp_path / "rig.toml"),
                "--port",
                "0",
                "--data",
                str(tmp_path / "data"),
            ],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert second.returncode == 1, second.stderr
        assert f"process {process.pid} on " in second.stderr
        assert "data_folder_locked" in second.stderr
        assert client.get("/healthz").json()["status"] == "ok"  # the first goes on
        test_id = client.post("/tests", json={"name": "still there"}).json()["id"]
        assert client.get(f"/tests/{test_id}").status_code == 200
    finally:
        process.kill()
        process.communicate()
        client.close()


@pytest.mark.fault(1)
@pytest.mark.fault(2)
def test_killed_while_a_recording_is_saved_no_acknowledged_step_is_lost(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(CONFIG)
    process, client = start(tmp_path)
    try:
        deadline = Deadline(60.0)
        while not client.get("/rig").json()["connected"] and deadline.left:
            time.sleep(0.05)
        test = f"/tests/{client.post('/tests', json={'name': 'kill'}).json()['id']}"
        for after_s in (2.5, 10.0, 40.0):  # longer if a busy machine looked only after the last pair was saved
            job = client.post(f"{test}/record", json={"before_s": 0.5, "after_s": after_s}).json()["job"]["id"]
            time.sleep(0.5)
            client.post(f"{test}/record:trigger").raise_for_status()
            deadline = Deadline(60.0)
            listed: list[dict[str, object]] = []
            while len(listed) < 20 and deadline.left:
                shown = client.get(f"/jobs/{job}").json()
                listed = shown["result"]["steps"]
            if shown["state"] == "running":
                break
        assert shown["state"] == "running", "it was still being saved"
        for pid in [process.pid, *children_of(process.pid)]:  # the rig's process and the service's too
            os.kill(pid, signal.SIGKILL)
    finally:
        process.kill()
        process.communicate()
        client.close()
    process, client = start(tmp_path)
    try:
        kept = {step["n"]: step for step in client.get(test).json()["steps"]}
        assert len(listed) >= 20
        assert 0 in kept
        for one in listed:
            step = client.get(f"{test}/steps/{one['n']}").json()
            assert (step["sha256"], step["burst"]["job_id"]) == (one["sha256"], job)
            assert one["n"] in kept
        for n in kept:  # those that nobody acknowledged are whole, or not there
            for cam in ("cam1", "cam2"):
                content = client.get(f"{test}/steps/{n}/{cam}").content
                assert hashlib.sha256(content).hexdigest() == client.get(f"{test}/steps/{n}").json()["sha256"][cam]
    finally:
        process.terminate()
        process.communicate()
        client.close()
