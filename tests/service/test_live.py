"""Live measurement: values by every door, frames accounted for, beside stored captures; lines over TCP."""

from __future__ import annotations

import contextlib
import json
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
import pytest

from stereorig.core.errors import FileFormatError
from stereorig.server.config.rig_file import parse_config
from stereorig.server.http.line_protocol import MAX_LINE
from stereorig.server.workflows.service import Service
from tests.bench.live.socket_client import ValueSocket
from tests.support.patience import Deadline
from tests.support.service_rig import SMALL, plate_test, served, wait_for_rig
from tests.support.stage_service import wait_until

API = "/api/v1"
pytestmark = pytest.mark.timeout(300)
SECTION = """[live]
tcp_port = 0

[[live.channels]]
name = "force"
url = "tcp://127.0.0.1:{port}"
pattern = 'F=(\\S+)'
unit = "N"
silence_s = 5.0

[[live.channels]]
name = "absent"
url = "/dev/no-such-port"

[sim]
"""
GAUGES = {
    "extensometers": [{"name": "e1", "a_px": [128, 95], "b_px": [128, 145]}],
    "areas": [{"name": "a1", "rectangle": [105, 95, 150, 145]}, {"name": "c1", "circle": [128, 120, 25]}],
    "points": [{"name": "p1", "xy_px": [128, 120]}],
    "silence_ms": 5000,
}


class Machine(socketserver.StreamRequestHandler):
    """A load cell that sends its reading fifty times a second."""

    def handle(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self.wfile.write(b"t=1 F=812.5\n")
                time.sleep(0.02)


@pytest.fixture(scope="module")
def live_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Machine) as machine:
        machine.daemon_threads = True
        threading.Thread(target=machine.serve_forever, daemon=True).start()
        config = SMALL.replace("[sim]\n", SECTION.format(port=machine.server_address[1]), 1)
        with Service(parse_config(config), tmp_path_factory.mktemp("live") / "data") as service:
            yield service
        machine.shutdown()


@pytest.fixture(scope="module")
def client(live_service: Service) -> Iterator[httpx.Client]:
    with served(live_service) as client:
        wait_for_rig(client)
        yield client


@pytest.fixture(scope="module")
def test_id(client: httpx.Client) -> str:
    return plate_test(client)


def await_frames(client: httpx.Client, test_id: str, number: int, seconds: float = 120.0) -> dict[str, Any]:
    deadline = Deadline(seconds)
    while deadline.left:
        live: dict[str, Any] = client.get(f"{API}/tests/{test_id}/live").raise_for_status().json()
        assert live["state"] in ("starting", "running"), live
        if live["values"]["number"] >= number:
            return live
        time.sleep(0.05)
    raise AssertionError(f"no frame {number}: {live}")


def await_valid(client: httpx.Client, test_id: str, seconds: float = 60.0) -> None:
    deadline = Deadline(seconds)
    while not client.get(f"{API}/tests/{test_id}/live").json()["values"]["valid"]:
        assert deadline.left
        time.sleep(0.05)


@pytest.fixture(scope="module")
def running(client: httpx.Client, test_id: str) -> Iterator[str]:
    begun = client.post(f"{API}/tests/{test_id}/live", json={**GAUGES, "field": True})
    assert begun.status_code == 201, begun.text
    await_frames(client, test_id, 3)
    yield test_id
    stopped = client.post(f"{API}/tests/{test_id}/live:stop").raise_for_status().json()
    assert stopped["state"] == "ended"
    assert not stopped["values"]["valid"]
    assert client.post(f"{API}/tests/{test_id}/live:stop").json()["state"] == "ended"


@contextmanager
def lines(port: int) -> Iterator[Any]:
    with socket.create_connection(("127.0.0.1", port), timeout=30.0) as link, link.makefile("rwb") as both:

        def ask(text: str | bytes, *, answers: bool = True) -> str:
            both.write((text if isinstance(text, bytes) else text.encode()) + b"\n")
            both.flush()
            return both.readline().decode().strip() if answers else ""

        yield ask


