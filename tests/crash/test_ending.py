"""The end in order: the stage first, then requests, then the rest; and the messages to systemd."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import threading
import time
from argparse import ArgumentParser
from collections.abc import Iterator
from configparser import ConfigParser
from pathlib import Path
from typing import Any

import pytest

from stereorig.server.cli.operation.serve import add_arguments
from stereorig.server.http.systemd import Notifier
from stereorig.sim.controllers.registry import make_controller
from stereorig.sim.controllers.server import ControllerServer
from tests.bench.reliability.processes import process_of, serving
from tests.support.patience import busy
from tests.support.requirements import ROOT, missing
from tests.support.stage_service import API, wait_until

UNIT = ROOT / "deploy" / "stereorig.service"


class Listener:
    """In place of systemd: a datagram socket, and when each message came."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.heard: list[tuple[float, str]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError):
            while data := self._socket.recv(4096):
                self.heard += [(time.monotonic(), line) for line in data.decode().splitlines()]

    def times(self, line: str) -> list[float]:
        return [at for at, heard in list(self.heard) if heard == line]

    def close(self) -> None:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b"", str(self.path))
        self._thread.join(5.0)
        self._socket.close()


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[Listener]:
    made = Listener(tmp_path / "notify")
    yield made
    made.close()


@pytest.mark.fault(27)
def test_the_stage_is_stopped_first_and_all_has_ended_in_a_few_seconds(tmp_path: Path, listener: Listener) -> None:
    controller = make_controller("esp301", (1, 2), time_scale=1.0)
    with (
        ControllerServer(controller) as server,
        serving(
            tmp_path,
            server.url,
            options=("--log-format", "json", "--log-level", "info"),
            NOTIFY_SOCKET=str(listener.path),
            WATCHDOG_USEC="400000",
        ) as (process, client),
    ):
        ready = listener.times("READY=1")
        assert len(ready) == 1
        job = client.post(f"{API}/stage:home").json()["job"]
        wait_until(lambda: client.get(f"{API}/jobs/{job['id']}").json()["state"] == "succeeded", 60.0)
        wait_until(lambda: len(listener.times("WATCHDOG=1")) >= 5, 60.0)
        # two streams that would outlast everything, one of them unread, and a connection that does nothing
        address = (client.base_url.host, client.base_url.port or 0)
        streams = [socket.create_connection(address) for _ in range(3)]
        for stream, path in zip(streams, (f"{API}/events", f"{API}/cameras/cam1/stream.mjpg?rate_hz=30"), strict=False):
            stream.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
        job = client.post(f"{API}/stage/moves", json={"positions_mm": {"1": 5.0}}).json()["job"]
        wait_until(lambda: controller.axis(1).moving)
        known = len(controller.received)
        asked = time.monotonic()
        process.terminate()
        wait_until(lambda: any(entry.text == "ST" for entry in controller.received[known:]), 20.0)
        stopped = next(entry.at_s for entry in controller.received[known:] if entry.text == "ST")
        assert process.wait(timeout=240.0) == 0
        took_s = time.monotonic() - asked
        for stream in streams:
            stream.close()
        # the limit of a stop is 50 ms; here the machine may be busy with other tests
        assert stopped - asked < 1.0 * busy()
        assert not controller.axis(1).moving
        assert controller.true_position_mm(1) < 4.5
        # no motion began after it
        assert not any(entry.text.startswith(("1PA", "2PA")) for entry in controller.received[known:])
        assert took_s < 20.0 * busy()
        (ending,) = listener.times("STOPPING=1")
        assert ending >= ready[0]
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert not [line for line in lines if line["level"] in ("error", "critical")], lines
    assert [line["state"] for line in lines if line.get("job_id") == job["id"] and "state" in line][-1] == "interrupted"


@pytest.mark.parametrize("part", ["rig", "web"])
def test_the_watchdog_is_not_notified_while_a_process_does_not_answer(
    tmp_path: Path, listener: Listener, part: str
) -> None:
    with ControllerServer(make_controller("esp301", (1, 2), time_scale=1.0)) as server:
        notify = {"NOTIFY_SOCKET": str(listener.path), "WATCHDOG_USEC": "200000"}
        with serving(tmp_path, server.url, **notify) as (process, _):
            wait_until(lambda: len(listener.times("WATCHDOG=1")) >= 3, 60.0)
            held = process_of(process, part)
            held.suspend()
            try:
                time.sleep(0.3)  # a notification may be under way
                known = len(listener.times("WATCHDOG=1"))
                time.sleep(1.0)
                assert len(listener.times("WATCHDOG=1")) == known
            finally:
                held.resume()
            wait_until(lambda: len(listener.times("WATCHDOG=1")) > known, 60.0)


