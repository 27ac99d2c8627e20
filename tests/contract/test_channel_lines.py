"""Channels read as lines of text: over a socket, from a pseudo terminal, through losses and silence."""

from __future__ import annotations

import os
import pty
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import serial

from stereorig.drivers.channels.lines import ChannelLine, LineSource
from tests.support.patience import Deadline

Readings = list[tuple[float, float]]


@contextmanager
def reading(source: LineSource) -> Iterator[tuple[ChannelLine, Readings]]:
    found: Readings = []
    line = ChannelLine(source, lambda time_s, value: found.append((time_s, value)))
    line.start()
    try:
        yield line, found
    finally:
        line.stop()


def until(true: Callable[[], Any], seconds: float = 20.0) -> None:
    deadline = Deadline(seconds)
    while not true():
        assert deadline.left
        time.sleep(0.005)


@contextmanager
def listening(port: int = 0) -> Iterator[tuple[socket.socket, int]]:
    with closing(socket.create_server(("127.0.0.1", port))) as server:
        server.settimeout(20.0)
        yield server, int(server.getsockname()[1])


def test_values_are_stamped_when_they_arrive() -> None:
    with listening() as (server, port), reading(LineSource(name="f", url=f"tcp://127.0.0.1:{port}")) as (line, found):
        link, _ = server.accept()
        with link:
            sent = []
            for k in range(5):
                sent.append(time.monotonic())
                link.sendall(f"{k}.5;ignored\r\n".encode())
                until(lambda k=k: len(found) > k)
                assert found[k][1] == k + 0.5
                # a monotonic clock of one machine: after it was sent, before it was seen here
                assert sent[k] <= found[k][0] <= time.monotonic()
            assert line.state.state == "reading"
            assert line.state.reason == ""
            # of lines in one packet the times but the last one's are not known
            link.sendall(b"7\n8\n9\n")
            until(lambda: line.state.values == 8)
            assert [value for _, value in found[5:]][-1] == 9.0
            link.sendall(b"1.2")
            time.sleep(0.05)
            link.sendall(b"5\n")  # a line in two packets is one
            until(lambda: found[-1][1] == 1.25)


def test_a_line_that_was_lost_is_opened_again() -> None:
    with listening() as (server, port):
        source = LineSource(name="f", url=f"tcp://127.0.0.1:{port}", silence_s=0.2)
        with reading(source) as (line, found):
            first, _ = server.accept()
            first.sendall(b"1\n")
            until(lambda: found)
            first.close()
            until(lambda: line.state.losses == 1)
            second, _ = server.accept()
            with second:
                second.sendall(b"2\n")
                until(lambda: len(found) == 2)
                until(lambda: line.state.state == "silent")
                assert "0.2 s" in line.state.reason


def test_an_address_where_nobody_listens_is_said_and_tried_again() -> None:
    with listening() as (_, port):
        pass
    with reading(LineSource(name="f", url=f"tcp://127.0.0.1:{port}")) as (line, found):
        until(lambda: line.state.reason != "not opened yet")
        assert line.state.state == "unreachable"
        with listening(port) as (server, _):
            link, _ = server.accept()
            with link:
                link.sendall(b"3\n")
                until(lambda: found == [(found[0][0], 3.0)] if found else False)


def test_lines_without_the_number_are_counted_and_left_out() -> None:
    with listening() as (server, port):
        source = LineSource(name="f", url=f"tcp://127.0.0.1:{port}", pattern=r"F=([-+0-9.eE]+) N")
        with reading(source) as (line, found):
            link, _ = server.accept()
            with link:
                for text in (
                    b"hello\n",
                    b"F=nan N\n",
                    b"F=1e999 N\n",
                    b"\xff\xfe\n",
                    b"x" * 5000,
                    b"\nT=3 F=-12.5e1 N\n",
                ):
                    link.sendall(text)
                    time.sleep(0.02)
                until(lambda: found)
                assert found[0][1] == -125.0
                assert line.state.values == 1
                assert line.state.unreadable >= 5


def test_a_serial_instrument_is_asked_at_the_rate() -> None:
    ours, theirs = pty.openpty()
    asked, done = [], threading.Event()

    def instrument() -> None:
        held = b""
        while not done.is_set():
            try:
                held += os.read(ours, 100)
            except OSError:
                return
            *lines, held = held.split(b"\n")
            for text in lines:
                if text.strip() == b"READ?":
                    asked.append(time.monotonic())
                    os.write(ours, f"load, {len(asked)}.25, kN\r\n".encode())

    thread = threading.Thread(target=instrument, daemon=True)
    thread.start()
    source = LineSource(name="f", url=os.ttyname(theirs), column=2, query="READ?", rate_hz=50.0)
    try:
        with reading(source) as (line, found):
            until(lambda: len(found) >= 5)
            assert [value for _, value in found[:5]] == [1.25, 2.25, 3.25, 4.25, 5.25]
            assert line.state.state == "reading"
            # never faster than asked for
            assert asked[4] - asked[0] >= 4 / 50.0 - 0.005
    finally:
        done.set()
        os.close(theirs)
        os.close(ours)