# values ---------------------------------------------------------------------------------------------------------


def test_values_have_a_time_and_an_uncertainty(client: httpx.Client, running: str) -> None:
    values = await_frames(client, running, 3)["values"]
    assert values["valid"]
    assert not values["reason"]
    assert values["exposed_utc"].endswith("Z")
    assert 0.0 <= time.monotonic() - values["time_s"] < 60.0  # one clock for all processes of the machine
    for name, gauge in values["gauges"].items():
        assert gauge["valid"], name
        for quantity, number in gauge["values"].items():
            assert number["u"] > 0.0, (name, quantity)
            assert np.linalg.norm(list(number["budget"].values())) == pytest.approx(number["u"], rel=1e-6)
    # nothing has moved since the reference: zero within four standard uncertainties
    for name, quantity in (("e1", "strain"), ("a1", "eyy"), ("p1", "w_mm"), ("c1", "exx")):
        number = values["gauges"][name]["values"][quantity]
        assert abs(number["value"]) < 4.0 * number["u"]


def test_the_load_is_seen_live_as_the_measured_step_sees_it(client: httpx.Client, running: str) -> None:
    client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 300.0}).raise_for_status()
    try:
        number = await_frames(client, running, 1)["values"]["number"]
        seen = await_frames(client, running, number + 3)["values"]["gauges"]["p1"]["values"]["w_mm"]
        assert seen["value"] < -0.02
        field = client.get(f"{API}/tests/{running}/live/field").raise_for_status().json()
        w = np.array(field["w_mm"], dtype=float)
        assert w.shape == (len(field["y_px"]), len(field["x_px"]))
        assert np.nanmin(w) < -0.02
    finally:
        client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0}).raise_for_status()


def test_every_frame_has_one_fate(client: httpx.Client, running: str) -> None:
    account = await_frames(client, running, 5)["account"]
    fates = account["measured"] + account["skipped"] + account["refused"] + account["waiting"]
    assert account["frames"] == fates
    assert account["followed"] + account["step"] == account["measured"]
    figures = client.get("/metrics").text
    for fate in ("measured", "skipped", "refused"):
        assert f'stereorig_live_frames_total{{what="{fate}"}}' in figures
    assert "stereorig_live_running 1.0" in figures


def test_stored_captures_go_on_beside_it(client: httpx.Client, running: str) -> None:
    before = await_frames(client, running, 1)["values"]["number"]
    taken = [client.post(f"{API}/tests/{running}/steps", json={"label": f"beside {k}"}) for k in range(3)]
    assert [answer.status_code for answer in taken] == [201, 201, 201]
    live = await_frames(client, running, before + 2)
    assert live["state"] == "running"
    assert live["account"]["refused"] == 0


def test_there_is_one_at_a_time(client: httpx.Client, running: str) -> None:
    again = client.post(f"{API}/tests/{running}/live", json=GAUGES)
    assert again.status_code == 409
    assert again.json()["code"] == "live_running"


# streams --------------------------------------------------------------------------------------------------------


