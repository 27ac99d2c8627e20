"""Opening what is not there, who holds a port, and many threads on one line."""

from __future__ import annotations

import os
import random
import select
import socket
import struct
import threading
import time

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.registry import open_stage
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.serial_line import SerialLine
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from tests.support.stage_bench import CONTROLLERS, MOVE_WORD, bench


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


@pytest.mark.parametrize("url", ["/dev/no-such-port", "nonsense://x", "socket://127.0.0.1:{port}"])
def test_a_line_that_is_not_there_is_named(url: str) -> None:
    url = url.format(port=free_port())
    with pytest.raises(StageError) as caught:
        open_stage("esp301", url, {1: AxisOptions()})
    assert caught.value.code == "stage_lost"
    assert url in caught.value.cause


def test_a_port_that_another_program_holds_is_named_so() -> None:
    with ControllerServer(SimESP301(), "pty") as server:
        first = SerialLine(server.url, terminator=b"\r", baudrate=9600)
        first.open()
        with pytest.raises(StageError) as caught:
            SerialLine(server.url, terminator=b"\r", baudrate=9600).open()
        assert caught.value.code == "device_busy"
        first.close()


def test_an_unknown_driver_is_refused_with_the_known_ones() -> None:
    with pytest.raises(StageError, match="conex-cc, esp301, kinesis, pi, smc100, standa, xps, zaber") as caught:
        open_stage("agilis", "socket://127.0.0.1:1", {1: AxisOptions()})
    assert caught.value.code == "unknown_driver"


def test_a_line_is_closed_even_if_its_other_side_closed_first() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        line = SerialLine(f"socket://127.0.0.1:{listener.getsockname()[1]}", terminator=b"\r", baudrate=9600)
        line.open()
        far, _ = listener.accept()
        far.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing resets the connection
        far.close()
        near = line._port._socket
        assert select.select([near], [], [], 5.0)[0], "the reset never came"
        line.close()
        assert near.fileno() == -1


def test_a_closed_line_says_so() -> None:
    with ControllerServer(SimESP301()) as server:
        stage = open_stage("esp301", server.url, {1: AxisOptions()})
        stage.close()
        stage.close()
        for call in (lambda: stage.position(1), stage.stop):
            with pytest.raises(StageError, match="closed") as caught:
                call()
            assert caught.value.code == "stage_lost"


def test_a_port_that_another_thread_closes_in_a_read_is_a_lost_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench("esp301", "socket") as stand:
        port = stand.stage._line._port
        assert port is not None

        def closed_meanwhile(size: int) -> bytes:
            port.close()
            return bytes(port._socket.recv(size))  # as pyserial does: the socket is None

        monkeypatch.setattr(port, "read", closed_meanwhile)
        with pytest.raises(StageError) as caught:
            stand.stage.position(1)
        assert caught.value.code == "stage_lost"


def test_noise_without_end_does_not_hold_the_line_forever() -> None:
    with ControllerServer(SimESP301()) as server:
        line = SerialLine(server.url, terminator=b"\r", baudrate=9600, timeout_s=0.2)
        line.open()
        server.controller.line_faults.stray = os.urandom(4000).replace(b"\r", b"x").replace(b"\n", b"x") + b"\r\n"
        assert line.query("VE?", lambda text: text if text.startswith("ESP301") else _refuse()).startswith("ESP301")
        line.close()


def _refuse() -> str:
    raise ValueError("noise")


@pytest.mark.parametrize("driver", CONTROLLERS)
def test_many_threads_and_a_bad_line_never_mix_answers_nor_repeat_a_move(driver: str) -> None:
    with bench(driver, "socket", start_mm=0.0, options={1: AxisOptions(), 2: AxisOptions()}) as stand:
        stand.ready(1, 2)
        stand.stage.move_many({1: 10.0, 2: -10.0})
        before = len(stand.controller.commands(MOVE_WORD))
        done = threading.Event()
        wrong: list[object] = []

        def poll(axis: int, low: float, high: float) -> None:
            while not done.is_set():
                mm = stand.stage.position(axis)
                if not low <= mm <= high:
                    wrong.append((axis, mm))

        def disturb() -> None:
            dice = random.Random(3)
            while not done.wait(0.6):  # seldom enough that a question is hit once, not again when repeated
                fault = dice.choice(["lose_replies", "halve_replies", "garble_replies"])
                setattr(stand.controller.line_faults, fault, 1)

        threads = [
            threading.Thread(target=poll, args=(1, 9.9, 20.1)),
            threading.Thread(target=poll, args=(2, -20.1, -9.9)),
            threading.Thread(target=disturb),
        ]
        for thread in threads:
            thread.start()
        moves = 0
        end = time.monotonic() + 2.5
        try:
            while time.monotonic() < end:
                stand.stage.move_to(1, 10.0 + moves % 10)
                stand.stage.move_to(2, -10.0 - moves % 10)
                moves += 1
        finally:
            done.set()
            for thread in threads:
                thread.join()
        assert not wrong
        assert moves > 2
        assert len(stand.controller.commands(MOVE_WORD)) == before + 2 * moves
