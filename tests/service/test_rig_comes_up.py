"""A rig whose devices come, go and come back in any order: each is found by itself, and none disturbs the others."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from stereorig.core.errors import CameraError
from stereorig.server.config.rig_file import RigConfig, parse_config
from stereorig.server.rig import build
from stereorig.server.workflows.service import Service
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.support.problems import assert_problem
from tests.support.service_rig import new_test, served, wait_for_job
from tests.support.stage_service import rig_text, wait_until
from tests.support.tiny_rig import TINY

API = "/api/v1"
pytestmark = pytest.mark.fault(61)
# what a real one may take, on a quiet machine; the measured times are in the test's output
BACK_S = 3.0


class Bench:
    """Cameras and controllers with switches, and the service on them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, drivers: dict[str, tuple[str, tuple[int, ...]]]) -> None:
        self.absent: set[str] = set()
        self.blocks: dict[str, threading.Event] = {}
        self.errors: dict[str, Exception] = {}
        self.controllers = {
            name: make_controller(driver, axes, time_scale=50.0, start_mm=3.0)
            for name, (driver, axes) in drivers.items()
        }
        self.ports: dict[str, int] = {}
        for name in drivers:
            with socket.create_server(("127.0.0.1", 0)) as free:
                self.ports[name] = free.getsockname()[1]
        self.servers: dict[str, ControllerServer] = {}
        self.service: Any = None
        self.faults: dict[str, Any] = {}
        make = build._grabber

        def grabber(config: RigConfig, cam: Any, *more: Any) -> Any:
            made: Any = make(config, cam, *more)
            open_it = made.open

            def opened() -> None:
                if cam in self.blocks:
                    self.blocks[cam].wait(60.0)
                if cam in self.errors:
                    raise self.errors[cam]
                if cam in self.absent:
                    raise CameraError(f"{cam} is not there.", code="camera_lost")
                open_it()

            made.open = opened
            return made

        monkeypatch.setattr(build, "_grabber", grabber)

    def url(self, name: str = "stage") -> str:
        return f"socket://127.0.0.1:{self.ports[name]}"

    def off(self, name: str) -> None:
        if name in self.ports:
            if (server := self.servers.pop(name, None)) is not None:
                server.close()
            return
        self.absent.add(name)
        if self.service is not None:
            self.faults[name] = self.service.rig.pair.units[name].grabber.faults
            self.faults[name].gone = True

    def on(self, name: str) -> None:
        if name in self.ports:
            self.servers[name] = ControllerServer(self.controllers[name], port=self.ports[name]).start()
            return
        self.absent.discard(name)
        if name in self.faults:
            self.faults[name].gone = False

    @contextmanager
    def serve(self, config: RigConfig, data: Path) -> Iterator[httpx.Client]:
        self.service = Service(config, data).start()
        try:
            with served(self.service) as client:
                yield client
        finally:
            self.service.close()
            for server in self.servers.values():
                server.close()


def states(client: httpx.Client) -> dict[str, str]:
    """State of each camera, and of each controller by the first of its axes."""
    rig = client.get(f"{API}/rig").json()
    found = {cam: rig["cameras"][cam].get("state") for cam in ("cam1", "cam2")}
    return found | {f"stage{one['axes'][0]}": one["state"] for one in rig["stage"]["controllers"]}


def until_connected(client: httpx.Client, name: str) -> float:
    """Wait for a device of an open rig; return how long that took, s."""
    wait_until(lambda: name in states(client), 60.0)
    began = time.monotonic()
    wait_until(lambda: states(client)[name] == "connected", BACK_S)
    print(f"{name}: {time.monotonic() - began:.2f} s")
    return time.monotonic() - began


def grabbers(service: Service) -> list[object]:
    return [unit.grabber for unit in service.rig.pair.units.values()]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch, {"stage": ("esp301", (1, 2))})


@pytest.mark.parametrize("order", list(itertools.permutations(("cam1", "cam2", "stage")))[::2])
def test_devices_that_come_after_the_service_are_connected_in_any_order(
    bench: Bench, tmp_path: Path, order: tuple[str, ...]
) -> None:
    for cam in ("cam1", "cam2"):
        bench.off(cam)
    with bench.serve(parse_config(rig_text(url=f'"{bench.url()}"', home_at_start="true")), tmp_path / "data") as client:
        wait_until(lambda: set(states(client).values()) == {"looked_for"}, 60.0)
        shown = client.get(f"{API}/rig").json()
        assert shown["connected"] is False
        assert shown["fault"]["code"] == "camera_lost"
        assert shown["cameras"]["cam1"]["device"] is None
        assert client.get(f"{API}/healthz").json()["rig"] == "fault"
        known: list[object] = []
        for name in order:
            bench.on(name)
            until_connected(client, "stage1" if name == "stage" else name)
            found = [unit.grabber for unit in bench.service.rig.pair.units.values() if unit.was_found]
            assert all(any(one is other for other in found) for one in known), "none of the others was opened again"
            known = found
        assert client.get(f"{API}/rig").json()["connected"] is True
        # it was not there when the service started: nothing moves unasked
        assert not bench.controllers["stage"].commands("OR")
        step = client.post(f"{API}/tests/{new_test(client)}/steps", json={}).json()
        assert step["dz_mm"] == pytest.approx({"cam1": 0.0, "cam2": 0.0}, abs=1e-3)
        assert {unit.reconnections for unit in bench.service.rig.pair.units.values()} == {0}


