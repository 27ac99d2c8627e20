"""Channels that the rig file names: at each exposure, kept beside the test, believed only while they may be."""

from __future__ import annotations

import csv
import io
import json
import math
import socketserver
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from stereorig.core.errors import FileFormatError
from stereorig.server.config.rig_file import parse_config
from stereorig.server.store.bundle.pack import pack
from stereorig.server.store.verify import verify
from stereorig.server.workflows.service import Service
from tests.support.service_rig import data_of, new_test, served, wait_for_job, wait_for_rig
from tests.support.stage_service import wait_until
from tests.support.tiny_rig import TINY

API = "/api/v1"
RATE_HZ = 40.0


class Instrument(socketserver.ThreadingTCPServer):
    """Sends a number, made from the host's monotonic clock, forty times a second."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, line: Callable[[float], str]) -> None:
        self.line = line
        instrument = self

        class Link(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                with suppress(OSError):
                    while True:
                        text = instrument.line(time.monotonic())
                        if text:
                            self.wfile.write(f"{text}\n".encode())
                        time.sleep(1.0 / RATE_HZ)

        super().__init__(("127.0.0.1", 0), Link)
        threading.Thread(target=self.serve_forever, daemon=True).start()


def load(at_s: float) -> float:
    return 500.0 + 100.0 * math.sin(at_s)


def noisy(value: float, digits: int) -> str:
    return f"{value + 3.0 * 10.0**-digits * np.random.default_rng().normal():.{digits}f}"


@contextmanager
def rig(path: Path, channels: str) -> Iterator[tuple[httpx.Client, Service]]:
    text = TINY.replace("[sim]\n", f"{channels}\n[sim]\n", 1)
    with Service(parse_config(text), data_of(path)) as service, served(service) as client:
        wait_for_rig(client)
        yield client, service


def channel(name: str, instrument: Instrument, more: str = "") -> str:
    return f'[[channels]]\nname = "{name}"\nurl = "tcp://127.0.0.1:{instrument.server_address[1]}"\n{more}\n'


def step(client: httpx.Client, test_id: str, **body: Any) -> dict[str, Any]:
    answer = client.post(f"{API}/tests/{test_id}/steps", json=body)
    assert answer.status_code == 201, answer.text
    found: dict[str, Any] = answer.json()
    return found


def await_readings(client: httpx.Client, count: int, *names: str) -> None:
    def there() -> bool:
        known = client.get(f"{API}/channels").json()["channels"]
        return all(known[name]["readings"] >= count for name in names)

    wait_until(there, 60.0)


@pytest.fixture
def cell() -> Iterator[Instrument]:
    with Instrument(lambda at_s: f"ST,{noisy(load(at_s), 1)}kg") as instrument:
        yield instrument
        instrument.shutdown()


@pytest.mark.fault(64)
def test_a_step_has_the_channels_at_its_exposure_and_the_test_their_readings(cell: Instrument, tmp_path: Path) -> None:
    program = "import time\nwhile True: print(21.5, flush=True); time.sleep(0.05)"
    channels = channel("force", cell, 'column = 2\nunit = "kgf"\nload = true\nscale = 2.0')
    channels += f'[[channels]]\nname = "room_c"\nexec = ["{sys.executable}", "-u", "-c", {json.dumps(program)}]\n'
    with rig(tmp_path, channels) as (client, service):
        test_id = new_test(client)
        await_readings(client, 20, "force", "room_c")
        ratios = []
        for _ in range(8):
            one = step(client, test_id)
            at_s = service.tests.steps.read(test_id, one["n"]).document.host_monotonic_ns
            assert at_s is not None
            assert one["warnings"] == []
            assert one["channels"].keys() == one["channel_u"].keys() == {"force", "room_c"}
            assert one["channel_units"] == {"force": "kgf", "room_c": "degC"}
            assert one["load_n"] == pytest.approx(9.80665 * one["channels"]["force"])
            # rounding alone is a tenth of the root of twelve, and twice that by the scale
            assert 0.2 / math.sqrt(12.0) < one["channel_u"]["force"] < 20.0
            # its exposure began up to a tenth of a second before the frame was in memory: 20 kgf of the sine
            assert abs(one["channels"]["force"] - 2.0 * load(at_s / 1e9)) < 20.0 + 5.0 * one["channel_u"]["force"]
            assert one["channels"]["room_c"] == 21.5
            ratios.append(one["channel_u"]["force"])
        stated = step(client, test_id, load_n=1.0, channels={"force": 7.0, "stroke_mm": 2.0})
        assert (stated["load_n"], stated["channels"]["force"], stated["channels"]["stroke_mm"]) == (1.0, 7.0, 2.0)
        assert "force" not in stated["channel_u"]
        imported = client.get(f"{API}/tests/{test_id}/steps", params={"channels": True}).json()["steps"]
        assert imported[3]["channels"].keys() == {"force", "room_c"}
        job = client.post(f"{API}/tests/{test_id}/steps", json={"count": 3}).json()["job"]
        assert wait_for_job(client, job)["state"] == "succeeded"
        assert step(client, test_id)["channels"].keys() == {"force", "room_c"}
        wait_until(lambda: service.tests.readings(test_id) != [], 60.0)
    assert verify(data_of(tmp_path)).findings == ()
    with rig(tmp_path, "") as (client, service):  # they stay, whatever is read now
        rows = list(csv.DictReader(io.StringIO(client.get(f"{API}/tests/{test_id}/channels/readings").text)))
        forces = [(float(r["host_s"]), float(r["value"])) for r in rows if r["channel"] == "force"]
        assert len(forces) > 20
        assert all(abs(value - 2.0 * load(at_s)) < 60.0 for at_s, value in forces)
        assert abs(float(rows[-1]["time_utc_s"]) - time.time()) < 600.0
        bundle = tmp_path / "b.zip"
        pack(data_of(tmp_path), test_id, bundle)
        assert f"tests/{test_id}/channels/0000.csv".encode() in bundle.read_bytes()
        assert client.get(f"{API}/channels").json() == {"channels": {}}


def test_channels_that_are_dead_stuck_or_of_another_are_said_with_the_step(tmp_path: Path) -> None:
    with Instrument(lambda at_s: noisy(load(at_s), 1)) as force, Instrument(lambda at_s: noisy(at_s, 3)) as stroke:
        names = channel("force", force) + channel("stroke", stroke)
        with rig(tmp_path, names + '[[channels]]\nname = "absent"\nurl = "tcp://127.0.0.1:9"\n') as (client, _):
            test_id = new_test(client)
            await_readings(client, 80, "force", "stroke")

            def said(*parts: str) -> bool:
                warnings = step(client, test_id)["warnings"]
                return any(all(part in text for part in parts) for text in warnings)

            one = step(client, test_id)
            assert one["channels"].keys() == {"force", "stroke"}
            assert [text for text in one["warnings"] if "absent" not in text] == []
            assert said("absent", "unreachable")
            frozen = force.line(0.0)
            force.line = lambda _: frozen
            wait_until(lambda: said("force", "stuck at", "while stroke changes"), 60.0)
            force.line = lambda at_s: noisy(load(at_s), 1)
            wait_until(lambda: not said("force", "stuck"), 60.0)
            shared: list[str] = []

            def sends(at_s: float) -> str:
                shared[:] = [noisy(load(at_s), 1)]
                return shared[0]

            force.line = sends
            stroke.line = lambda at_s: shared[0] if shared and int(at_s * RATE_HZ) % 3 else noisy(at_s, 3)
            wait_until(lambda: said("stroke", "readings of force appear"), 60.0)
            stroke.line = lambda _: ""
            wait_until(lambda: said("stroke", "silent"), 60.0)
            assert "stroke" not in step(client, test_id)["channels"]


@pytest.mark.parametrize(
    ("channel", "why"),
    [
        ('exec = ["a"]\nurl = "tcp://h:1"', "one of url, exec and daq"),
        ("", "one of url, exec and daq"),
        ('exec = "rm -r /"', "exec"),
        ('exec = ["a"]\nload = true\nunit = "mm"', "N, kN"),
        ('exec = ["a"]\n[[live.channels]]\nname = "f"\nurl = "tcp://h:1"', "two channels have the name f"),
    ],
)
def test_a_channel_of_the_rig_file_names_one_thing_to_read(channel: str, why: str) -> None:
    with pytest.raises(FileFormatError, match=why):
        parse_config(TINY.replace("[sim]\n", f'[[channels]]\nname = "f"\n{channel}\n\n[sim]\n', 1))


def test_no_request_can_name_a_program(tmp_path: Path) -> None:
    with rig(tmp_path, "") as (client, _):
        description = client.get("/api/v1/openapi.json").text
        assert '"exec"' not in description
        assert '"daq"' not in description