def test_events_bring_each_frame(client: httpx.Client, running: str) -> None:
    numbers = []
    with client.stream("GET", f"{API}/tests/{running}/live/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        for line in answer.iter_lines():
            if line.startswith("data:"):
                numbers.append(json.loads(line.removeprefix("data:"))["number"])
            if len(numbers) > 4:
                break
    # the newest comes first, and may come once more
    assert numbers[1:] == list(range(numbers[1], numbers[1] + 4))
    assert numbers[1] - numbers[0] in (0, 1)


def test_the_field_is_streamed_at_a_bounded_rate(client: httpx.Client, running: str) -> None:
    url = f"{API}/tests/{running}/live/field"
    seen = []
    with client.stream("GET", f"{url}/events", params={"component": "v_mm", "rate_hz": 5}) as answer:
        for line in answer.iter_lines():
            if line.startswith("data:"):
                seen.append((time.monotonic(), json.loads(line.removeprefix("data:"))))
            if len(seen) > 3:
                break
    whole = client.get(url).json()
    for _, one in seen:
        assert one["x_px"] == whole["x_px"]
        assert np.shape(one["v_mm"]) == (len(whole["y_px"]), len(whole["x_px"]))
        assert np.nanmax(np.abs(np.array(one["v_mm"], dtype=float))) < 0.01  # nothing moves
    numbers = [one["number"] for _, one in seen]
    assert numbers == sorted(set(numbers))
    # a reader may get an event late, and the next in time: three intervals are not shorter than two
    assert seen[-1][0] - seen[0][0] > 2 / 5
    assert client.get(f"{url}/events", params={"rate_hz": 1000}).status_code == 422


def port_of(client: httpx.Client) -> int:
    return int(client.base_url.port or 0)


def test_a_websocket_brings_each_frame(client: httpx.Client, running: str) -> None:
    link = ValueSocket(port_of(client), f"{API}/tests/{running}/live/ws")
    assert link.status == 101
    numbers = [message["number"] for message in (link.message() for _ in range(4)) if message is not None]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) >= 3
    link.close()
    # and the service goes on without it
    await_frames(client, running, numbers[-1] + 1)


@pytest.mark.parametrize(
    ("headers", "target"),
    [
        ({"Origin": "https://elsewhere.example"}, "ws"),
        ({"Sec_Fetch_Site": "cross-site"}, "ws"),
        ({"Authorization": "Bearer no-such-key"}, "ws"),
    ],
)
def test_a_websocket_is_refused_as_any_request_is(
    client: httpx.Client, running: str, headers: dict[str, str], target: str
) -> None:
    link = ValueSocket(port_of(client), f"{API}/tests/{running}/live/{target}", **headers)
    assert link.status in (401, 403)
    link.close()


def test_a_websocket_of_a_test_that_is_not_measured_is_refused(client: httpx.Client, running: str) -> None:
    link = ValueSocket(port_of(client), f"{API}/tests/t000000-000000/live/ws")
    assert link.status == 403
    link.close()


# lines ----------------------------------------------------------------------------------------------------------


def test_a_test_machine_reads_gauges_by_lines(client: httpx.Client, running: str) -> None:
    port = await_frames(client, running, 1)["tcp_port"]
    with lines(port) as ask:
        assert ask("*IDN?").startswith(f"stereorig,live,{running},")
        assert ask("CONF:GAUGES?").split(",") == ["p1:point", "e1:extensometer", "a1:area", "c1:area"]
        valid, value, u, number, time_s, reason = ask("READ:GAUGE? e1\r").split(",")
        assert (valid, reason) == ("1", "ok")
        assert abs(float(value)) < 5.0 * float(u)
        assert int(number) >= 1
        assert float(time_s) <= time.monotonic()
        length = ask("read:gauge? e1,length_mm").split(",")
        assert float(length[1]) == pytest.approx(50 * 0.066, rel=0.3)
        assert [one.split(",")[0] for one in ask("READ:ALL?").split(";")] == ["p1", "e1", "a1", "c1"]
        assert ask("SYST:ERR?") == '0,"No error"'


def test_wrong_lines_are_queued_as_errors_and_nothing_dies(client: httpx.Client, running: str) -> None:
    port = await_frames(client, running, 1)["tcp_port"]
    with lines(port) as ask:
        ask("MEAS:VOLT?", answers=False)
        ask("READ:GAUGE? nobody", answers=False)
        ask("READ:GAUGE?", answers=False)
        ask("READ:GAUGE? e1,colour", answers=False)
        ask(b"\xff\xfe\x00", answers=False)
        ask("x" * (MAX_LINE + 5000), answers=False)
        ask("", answers=False)
        numbers = [int(ask("SYST:ERR?").split(",")[0]) for _ in range(7)]
        assert numbers == [-113, -224, -109, -224, -101, -363, 0]
        for _ in range(50):
            ask("NO:SUCH?", answers=False)
        ask("*CLS", answers=False)
        assert ask("SYST:ERR?").startswith("0,")
        assert ask("READ:GAUGE? e1").startswith(("0", "1"))
    rng = np.random.default_rng(3)
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", port), timeout=10.0) as link:
            link.sendall(rng.bytes(int(rng.integers(1, 3000))))

    def answers() -> bool:
        with lines(port) as ask:
            return ask("*IDN?").startswith("stereorig")

    wait_until(answers, 30.0)  # the places of those that have gone are free again