def test_steps_are_kept_without_the_stage_whose_return_leaves_the_cameras_alone(bench: Bench, tmp_path: Path) -> None:
    bench.on("stage")
    text = rig_text(url=f'"{bench.url()}"').replace(
        'kind = "simulated"', 'kind = "simulated"\ntrigger = "free"\nframe_rate_hz = 10.0'
    )
    with bench.serve(
        parse_config(text.replace("max_skew_ms = 1.0", "max_skew_ms = 5000.0")), tmp_path / "data"
    ) as client:
        until_connected(client, "stage1")
        test_id, cameras = new_test(client), grabbers(bench.service)
        first = client.post(f"{API}/tests/{test_id}/steps", json={})
        assert first.status_code == 201, first.text
        assert first.json()["dz_mm"]["cam1"] is not None
        bench.off("stage")
        answer = client.post(f"{API}/tests/{test_id}/steps", json={})
        assert answer.status_code == 201, answer.text
        step = answer.json()
        assert step["dz_mm"] == {"cam1": None, "cam2": None}
        assert any("Position unknown" in warning for warning in step["warnings"])
        job = client.post(f"{API}/tests/{test_id}/steps", json={"count": 3, "interval_ms": 0}).json()["job"]
        assert wait_for_job(client, job)["state"] == "succeeded"
        assert states(client)["stage1"] == "lost"
        # positions matter here: the cause is named
        assert_problem(client.post(f"{API}/calibrations", json={}), 503, "stage_lost")
        assert_problem(client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 1.0}}), 503, "stage_lost")
        bench.on("stage")
        until_connected(client, "stage1")
        assert client.post(f"{API}/tests/{test_id}/steps", json={}).json()["dz_mm"]["cam1"] is not None
        assert all(one is other for one, other in zip(grabbers(bench.service), cameras, strict=True))
        for cam in ("cam1", "cam2"):
            frames = client.get(f"{API}/cameras/{cam}/stats").json()["frames"]
            assert frames["dropped"] == 0, "the numbers of its frames have no gap"


def test_a_cameras_return_leaves_the_stage_and_the_other_camera_alone(bench: Bench, tmp_path: Path) -> None:
    bench.on("stage")
    with bench.serve(parse_config(rig_text(url=f'"{bench.url()}"')), tmp_path / "data") as client:
        until_connected(client, "stage1")
        test_id = new_test(client)
        since = client.get(f"{API}/stage").json()["controllers"][0]["since_utc"]
        other = bench.service.rig.pair.units["cam1"].grabber
        bench.off("cam2")
        assert_problem(client.post(f"{API}/tests/{test_id}/steps", json={}), 503, "camera_lost")
        wait_until(lambda: states(client)["cam2"] == "lost")
        assert client.get(f"{API}/rig").json()["cameras"]["cam2"]["fault"]["code"] == "camera_lost"
        bench.on("cam2")
        until_connected(client, "cam2")
        assert client.post(f"{API}/tests/{test_id}/steps", json={}).status_code == 201
        assert bench.service.rig.pair.units["cam1"].grabber is other
        assert client.get(f"{API}/stage").json()["controllers"][0]["since_utc"] == since


@pytest.mark.parametrize("at_start", [True, False])
def test_a_camera_whose_opening_blocks_holds_up_neither_the_other_nor_the_stage(
    bench: Bench, tmp_path: Path, *, at_start: bool
) -> None:
    released = threading.Event()
    if at_start:
        bench.blocks["cam1"] = released
    with bench.serve(parse_config(rig_text(url=f'"{bench.url()}"')), tmp_path / "data") as client:
        if at_start:
            until_connected(client, "cam2")
            bench.on("stage")
        else:
            bench.on("stage")
            until_connected(client, "cam1")
            until_connected(client, "cam2")
            opened = bench.service.rig.pair.units["cam1"].grabber
            bench.blocks["cam1"] = released
            for cam in ("cam1", "cam2"):
                bench.off(cam)
            wait_until(lambda: states(client)["cam2"] == "lost")
            wait_until(lambda: bench.service.rig.pair.units["cam1"].grabber is not opened)
            bench.on("cam2")
            until_connected(client, "cam2")
        until_connected(client, "stage1")
        assert states(client)["cam1"] == ("looked_for" if at_start else "lost")
        shown = client.get(f"{API}/rig").json()
        assert (shown["fault"] or shown["cameras"]["cam1"]["fault"])["code"] == "camera_lost"
        bench.on("cam1")
        released.set()
        until_connected(client, "cam1")
        assert client.post(f"{API}/tests/{new_test(client)}/steps", json={}).status_code == 201


