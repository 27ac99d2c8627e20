"""The transcript of the wire: what it holds, how large it grows, what a broken disk or a kill does to it."""

from __future__ import annotations

import ast
import re
import signal
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.registry import open_stage
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.transcript import Transcript
from stereorig.sim.controllers.esp301 import SimESP301
from stereorig.sim.controllers.server import ControllerServer
from tests.support.patience import Deadline
from tests.support.requirements import ROOT
from tests.support.stage_bench import CONTROLLERS, bench

LINE = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6})Z +(\d+\.\d{6}) ([<>!#]) (.*)")


def lines_of(path: Path) -> list[re.Match[str]]:
    found = [LINE.fullmatch(line) for line in path.read_text("ascii").splitlines()]
    assert all(found), path.read_text("ascii")
    return [line for line in found if line]


@pytest.mark.parametrize("driver", CONTROLLERS)
def test_every_byte_in_order_with_time_and_direction(driver: str, tmp_path: Path) -> None:
    record = tmp_path / "wire.txt"
    before = datetime.now(UTC).replace(tzinfo=None)
    with bench(driver, "socket", record=record) as stand:
        stand.stage.position(1)
        stand.stage.stop()
        deadline = Deadline(5.0)
        while not stand.controller.commands("ST"):
            assert deadline.left
            time.sleep(0.002)
        received = [entry.text for entry in stand.controller.received]
    lines = lines_of(record)
    assert lines[0][4].startswith("socket://")
    assert lines[-1][4] == "closed"
    assert all(datetime.fromisoformat(line[1]) >= before for line in lines)
    seconds = [float(line[2]) for line in lines]
    assert seconds == sorted(seconds)
    # what was written is what arrived: the controller's own log is the other witness
    sent = b"".join(ast.literal_eval(line[4]) for line in lines if line[3] in ">!")
    end = {"esp301": b"\r"}.get(driver, b"\r\n")
    assert sent.decode("ascii").split(end.decode())[: len(received)] == received
    assert [line[4] for line in lines if line[3] == "!"] == [repr(2 * (b"ST" + end))]
    assert b"1TP" in sent
    assert any(line[3] == "<" for line in lines)


def test_a_lost_controller_stands_in_the_transcript_in_words(tmp_path: Path) -> None:
    record = tmp_path / "wire.txt"
    with bench("esp301", "socket", record=record) as stand:
        stand.controller.line_faults.deaf = True
        with pytest.raises(StageError):
            stand.stage.position(1)
    assert any(line[3] == "#" and "is silent" in line[4] for line in lines_of(record))


def test_old_lines_go_when_the_limit_is_reached(tmp_path: Path) -> None:
    record = tmp_path / "wire.txt"
    transcript = Transcript(record, "a title", limit_bytes=4000).open()

    def write(n: int) -> None:
        for i in range(300):
            transcript.note(">", f"{n}:{i}".encode())
            time.sleep(0.0002)  # the limit is kept within what other threads write meanwhile

    threads = [threading.Thread(target=write, args=(n,)) for n in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    transcript.note(">", b"last")
    transcript.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wire.txt", "wire.txt.1"]
    assert all(path.stat().st_size < 6000 for path in tmp_path.iterdir())
    assert lines_of(record)[0][4] == "a title"  # each file states what it is
    # nothing is lost between the two files, of which the last line may be the first one's end
    both = [line[4] for name in ("wire.txt.1", "wire.txt") for line in lines_of(tmp_path / name)]
    both = [text for text in both if text != "a title"]
    assert both[-2:] == ["b'last'", "closed"]
    for n in range(3):
        own = [int(text[4:-1]) for text in both if text.startswith(f"b'{n}:")]
        assert own == list(range(own[0], 300)) if own else True


def test_a_transcript_that_cannot_be_written_is_refused_before_anything_moves(tmp_path: Path) -> None:
    with ControllerServer(SimESP301()) as server:
        with pytest.raises(StageError) as caught:
            open_stage("esp301", server.url, {1: AxisOptions()}, record=tmp_path / "no" / "wire.txt")
        assert caught.value.code == "record_unusable"
        assert not server.controller.received


def test_a_full_disk_ends_the_transcript_and_not_the_motion() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("/dev/full is not there: this system cannot pretend a full disk")
    with bench("esp301", "socket", record=full) as stand:
        stand.ready(1)
        assert stand.stage.move_to(1, 2.0).position_mm == pytest.approx(2.0, abs=1e-4)


def test_what_went_out_before_a_kill_stands_in_the_file(tmp_path: Path) -> None:
    record = tmp_path / "wire.txt"
    program = (
        "import sys, time; from pathlib import Path; from stereorig.drivers.registry import open_stage;"
        "from stereorig.drivers.stages.protocol import AxisOptions;"
        "stage = open_stage('esp301', sys.argv[1], {1: AxisOptions()}, record=Path(sys.argv[2]));"
        "stage.position(1); print('asked', flush=True); time.sleep(60)"
    )
    with ControllerServer(SimESP301()) as server:
        child = subprocess.Popen(
            [sys.executable, "-c", program, server.url, str(record)], stdout=subprocess.PIPE, cwd=ROOT
        )
        assert child.stdout is not None
        assert child.stdout.readline() == b"asked\n"
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
        sent = [line[4] for line in lines_of(record) if line[3] == ">"]
        assert sent == [repr(entry.text.encode() + b"\r") for entry in server.controller.received]


def test_serve_refuses_a_transcript_that_cannot_be_written(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "stereorig.server.cli",
            "serve",
            "--port",
            "0",
            "--data",
            str(tmp_path / "data"),
            "--record",
            str(tmp_path / "no" / "wire.txt"),
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 1
    assert "record_unusable" in done.stderr
    assert len(done.stderr.splitlines()) == 1