# channels -------------------------------------------------------------------------------------------------------


def test_channels_of_the_rig_file_are_read_and_known_at_the_exposure(client: httpx.Client, running: str) -> None:
    url = f"{API}/tests/{running}/live"
    deadline = Deadline(30.0)
    while not (known := client.get(url).json()["channels"])["force"]["readings"]:
        assert deadline.left
        time.sleep(0.05)
    assert known["force"]["line"]["state"] == "reading"
    assert (known["force"]["last_value"], known["force"]["unit"]) == (812.5, "N")
    assert 0.0 <= time.monotonic() - known["force"]["last_time_s"] < 30.0
    assert known["absent"]["line"]["state"] == "unreachable"
    assert "no-such-port" in known["absent"]["line"]["reason"]
    assert (known["absent"]["readings"], known["absent"]["last_value"]) == (0, None)
    await_frames(client, running, client.get(url).json()["values"]["number"] + 2)
    time.sleep(0.1)
    frames = client.get(f"{url}/history", params={"limit": 6000}).json()["frames"]
    assert any(frame["channels"].get("force") == 812.5 for frame in frames)
    posted = client.post(f"{url}/channels", json={"readings": [{"channels": {"force": 1.0}}]})
    assert posted.json()["code"] == "channel_is_read"


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ('url = "http://example.org"', "url"),
        ('url = "tcp://h:1"\npattern = "F=.*"', "group"),
        ('url = "tcp://h:1"\npattern = "("', "regular expression"),
    ],
)
def test_a_channel_that_cannot_be_read_is_refused_with_the_rig_file(line: str, why: str) -> None:
    text = SMALL.replace("[sim]\n", f'[[live.channels]]\nname = "f"\n{line}\n\n[sim]\n', 1)
    with pytest.raises(FileFormatError, match=why):
        parse_config(text)


def test_a_channels_clock_is_found_from_a_ramp_and_its_values_at_the_exposure(
    client: httpx.Client, running: str
) -> None:
    behind_s, readings, done, put = 0.35, [], threading.Event(), [0.0]
    began = time.monotonic()

    def load_at(now: float) -> float:
        return float(np.clip((now - began - 2.0) * 100.0, 0.0, 400.0))

    def machine() -> None:
        while not done.is_set():
            now = time.monotonic()
            readings.append({"time_s": now - behind_s, "channels": {"pressure_kpa": put[0]}})
            time.sleep(0.01)

    thread = threading.Thread(target=machine)
    thread.start()
    try:
        while time.monotonic() < began + 7.0:
            load = load_at(time.monotonic())
            client.put(f"{API}/sim/scene", json={"scene": "plate", "load": load})
            put[0] = load  # on a busy machine the scene follows late: the channel has what it was put to
            time.sleep(0.02)
    finally:
        done.set()
        thread.join()
        client.put(f"{API}/sim/scene", json={"scene": "plate", "load": 0.0})
    url = f"{API}/tests/{running}/live"
    early = client.post(f"{url}/channels:align", json={"channel": "pressure_kpa", "gauge": "p1", "quantity": "w_mm"})
    assert early.json()["code"] == "channel_unknown"
    sent = client.post(f"{url}/channels", json={"readings": readings})
    assert sent.json()["taken"] == len(readings)
    again = client.post(f"{url}/channels", json={"readings": readings[:1]})
    assert again.json()["code"] == "channels_out_of_order"
    found = client.post(f"{url}/channels:align", json={"channel": "pressure_kpa", "gauge": "p1", "quantity": "w_mm"})
    assert found.status_code == 200, found.text
    offset = found.json()
    # the scene is put before the cameras up to a request before the channel has the load, and a plate bends a little
    # less than its pressure: some hundredths of a second beside the noise
    assert offset["offset_s"] == pytest.approx(behind_s, abs=4.0 * offset["u_s"] + 0.2)
    frames = client.get(f"{url}/history", params={"limit": 6000}).json()["frames"]
    known = [frame for frame in frames if "pressure_kpa" in frame["channels"]]
    assert len(known) > 5
    w = np.array([frame["values"]["p1"]["w_mm"] for frame in known if "w_mm" in frame["values"].get("p1", {})])
    p = np.array([f["channels"]["pressure_kpa"] for f in known if "w_mm" in f["values"].get("p1", {})])
    # both are on one clock now
    assert np.corrcoef(w, p)[0, 1] < -0.85