@pytest.mark.parametrize(
    ("line", "column", "value"),
    [("1.5", 1, 1.5), ("1, 2;3\t4", 4, 4.0), (" 7 8", 2, 8.0), ("1", 2, None), ("one", 1, None), ("inf", 1, None)],
)
def test_a_column_is_a_part_between_commas_semicolons_or_blanks(line: str, column: int, value: float | None) -> None:
    found = LineSource(name="f", url="tcp://h:1", column=column).value_of(line)
    assert found == value if value is not None else isinstance(found, str)


COMMA: dict[str, Any] = {"decimal": ","}
THOUSANDS: dict[str, Any] = {"thousands": ","}


@pytest.mark.fault(64)
@pytest.mark.parametrize(
    ("line", "settings", "value"),
    [
        ("ST,GS,-  4.876kg", {"column": 3}, -4.876),
        ("ST,GS,-  4.876kg", {"pattern": r"GS,(.*)kg"}, -4.876),
        ("ST,GS,-  4.876kg", {"pattern": r"([0-9.]+)kg"}, "leaves out the sign"),
        ("ST,-000123.45  g", {"column": 2}, -123.45),
        ("-12,345", {}, "declare decimal"),
        ("-12,345", COMMA, -12.345),
        ("-12,345", THOUSANDS, -12345.0),
        ("12,5;-1234,56;0,002", {"column": 2}, "declare decimal"),
        ("12,5;-1234,56;0,002", {"column": 2, **COMMA}, -1234.56),
        ("1,234.5", {}, "declare decimal"),
        ("1,234.5", {"decimal": "."}, "declare decimal"),
        ("1,234.5", THOUSANDS, 1234.5),
        ("1.234,5", {**COMMA, "thousands": "."}, 1234.5),
        ("1.234,5", COMMA, "declared decimal"),
        ("1 234,5 7", {**COMMA, "thousands": " "}, 1234.5),
        ("12,34,5", THOUSANDS, "not grouped"),
        ("1.5,2.5", {"decimal": ".", "column": 2}, 2.5),
        ("-12.34 lbF", {"scale": 4.4482216152605}, -54.8910547),
        ("+123.456N", {}, 123.456),
        ("4..20 mA 12.0", {"column": 3, "scale": 0.625, "offset": -2.5}, 5.0),
        ("F=12.5", {"pattern": r"F=([0-9]+)"}, "cuts a number"),
        ("id-5 F=7", {"pattern": r"id-([0-9]+)"}, 5.0),
        ("1e3", {}, 1000.0),
        ("12.5.3", {}, "no number"),
    ],
)
def test_a_line_gives_its_number_or_the_reason_but_never_another_number(
    line: str, settings: dict[str, Any], value: float | str
) -> None:
    found = LineSource(name="f", url="tcp://h:1", **settings).value_of(line)
    if isinstance(value, str):
        assert isinstance(found, str)
        assert value in found
    else:
        assert found == pytest.approx(value, rel=1e-8)


@pytest.mark.parametrize(
    ("sent", "settings", "value"),
    [
        (b"F12.5$F13.5$", {"line_end": "$", "pattern": r"F(.*)"}, 13.5),
        (b"-00123\r:", {"line_end": ":", "query": "R", "query_end": "\r"}, -123.0),
    ],
)
def test_lines_end_as_the_instrument_ends_them(sent: bytes, settings: dict[str, Any], value: float) -> None:
    with listening() as (server, port):
        source = LineSource(name="f", url=f"tcp://127.0.0.1:{port}", **settings)
        with reading(source) as (_, found), server.accept()[0] as link:
            if "query" in settings:
                assert link.recv(10).startswith(b"R\r")
            link.sendall(sent)
            until(lambda: found)
            assert found[-1][1] == value


