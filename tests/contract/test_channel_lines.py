"""Channels read as lines of text: over a socket, from a pseudo terminal, through losses and silence."""

from __future__ import annotations

import os
import pty
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest

from drivers.channels.lines import ChannelLine, LineSource

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
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
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
    assert LineSource(name="f", url="tcp://h:1", column=column).value_of(line) == value