# refusals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({}, 422, "invalid_request"),
        ({"points": [{"name": "p", "xy_px": [5, 5]}]}, 422, None),
        ({**GAUGES, "reference": 77}, 409, "no_steps"),
        ({"points": [{"name": "p", "xy_px": [128, 120]}] * 2}, 422, "values_disagree"),
    ],
)
def test_what_cannot_be_measured_is_refused_at_once(
    client: httpx.Client, live_service: Service, test_id: str, body: dict[str, Any], status: int, code: str | None
) -> None:
    client.post(f"{API}/tests/{test_id}/live:stop")
    answer = client.post(f"{API}/tests/{test_id}/live", json=body)
    assert answer.status_code == status, answer.text
    if code is not None:
        assert answer.json()["code"] == code
    if answer.status_code == 201:
        client.post(f"{API}/tests/{test_id}/live:stop")


def test_a_lost_camera_makes_the_values_invalid_and_names_it(
    client: httpx.Client, live_service: Service, test_id: str
) -> None:
    client.post(f"{API}/tests/{test_id}/live:stop")
    body = {"extensometers": GAUGES["extensometers"], "silence_ms": 5000}
    assert client.post(f"{API}/tests/{test_id}/live", json=body).status_code == 201
    await_frames(client, test_id, 2)
    faults = live_service.rig.pair.units["cam2"].grabber.faults  # type: ignore[attr-defined]
    faults.gone = True
    try:
        deadline = Deadline(60.0)
        while (values := client.get(f"{API}/tests/{test_id}/live").json()["values"])["valid"]:
            assert deadline.left
            time.sleep(0.02)
        assert values["reason"] in ("camera_lost", "camera_gone"), values
        assert not values["gauges"]["e1"]["valid"]
        assert not values["gauges"]["e1"]["values"]
        port = client.get(f"{API}/tests/{test_id}/live").json()["tcp_port"]
        with lines(port) as ask:
            assert ask("READ:GAUGE? e1").split(",")[:3] == ["0", "NAN", "NAN"]
    finally:
        faults.gone = False
    await_valid(client, test_id)  # connected again by itself
    client.post(f"{API}/tests/{test_id}/live:stop")


def test_lines_are_off_unless_the_rig_file_asks(tmp_path: Path) -> None:
    assert parse_config(SMALL).live.tcp_port is None
    with pytest.raises(Exception, match="tcp_token is needed"):
        parse_config(SMALL.replace("[sim]\n", '[live]\ntcp_port = 0\ntcp_host = "0.0.0.0"\n\n[sim]\n', 1))


def test_it_goes_on_when_its_process_died(client: httpx.Client, test_id: str) -> None:
    client.post(f"{API}/tests/{test_id}/live:stop")
    client.post(f"{API}/tests/{test_id}/live", json=GAUGES).raise_for_status()
    await_frames(client, test_id, 2)
    computation = next(
        p for p in psutil.Process().children() if any("memfd:stereorig" in m.path for m in p.memory_maps())
    )
    computation.kill()
    computation.wait(10.0)
    number = client.get(f"{API}/tests/{test_id}/live").json()["values"]["number"]
    after = await_frames(client, test_id, number + 3)
    assert after["account"]["refused_by"] in ({"worker_died": 1}, {"live_ended": 1})  # over a frame, or between two
    client.post(f"{API}/tests/{test_id}/live:stop").raise_for_status()