def test_a_serial_port_has_the_frame_of_the_balance(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    true = serial.serial_for_url

    def recorded(_url: str, **options: Any) -> Any:  # a pseudo terminal has 8 bits and no parity, whatever is asked
        asked.append(options)
        port = true("loop://", timeout=0.05)
        port.write(b"ST,-000123.45  g\r\n")
        return port

    monkeypatch.setattr(serial, "serial_for_url", recorded)
    with reading(LineSource(name="f", url="/dev/ttyS9", frame="7E1", column=2)) as (_, found):
        until(lambda: found)
    assert found[0][1] == -123.45
    assert {"bytesize": 7, "parity": "E", "stopbits": 1.0}.items() <= asked[0].items()


def of_program(text: str, **settings: Any) -> LineSource:
    return LineSource(name="f", exec=(sys.executable, "-u", "-c", text), **settings)


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists() or Path(f"/proc/{pid}/stat").read_text().split(")")[-1].split()[0] == "Z"


@pytest.mark.fault(64)
def test_a_program_serves_any_instrument_and_ends_with_the_line() -> None:
    # a shell would expand the star and the variable
    text = "import os, sys, time\nprint(sys.argv[1])\nprint(os.getpid())\ntime.sleep(1000)"
    source = LineSource(name="f", exec=(sys.executable, "-u", "-c", text, "* $HOME"))
    with reading(source) as (line, found):
        until(lambda: found)
        pid = int(found[0][1])
        assert line.state.state == "reading"
        assert line.state.unreadable == 1
    assert gone(pid)


def test_a_program_that_ends_is_started_again_and_says_how_it_ended() -> None:
    with reading(of_program("print(1.5); raise SystemExit(3)")) as (line, found):
        until(lambda: len(found) >= 3)
        assert {value for _, value in found} == {1.5}
        until(lambda: line.state.state == "unreachable")
        assert "status 3" in line.state.reason


def test_a_program_that_is_not_there_is_said_without_its_path() -> None:
    with reading(LineSource(name="f", exec=("/opt/secret/daq",))) as (line, _):
        until(lambda: line.state.reason != "not opened yet")
        assert line.state.state == "unreachable"
        assert line.state.reason == "daq is not there, or is no program"


def test_a_program_is_asked_and_answers() -> None:
    echo = "import sys\nfor n, asked in enumerate(sys.stdin): print(n if asked == 'V\\n' else 'no')"
    with reading(of_program(echo, query="V", rate_hz=100.0)) as (_, found):
        until(lambda: len(found) >= 3)
        # questions that waited while it started are answered together
        assert [value for _, value in found] == sorted({value for _, value in found})


def test_a_program_does_not_outlive_a_killed_service() -> None:
    child = "import os, time; print(os.getpid()); time.sleep(1000)"
    text = (
        "import sys, time\nfrom stereorig.drivers.channels.lines import ChannelLine, LineSource\n"
        f"source = LineSource(name='f', exec=(sys.executable, '-u', '-c', {child!r}))\n"
        "ChannelLine(source, lambda _, value: print(int(value), flush=True)).start(); time.sleep(1000)"
    )
    with subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True) as service:
        assert service.stdout is not None
        pid = int(service.stdout.readline())
        assert not gone(pid)
        service.kill()
    until(lambda: gone(pid))


class FakeTask:
    """The part of nidaqmx.Task that is used, by its documentation."""

    open: ClassVar[list[str]] = []

    def __init__(self) -> None:
        self.ai_channels, self._values = self, iter(float(n) for n in range(1000))
        self._name = ""

    def add_ai_voltage_chan(self, physical_channel: str) -> None:
        if physical_channel != "Dev1/ai0":
            raise RuntimeError("Device cannot be accessed. Status Code: -200220")
        self._name = physical_channel
        self.open.append(physical_channel)

    def start(self) -> None:
        assert self._name

    def read(self) -> float:
        return next(self._values)

    def close(self) -> None:
        if self._name:
            self.open.remove(self._name)


def test_an_analog_input_gives_volts_by_the_two_point_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "nidaqmx", SimpleNamespace(Task=FakeTask))
    source = LineSource(name="f", daq="Dev1/ai0", scale=2500.0, offset=-10.0, rate_hz=50.0)
    with reading(source) as (_, found):
        until(lambda: len(found) >= 5)
        assert [value for _, value in found[:3]] == [-10.0, 2490.0, 4990.0]
        assert found[4][0] - found[0][0] >= 4 / 50.0 - 0.005
        assert FakeTask.open == ["Dev1/ai0"]
    assert FakeTask.open == []
    with reading(LineSource(name="f", daq="Dev2/ai0")) as (line, _):
        until(lambda: "-200220" in line.state.reason)
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with reading(source) as (line, _):
        until(lambda: "nidaqmx is not installed" in line.state.reason)


def test_a_value_is_dated_back_by_the_way_of_line_and_query() -> None:
    with listening() as (server, port):
        source = LineSource(name="f", url=f"tcp://127.0.0.1:{port}", query="V", rate_hz=20.0)
        with reading(source) as (line, found), server.accept()[0] as link:
            for n in range(3):
                assert link.recv(10)
                time.sleep(0.02)
                link.sendall(b"1\n")
                until(lambda n=n: len(found) > n)
            assert line.delay_s >= 0.01  # it was measured between question and answer