def test_an_unexpected_error_of_a_driver_is_a_problem_that_names_it(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.errors["cam1"] = RuntimeError("node map of 3 bytes")
    bench.on("stage")
    monkeypatch.setattr("stereorig.drivers.stages.makers.esp301.ESP301Stage.reconnect", lambda _: 1 / 0)
    with bench.serve(parse_config(rig_text(url=f'"{bench.url()}"')), tmp_path / "data") as client:
        until_connected(client, "cam2")
        wait_until(lambda: client.get(f"{API}/rig").json()["fault"]["code"] == "driver_failed", BACK_S)
        shown = client.get(f"{API}/rig").json()
        assert "RuntimeError: node map of 3 bytes" in shown["fault"]["detail"]
        assert shown["cameras"]["cam1"]["fault"]["code"] == "driver_failed"
        assert shown["stage"]["fault"]["code"] == "driver_failed"
        assert "ZeroDivisionError" in shown["stage"]["fault"]["detail"]
        monkeypatch.undo()
        bench.errors.clear()
        until_connected(client, "cam1")
        until_connected(client, "stage1")
        assert client.get(f"{API}/rig").json()["fault"] is None


def test_a_stage_that_is_lost_or_returns_is_announced_as_a_camera_is(bench: Bench, tmp_path: Path) -> None:
    with bench.serve(parse_config(rig_text(url=f'"{bench.url()}"')), tmp_path / "data") as client:
        for switch, state in ((bench.on, "connected"), (bench.off, "lost"), (bench.on, "connected")):
            switch("stage")
            wait_until(lambda state=state: states(client)["stage1"] == state, 10.0)  # type: ignore[misc]
        said = [event.data for event in bench.service.hub.after(0) if event.name == "stage"]
        assert [one["state"] for one in said] == ["connected", "lost", "connected"]
        assert all((one["axes"], one["url"]) == ([1, 2], bench.url()) for one in said)
        assert [one.get("problem", {}).get("code") for one in said] == [None, "stage_lost", None]


def test_a_silent_controller_can_still_be_stopped_and_is_found_on_its_open_line(bench: Bench, tmp_path: Path) -> None:
    bench.on("stage")
    controller = bench.controllers["stage"]
    with bench.serve(
        parse_config(rig_text(url=f'"{bench.url()}"', reply_timeout_ms="100")), tmp_path / "data"
    ) as client:
        until_connected(client, "stage1")
        controller.line_faults.silent = True
        wait_until(lambda: states(client)["stage1"] == "lost", 10.0)
        for _ in range(5):
            known = len(controller.commands("ST"))
            assert client.post(f"{API}/stage:stop").status_code == 200
            wait_until(lambda known=known: len(controller.commands("ST")) > known)  # type: ignore[misc]
            time.sleep(0.1)
        controller.line_faults.silent = False
        until_connected(client, "stage1")


def test_a_rig_without_a_stage_captures_and_names_what_it_lacks(tmp_path: Path) -> None:
    head, rest = TINY.split("[stage]\n")
    config = parse_config(head + "[target]\n" + rest.split("[target]\n")[1])
    assert config.simulated == ["cam1", "cam2"]
    service = Service(config, tmp_path / "data").start()
    try:
        with served(service) as client:
            wait_until(lambda: client.get(f"{API}/rig").json()["connected"])
            shown = client.get(f"{API}/stage").json()
            assert (shown["driver"], shown["axes"], shown["controllers"], shown["fault"]) == (None, [], [], None)
            step = client.post(f"{API}/tests/{new_test(client)}/steps", json={}).json()
            assert step["dz_mm"] is None
            assert step["simulated"] == ["cam1", "cam2"]
            assert not [warning for warning in step["warnings"] if "osition" in warning]
            assert client.post(f"{API}/stage:stop").status_code == 200
            for path, body in (
                ("/stage/moves", {"positions_mm": {"1": 1.0}}),
                ("/stage/moves", {"dz_mm": {"cam1": 1.0}}),
                ("/stage:home", {}),
                ("/stage:enable", {}),
                ("/calibrations", {}),
            ):
                assert_problem(client.post(f"{API}{path}", json=body), 503, "no_stage")
            assert client.get(f"{API}/stage/messages").json() == {"messages": []}
            assert client.get("/metrics").status_code == 200
            assert client.get(f"{API}/devices").status_code == 200
    finally:
        service.close()


TWO = """
[[stage.controllers]]
url = "{one}"
axes = [1]
[[stage.controllers]]
url = "{two}"
axes = [2]
"""


def test_two_controllers_with_one_axis_each_move_stop_and_get_lost_by_themselves(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = Bench(monkeypatch, {"one": ("conex-cc", (1,)), "two": ("conex-cc", (1,))})
    bench.on("one")
    bench.on("two")
    text = rig_text(TWO.format(one=bench.url("one"), two=bench.url("two")), driver='"conex-cc"')
    config = parse_config("".join(line for line in text.splitlines(keepends=True) if line != 'url = "sim"\n'))
    with bench.serve(config, tmp_path / "data") as client:
        until_connected(client, "stage1")
        until_connected(client, "stage2")
        home = wait_for_job(client, client.post(f"{API}/stage:home").json()["job"])
        assert home["state"] == "succeeded", home
        moved = wait_for_job(
            client, client.post(f"{API}/stage/moves", json={"dz_mm": {"cam1": 1.0, "cam2": 2.0}}).json()["job"]
        )
        assert moved["state"] == "succeeded", moved
        assert bench.controllers["one"].true_position_mm(1) == pytest.approx(1.0, abs=1e-3)
        assert bench.controllers["two"].true_position_mm(1) == pytest.approx(2.0, abs=1e-3)
        stops = [len(one.commands("ST")) for one in bench.controllers.values()]
        assert client.post(f"{API}/stage:stop").status_code == 200
        wait_until(
            lambda: all(len(one.commands("ST")) > n for one, n in zip(bench.controllers.values(), stops, strict=True))
        )
        bench.off("two")
        step = client.post(f"{API}/tests/{new_test(client)}/steps", json={}).json()
        assert step["dz_mm"] == {"cam1": pytest.approx(1.0, abs=1e-3), "cam2": None}
        shown = client.get(f"{API}/stage").json()
        assert [axis["axis"] for axis in shown["axes"]] == [1]
        assert shown["fault"]["code"] == "stage_lost"
        back = wait_for_job(client, client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 0.0}}).json()["job"])
        assert back["state"] == "succeeded", back
        stops = [len(bench.controllers["one"].commands("ST"))]
        assert_problem(client.post(f"{API}/stage:stop"), 503, "stage_lost")  # one was not reached, the other was
        wait_until(lambda: len(bench.controllers["one"].commands("ST")) > stops[0])
        bench.on("two")
        until_connected(client, "stage2")
        assert client.post(f"{API}/stage/moves", json={"positions_mm": {"2": 0.0}}).status_code == 202


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (TWO.format(one="a", two="b"), "either url or"),
        ('[[stage.controllers]]\nurl = "a"\naxes = [1]', "either url or"),
    ],
)
def test_a_stage_of_two_forms_is_refused(more: str, words: str) -> None:
    with pytest.raises(Exception, match=words):
        parse_config(rig_text(more))


