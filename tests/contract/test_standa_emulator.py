"""The Standa driver over the maker's own library and emulator: steps, stops, and the end of processes.

The emulator moves in real time, and has no home switch: a search for home fails there.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.registry import make_stage
from stereorig.drivers.stages.makers.standa import StandaStage
from stereorig.drivers.stages.protocol import AxisOptions, AxisState, Stage
from tests.support.patience import Deadline, busy
from tests.support.requirements import ROOT, missing

# 1,000 steps a second: 10 mm/s
OPTION = AxisOptions(soft_limits_mm=(-100.0, 100.0), mm_per_step=0.01, assume_homed=True)


@pytest.fixture
def url(tmp_path: Path) -> str:
    if importlib.util.find_spec("libximc") is None:
        missing("libximc (pip install 'stereorig[standa]')")
    return f"xi-emu:///{tmp_path}/controller.bin"


def opened(url: str, option: AxisOptions = OPTION) -> StandaStage:
    stage = make_stage("standa", url, {1: option})
    assert isinstance(stage, StandaStage)
    stage.open()
    return stage


@pytest.fixture
def stage(url: str) -> Iterator[StandaStage]:
    made = opened(url)
    yield made
    made.close()


def code(call: Callable[[], Any]) -> str:
    with pytest.raises(StageError) as caught:
        call()
    return caught.value.code


def moving(stage: StandaStage, target_mm: float) -> tuple[threading.Thread, list[str]]:
    """A move in another thread that is under way."""
    errors: list[str] = []

    def run() -> None:
        try:
            stage.move_to(1, target_mm)
        except StageError as error:
            errors.append(error.code)

    thread = threading.Thread(target=run)
    thread.start()
    while not stage.state(1).moving:
        time.sleep(0.002)
    return thread, errors


def test_the_emulated_controller_is_a_stage_with_the_limits_of_the_rig_file(stage: StandaStage) -> None:
    assert isinstance(stage, Stage)
    identity = stage.identify()
    assert (identity.driver, identity.model) == ("standa", "XIMC XISM-USB")
    assert (stage.limits(1).low_mm, stage.limits(1).high_mm) == (-100.0, 100.0)
    assert stage.dynamics(1).velocity_mm_s == pytest.approx(10.0)


def test_moves_are_read_back_to_a_part_of_a_step_on_both_sides_of_zero(stage: StandaStage) -> None:
    for target in (1.23456, -0.98765, 0.0):
        assert stage.move_to(1, target).position_mm == pytest.approx(target, abs=0.01 / 256)
    assert stage.move_by(1, -0.5).position_mm == pytest.approx(-0.5, abs=0.01 / 256)
    assert code(lambda: stage.move_to(1, 100.5)) == "out_of_limits"


def test_an_axis_that_was_not_homed_does_not_move_and_a_search_that_finds_nothing_is_a_fault(url: str) -> None:
    stage = opened(url, AxisOptions(soft_limits_mm=(-100.0, 100.0), mm_per_step=0.01))
    try:
        assert stage.state(1).state is AxisState.NOT_HOMED
        assert code(lambda: stage.move_to(1, 1.0)) == "not_homed"
        assert code(lambda: stage.home(1)) == "motion_fault"
    finally:
        stage.close()


@pytest.mark.parametrize(
    "option", [AxisOptions(soft_limits_mm=(-1.0, 1.0)), AxisOptions(mm_per_step=0.01)], ids=["no length", "no limits"]
)
def test_steps_without_a_length_and_travel_without_limits_are_refused(url: str, option: AxisOptions) -> None:
    expected = "unit_not_length" if option.mm_per_step is None else "out_of_limits"
    assert code(lambda: opened(url, option)) == expected


def test_a_stop_comes_through_beside_a_move_that_runs(stage: StandaStage) -> None:
    thread, errors = moving(stage, 100.0)
    asked = time.monotonic()
    stage.stop()
    while stage.state(1).moving:
        assert time.monotonic() - asked < 3.0 * busy()
    rest = stage.position(1)
    thread.join(5.0)
    assert errors == ["stage_stopped"]
    assert stage.position(1) == rest < 50.0
    assert stage.move_to(1, rest - 0.1).position_mm == pytest.approx(rest - 0.1, abs=0.01)


def test_a_stop_is_carried_out_while_a_call_of_the_library_hangs(stage: StandaStage, tmp_path: Path) -> None:
    """The library's own waiting for rest blocks the channel of calls; the stop has one of its own."""
    stage._line.call("command_move", 10000, 0)
    waiting = threading.Thread(target=lambda: stage._line.call("command_wait_for_stop", 10))
    waiting.start()
    time.sleep(0.2)
    assert waiting.is_alive()
    stage.stop()
    waiting.join(2.0)
    assert not waiting.is_alive()
    assert 0.0 < stage.position(1) < 50.0


