"""A stop is on the wire within 50 ms at p99 under full load; what a dead service leaves moving is stopped."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from sim.controllers.registry import make_controller
from sim.controllers.server import ControllerServer
from tests.bench.reliability.stage_stop import StopTimes
from tests.support.requirements import ROOT
from tests.support.stage_service import API, rig_text, wait_until

LIMIT_MS = 50.0
STOPS = 200
ROUNDS = 3


@pytest.mark.deep
@pytest.mark.fault(26)
def test_a_stop_under_full_load_is_on_the_wire_within_50_ms_at_p99(
    tmp_path: Path, record_property: pytest.RecordProperty
) -> None:
    # Under the load that the issue means, which is the service's own. Other tests may take the processors at the same
    # time, and then a user without the right to raise priorities may need another round.
    rows = []
    for n in range(ROUNDS):
        figures = tmp_path / f"{n}.json"
        done = subprocess.run(
            [sys.executable, "-m", "tests.bench.reliability.stage_stop", "--stops", str(STOPS), "--json", str(figures)],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
            start_new_session=True,
        )
        assert done.returncode == 0, done.stderr
        times = StopTimes(**json.loads(figures.read_text()))
        rows.append(f"{times.row()} {times.analysed_steps} load steps analysed meanwhile")
        print(rows[-1])
        # it was a load: the worker correlated, and the processors had little rest
        assert times.analysed_steps > 0
        assert times.busy_share > 0.7
        assert len(times.latencies_ms) == STOPS
        if times.percentile(0.99) <= LIMIT_MS:
            break
    record_property("stop latency", "; ".join(rows))
    assert times.percentile(0.99) <= LIMIT_MS, rows
    assert times.percentile(0.5) <= LIMIT_MS / 2, rows


@contextlib.contextmanager
def serving(folder: Path, url: str, driver: str) -> Iterator[tuple[subprocess.Popen[str], httpx.Client]]:
    (folder / "rig.toml").write_text(rig_text(driver=f'"{driver}"', url=f'"{url}"', velocity_mm_s="0.05"))
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "server.cli",
            "serve",
            "--config",
            str(folder / "rig.toml"),
            "--port",
            "0",
            "--data",
            str(folder / "data"),
            "--record",
            str(folder / "wire.txt"),
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        base = next((word for word in line.split() if word.startswith("http://")), None)
        assert base is not None, process.communicate()[1]
        with httpx.Client(base_url=base, timeout=60.0, trust_env=False) as client:
            wait_until(lambda: client.get(f"{API}/rig").json()["connected"], 60.0)
            yield process, client
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def finished(client: httpx.Client, answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 202, answer.text
    url = f"{API}/jobs/{answer.json()['job']['id']}"
    end = time.monotonic() + 60.0
    while (job := client.get(url).json())["state"] not in ("succeeded", "failed", "cancelled", "interrupted"):
        assert time.monotonic() < end
        time.sleep(0.01)
    found: dict[str, Any] = job
    return found


def start_long_move(client: httpx.Client, controller: Any) -> str:
    answer = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 5.0}})
    assert answer.status_code == 202, answer.text
    wait_until(lambda: controller.axis(1).moving)
    return str(answer.json()["job"]["id"])


@pytest.mark.fault(27)
@pytest.mark.parametrize("driver", ["esp301", "smc100"])
def test_a_service_that_ends_or_dies_in_mid_move_leaves_nothing_moving(tmp_path: Path, driver: str) -> None:
    controller = make_controller(driver, (1, 2), time_scale=1.0)
    with ControllerServer(controller) as server:
        with serving(tmp_path, server.url, driver) as (process, client):
            assert finished(client, client.post(f"{API}/stage/home"))["state"] == "succeeded"
            # asked to end: it stops the stage before anything else
            job = start_long_move(client, controller)
            process.terminate()
            wait_until(lambda: not controller.axis(1).moving, 3.0)
            assert process.wait(timeout=20.0) == 0
            assert controller.true_position_mm(1) < 4.5
        with serving(tmp_path, server.url, driver) as (process, client):
            assert client.get(f"{API}/jobs/{job}").json()["state"] == "interrupted"
            # what became of the reference in between only the SMC100 can say
            states = [axis["state"] for axis in client.get(f"{API}/stage").json()["axes"]]
            assert states == (["not_homed"] * 2 if driver == "esp301" else ["ready"] * 2)
            assert finished(client, client.post(f"{API}/stage/home"))["state"] == "succeeded"
            job = start_long_move(client, controller)
            process.kill()
            process.wait()
            assert controller.axis(1).moving  # no client could stop it
        with serving(tmp_path, server.url, driver) as (_, client):
            # opening did
            assert not controller.axis(1).moving
            assert controller.true_position_mm(1) < 4.9, "the move ended by itself before the service was back"
            assert client.get(f"{API}/jobs/{job}").json()["state"] == "interrupted"
            axis = client.get(f"{API}/stage").json()["axes"][0]
            assert axis["homed"] is (driver == "smc100")
            if driver == "smc100":
                assert axis["position_mm"] == pytest.approx(controller.true_position_mm(1), abs=2e-4)
            answer = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.0}})
            if driver == "esp301":
                assert answer.status_code == 409
                assert answer.json()["code"] == "not_homed"
            else:
                assert finished(client, answer)["state"] == "succeeded"
            messages = client.get(f"{API}/stage/messages").json()["messages"]
            assert [m["axis"] for m in messages if m["code"] == "opened_moving"] == [1]
    # the transcript spans all three lives, and shows the stop that the last one began with
    text = (tmp_path / "wire.txt").read_text("ascii")
    assert text.count("# socket://") == 3
    assert "! b'1ST" in text.rpartition("# socket://")[2]