@pytest.mark.parametrize(
    ("controllers", "words"),
    [
        ([("a", [1])], r"move the axes \[1\]"),
        ([("a", [1]), ("a", [2])], "have the url a"),
        ([("a", [1]), ("b", [1, 2])], "move axis 1"),
        ([("a", [1, 1]), ("b", [2])], "named once"),
    ],
)
def test_controllers_that_contradict_the_cameras_are_refused(
    controllers: list[tuple[str, list[int]]], words: str
) -> None:
    more = "".join(f'[[stage.controllers]]\nurl = "{url}"\naxes = {axes}\n' for url, axes in controllers)
    text = "".join(line for line in rig_text(more).splitlines(keepends=True) if line != 'url = "sim"\n')
    with pytest.raises(Exception, match=words):
        parse_config(text)


def test_real_cameras_calibrated_by_a_simulated_stage_are_never_good() -> None:
    from stereorig.server.compute.calibration.fit import _check_positions

    def level(simulated: list[str], moves: str) -> str:
        content: dict[str, Any] = {"verdict": {"level": "good", "reasons": []}}
        _check_positions(content, simulated, moves=moves)
        return str(content["verdict"]["level"])

    assert level(["stage"], "cameras") == level(["stage"], "target") == "warning"
    assert level(["stage"], "free") == level([], "cameras") == level(["cam1", "cam2", "stage"], "cameras") == "good"