def test_without_a_listener_a_notifier_does_nothing(tmp_path: Path, listener: Listener) -> None:
    for environment in ({}, {"NOTIFY_SOCKET": str(tmp_path / "nobody"), "WATCHDOG_USEC": "1000"}):
        notifier = Notifier(environment)
        notifier.ready("x")
        notifier.alive()
        notifier.stopping()
    assert not Notifier({"WATCHDOG_USEC": "1000"}).is_due()
    mine = {"NOTIFY_SOCKET": str(listener.path), "WATCHDOG_USEC": "1000000"}
    assert Notifier({**mine, "WATCHDOG_PID": str(os.getpid())}).is_due()
    assert not Notifier({**mine, "WATCHDOG_PID": "1"}).is_due()
    assert not Notifier({**mine, "WATCHDOG_USEC": "soon"}).is_due()
    due = Notifier(mine)
    assert [due.is_due(), due.is_due()] == [True, False]


def test_an_abstract_socket_is_found() -> None:
    name = f"stereorig-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as inlet:
        inlet.bind(f"\0{name}")
        inlet.settimeout(10.0)
        Notifier({"NOTIFY_SOCKET": f"@{name}"}).ready("serves")
        assert inlet.recv(4096) == b"READY=1\nSTATUS=serves"


def unit() -> ConfigParser:
    parser = ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read(UNIT)
    return parser


def parsed(words: list[str]) -> Any:
    """Return a command's arguments as the command line takes them."""
    parser = ArgumentParser()
    add_arguments(parser)
    assert words[1] == "serve"
    return parser.parse_args(words[2:])


def test_the_unit_says_what_the_service_does() -> None:
    section = unit()["Service"]
    assert section["Type"] == "notify"
    assert float(section["WatchdogSec"]) >= 10.0
    # our own end takes up to 3 s for requests and a few more for jobs and worker
    assert float(section["TimeoutStopSec"]) >= 20.0
    assert section["KillMode"] == "mixed"
    from stereorig.server.base.priority import _SERVICE_NICE

    assert int(section["Nice"]) == int(section["LimitNICE"]) == _SERVICE_NICE
    assert section["OOMPolicy"] == "continue"  # the worker's death is not the service's


def test_the_units_command_is_one_that_the_command_line_takes() -> None:
    words = unit()["Service"]["ExecStart"].split()
    args = parsed(words)
    assert args.log_format == "json"
    assert str(args.data) == "/var/lib/stereorig"


def test_systemd_takes_the_unit_and_finds_it_closed(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        missing("the program systemd-analyze (apt-get install systemd)")
    copy = tmp_path / "stereorig.service"
    copy.write_text(UNIT.read_text().replace("/opt/stereorig/bin/stereorig", "/bin/true"))
    checked = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, check=False)
    problems = [line for line in (checked.stdout + checked.stderr).splitlines() if "stereorig" in line]
    assert not problems
    verified = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--threshold=20", str(copy)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert verified.returncode == 0, verified.stdout[-500:]  # an exposure of at most 2.0 of 10


def test_the_container_file_copies_what_there_is_and_runs_what_the_command_line_takes() -> None:
    text = (ROOT / "deploy" / "Containerfile").read_text().replace("\\\n", " ")
    steps = [line.split(maxsplit=1) for line in text.splitlines() if line and not line.startswith("#")]
    ignored = (ROOT / ".containerignore").read_text().splitlines()
    for name, rest in steps:
        if name == "COPY" and "--from" not in rest:
            for source in rest.split()[:-1]:
                assert (ROOT / source).exists(), source
                assert f"!{source.split('/')[0]}" in ignored, source
    assert next(rest for name, rest in steps if name == "USER") == "stereorig"
    words = json.loads(next(rest for name, rest in steps if name == "CMD"))
    args = parsed(words)
    assert args.host == "0.0.0.0"
    assert {"VOLUME", "EXPOSE", "HEALTHCHECK", "STOPSIGNAL"} <= {name for name, _ in steps}
