"""The processes of a service: whichever of them dies or hangs in a move, the axes are stopped by another one."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen
from typing import Any

import httpx
import psutil
import pytest

from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.bench.reliability.processes import finished, process_of, serving, start_long_move, stop_after
from tests.support.fake_xps import FakeXPS
from tests.support.stage_service import wait_until

API = "/api/v1"
# the measured times are some milliseconds (docs/explanation/reliability.md); these tests pass beside busy processes
SOON_S = 2.0
DEATHS = [
    *(("web", number) for number in (signal.SIGHUP, signal.SIGQUIT, signal.SIGSEGV, signal.SIGKILL, signal.SIGABRT)),
    ("rig", signal.SIGKILL),
    ("rig", signal.SIGSEGV),
    ("front", signal.SIGKILL),
    ("front", signal.SIGHUP),
    ("front", signal.SIGQUIT),
]


@contextlib.contextmanager
def bench(folder: Path, driver: str) -> Iterator[tuple[Popen[str], httpx.Client, Any]]:
    controller = make_controller(driver, (1, 2), time_scale=1.0)
    with ControllerServer(controller) as server, serving(folder, server.url, driver) as (process, client):
        assert finished(client, client.post(f"{API}/stage:home"))["state"] == "succeeded"
        yield process, client, controller


@pytest.mark.fault(27)
@pytest.mark.fault(54)
@pytest.mark.parametrize("driver", ["esp301", "smc100"])
def test_a_death_in_a_move_stops_the_axes_and_the_service_serves_again(tmp_path: Path, driver: str) -> None:
    with bench(tmp_path, driver) as (process, client, controller):
        deaths = [death for death in DEATHS if death[0] != "front"]
        # what kills a process makes no difference to the controllers
        for victim, number in deaths if driver == "esp301" else deaths[3::2]:
            wait_until(lambda: ready(client), 60.0)
            if not all(axis["homed"] for axis in client.get(f"{API}/stage").json()["axes"]):
                assert finished(client, client.post(f"{API}/stage:home"))["state"] == "succeeded"
            back = finished(client, client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.0}}))
            assert back["state"] == "succeeded"
            start_long_move(client, controller, 0.3)
            pid = process_of(process, victim).pid
            stop_after(controller, lambda pid=pid, number=number: os.kill(pid, number), SOON_S)
            wait_until(lambda: not controller.axis(1).moving, SOON_S)
            assert process.poll() is None, "the first process goes on"
        wait_until(lambda: ready(client), 60.0)


@pytest.mark.fault(27)
@pytest.mark.fault(54)
@pytest.mark.parametrize(("victim", "number"), [death for death in DEATHS if death[0] == "front"])
def test_the_end_of_the_first_process_stops_the_axes_and_ends_the_others(
    tmp_path: Path, victim: str, number: signal.Signals
) -> None:
    with bench(tmp_path, "esp301") as (process, client, controller):
        start_long_move(client, controller)
        others = [process_of(process, name) for name in ("web", "rig")]
        stop_after(controller, lambda: process.send_signal(number), SOON_S)
        wait_until(lambda: not any(one.is_running() for one in others), 30.0)
        assert process.wait(30.0) == (-number if number == signal.SIGKILL else 0)


def ready(client: httpx.Client) -> bool:
    with contextlib.suppress(httpx.HTTPError, KeyError, json.JSONDecodeError):
        return bool(client.get(f"{API}/rig", timeout=5.0).json()["connected"])
    return False


@pytest.mark.fault(26)
@pytest.mark.fault(53)
@pytest.mark.parametrize("frozen", ["web", "rig"])
def test_a_stop_comes_through_beside_a_process_that_does_nothing_any_more(tmp_path: Path, frozen: str) -> None:
    with bench(tmp_path, "esp301") as (process, client, controller):
        start_long_move(client, controller)
        held = process_of(process, frozen)
        held.suspend()
        try:
            answers: list[httpx.Response] = []
            stop_after(controller, lambda: answers.append(client.post(f"{API}/stage:stop")), SOON_S)
            assert answers[0].status_code == 200
            assert answers[0].json()["stopped"] is True
            wait_until(lambda: not controller.axis(1).moving, SOON_S)
        finally:
            held.resume()


@pytest.mark.fault(27)
@pytest.mark.fault(61)
@pytest.mark.parametrize("victim", ["web", "rig"])
def test_a_death_stops_the_axes_of_every_controller(tmp_path: Path, victim: str) -> None:
    one, two = (make_controller("conex-cc", (1,), time_scale=1.0) for _ in range(2))
    with (
        ControllerServer(one) as first,
        ControllerServer(two) as second,
        serving(tmp_path, first.url, "conex-cc", second=second.url) as (process, client),
    ):
        wait_until(lambda: len(client.get(f"{API}/stage").json()["axes"]) == 2, 30.0)
        assert finished(client, client.post(f"{API}/stage:home"))["state"] == "succeeded"
        start_long_move(client, one)
        known = len(two.commands("ST"))
        stop_after(one, lambda: process_of(process, victim).kill(), SOON_S)
        wait_until(lambda: len(two.commands("ST")) > known, SOON_S)
        wait_until(lambda: not one.axis(1).moving, SOON_S)


@pytest.mark.fault(54)
def test_the_groups_of_an_xps_are_killed_when_the_rig_process_dies_or_does_not_answer_a_stop(tmp_path: Path) -> None:
    fake = FakeXPS(time_scale=1.0, start_mm=0.0)
    with contextlib.closing(fake), serving(tmp_path, fake.url, "xps") as (process, client):
        wait_until(lambda: len(client.get(f"{API}/stage").json()["axes"]) == 2, 30.0)
        for victim in ("frozen", "dead"):
            wait_until(lambda: ready(client), 60.0)
            wait_until(lambda: client.post(f"{API}/stage:enable").is_success, 60.0)  # the stopped move's job has ended
            assert finished(client, client.post(f"{API}/stage:home"))["state"] == "succeeded"
            start_long_move(client, fake)
            rig, known = process_of(process, "rig"), len(fake.words("GroupKill"))
            if victim == "dead":
                rig.kill()
            else:
                rig.suspend()
                assert client.post(f"{API}/stage:stop").json()["stopped"] is True
            wait_until(lambda known=known: len(fake.words("GroupKill")) >= known + 2, SOON_S)
            assert not fake.axis(1).moving
            if victim == "frozen":
                rig.resume()


@pytest.mark.fault(26)
def test_a_job_that_learns_of_a_stop_late_does_not_continue_its_move(tmp_path: Path) -> None:
    with bench(tmp_path, "esp301") as (process, client, controller):
        client.patch(f"{API}/stage/axes/1", json={"velocity_mm_s": 5.0}).raise_for_status()
        there = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 5.0}})
        assert finished(client, there)["state"] == "succeeded"
        web = process_of(process, "web")
        answer = client.post(f"{API}/stage:home")
        wait_until(lambda: controller.axis(1).moving)
        web.suspend()  # the job asks for axis 2 only when this process goes on
        try:
            wait_until(lambda: not controller.axis(1).moving, 30.0)
            known = len(controller.received)
            assert client.post(f"{API}/stage:stop").json()["cancelled_job"] is None, "not known yet"
        finally:
            web.resume()
        assert finished(client, answer)["state"] == "cancelled"
        texts = [entry.text for entry in controller.received[known:]]  # a busy host may have held this process late
        assert not [text for text in texts[texts.index("ST") :] if text.startswith("2OR")]
        assert finished(client, client.post(f"{API}/stage:home"))["state"] == "succeeded"


def test_only_the_web_process_loads_a_web_framework_and_codecs_and_none_loads_the_compiler(tmp_path: Path) -> None:
    heavy = ("matplotlib", "PIL/", "tifffile", "netCDF4", "pydantic_core")
    with bench(tmp_path, "esp301") as (process, _, _):
        for name, forbidden in (("front", (*heavy, "numpy", "llvmlite")), ("rig", heavy[:4])):
            maps = Path(f"/proc/{process_of(process, name).pid}/maps").read_text()
            assert not [word for word in forbidden if f"/{word}" in maps], name
    compiler = {"numba", "scipy"}
    codecs = {"fastapi", "starlette", "uvicorn", "matplotlib", "cv2", "PIL", "tifffile"}
    for modules, foreign in (("rig.process.host http.supervisor", codecs | compiler), ("cli.web api.app", compiler)):
        names = ", ".join(f"stereorig.server.{name}" for name in modules.split())
        code = f"import sys, {names}; print(*sys.modules)"
        loaded = psutil.subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert not foreign & set(loaded.stdout.split()), modules