@pytest.mark.parametrize("first", ["stop", "move"])
def test_whichever_comes_first_of_stop_and_move_the_axis_rests(
    stage: StandaStage, first: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = stage._send_move

    def race(axis: int, position_mm: float) -> None:
        if first == "stop":
            stage.stop()
        send(axis, position_mm)
        if first == "move":
            stage.stop()

    monkeypatch.setattr(stage, "_send_move", race)
    assert code(lambda: stage.move_to(1, 100.0)) == "stage_stopped"
    assert not stage.state(1).moving
    assert stage.position(1) < 5.0


@pytest.mark.fault(54)
def test_another_process_stops_the_axis_by_the_last_words(stage: StandaStage) -> None:
    thread, errors = moving(stage, 100.0)
    [(descriptor, word)] = stage.last_words()
    script = f"import os; os.write({descriptor}, {word!r})"
    subprocess.run([sys.executable, "-c", script], pass_fds=[descriptor], check=True)
    os.close(descriptor)
    thread.join(5.0)
    assert errors == ["motion_fault"]  # it rests, and not at its goal
    assert stage.position(1) < 50.0


@pytest.mark.fault(54)
def test_the_axis_is_stopped_when_the_process_of_the_driver_is_killed(url: str) -> None:
    script = f"""
import time
from tests.contract.test_standa_emulator import moving, opened
stage = opened({url!r})
moving(stage, 100.0)
print(stage._line._process.pid, flush=True)
time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, cwd=ROOT) as program:
        assert program.stdout is not None
        library = int(program.stdout.readline())
        os.kill(program.pid, signal.SIGKILL)
    deadline = Deadline(5.0)
    while Path(f"/proc/{library}/status").exists() and "zombie" not in Path(f"/proc/{library}/status").read_text():
        assert deadline.left, "the library's process goes on"
        time.sleep(0.01)
    stage = opened(url)  # the emulator keeps its position in the file when it is closed
    try:
        assert 0.0 < stage.position(1) < 50.0
        assert not stage.state(1).moving
    finally:
        stage.close()


def test_closing_stops_the_axis(url: str) -> None:
    stage = opened(url)
    thread, errors = moving(stage, 100.0)
    stage.close()
    thread.join(5.0)
    assert len(errors) == 1
    again = opened(url)
    assert 0.0 < again.position(1) < 50.0
    again.close()


def test_velocities_are_set_and_read_back(url: str) -> None:
    stage = opened(url, AxisOptions(soft_limits_mm=(-4.0, 4.0), mm_per_step=0.01, velocity_mm_s=2.505))
    try:
        assert stage.dynamics(1).velocity_mm_s == pytest.approx(2.505, abs=0.01 / 256)
        assert stage.set_dynamics(1, acceleration_mm_s2=5.0).acceleration_mm_s2 == pytest.approx(5.0)
        assert code(lambda: stage.set_dynamics(1, velocity_mm_s=51.0)) == "out_of_range"  # its nominal speed is 50
    finally:
        stage.close()


def test_a_motor_that_was_switched_off_stays_off_until_it_is_enabled(stage: StandaStage) -> None:
    stage.abort()
    assert stage.state(1).state is AxisState.MOTOR_OFF
    assert code(lambda: stage.move_to(1, 1.0)) == "motor_off"
    stage.enable(1)
    assert stage.move_to(1, 0.1).position_mm == pytest.approx(0.1, abs=0.01)


def test_a_library_that_died_is_a_loss_and_is_started_again(stage: StandaStage) -> None:
    assert stage._line._process is not None
    stage._line._process.kill()
    assert code(lambda: stage.position(1)) == "stage_lost"
    stage.reconnect()
    assert stage.move_to(1, 0.1).position_mm == pytest.approx(0.1, abs=0.01)


def test_a_controller_that_is_not_there_is_lost(url: str) -> None:
    stage = make_stage("standa", "xi-com:///dev/ttyNONE7", {1: OPTION})
    assert code(stage.open) == "stage_lost"
    assert not stage.is_open
