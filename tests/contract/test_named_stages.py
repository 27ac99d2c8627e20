"""One suite over the drivers whose controllers are not simulated by the product: XPS."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.registry import make_stage
from stereorig.drivers.stages.protocol import AxisOptions, AxisState, Stage
from stereorig.drivers.stages.serial_stage import SerialStage
from tests.support.fake_xps import FakeXPS
from tests.support.patience import within
from tests.support.stage_bench import in_thread, wait_for_its_turn, wait_until


class Stand:
    """A controller, and the opened driver of its axes 1 and 2."""

    def __init__(self, driver: str, *, slow: bool = False, options: dict[int, AxisOptions] | None = None) -> None:
        self.driver = driver
        self.fake = FakeXPS(time_scale=1.0 if slow else 50.0, start_mm=3.0)
        self.options = options or {1: AxisOptions(), 2: AxisOptions()}
        self.stage: SerialStage = self.another()

    def another(self) -> SerialStage:
        self.stage = make_stage(self.driver, self.fake.url, self.options, timeout_s=0.3)
        self.stage.open()
        return self.stage

    def axis(self, number: int) -> Any:
        return self.fake.axes[f"Group{number}"]

    def ready(self, *axes: int) -> None:
        for axis in axes:
            self.stage.enable(axis)
            self.stage.home(axis)

    def close(self) -> None:
        self.stage.close()
        self.fake.close()


@pytest.fixture(params=["xps"])
def driver(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def stand(driver: str) -> Iterator[Stand]:
    made = Stand(driver)
    yield made
    made.close()


@pytest.fixture
def slow(driver: str) -> Iterator[Stand]:
    made = Stand(driver, slow=True)
    yield made
    made.close()


def code(call: Any) -> str:
    with pytest.raises(StageError) as caught:
        call()
    return caught.value.code


def test_the_driver_is_a_stage_and_names_the_controller(stand: Stand) -> None:
    assert isinstance(stand.stage, Stage)
    identity = stand.stage.identify()
    assert (identity.model, identity.firmware) == ("XPS-D", "V1.4.1")
    assert [(axis.axis, axis.model) for axis in identity.axes] == [(1, "ILS100CC"), (2, "ILS100CC")]


def test_nothing_moves_before_it_is_enabled_and_homed(stand: Stand) -> None:
    assert code(lambda: stand.stage.move_to(1, 1.0)) == "not_homed"
    assert code(lambda: stand.stage.home(1)) == "motor_off"
    stand.stage.enable(1)
    assert code(lambda: stand.stage.move_to(1, 1.0)) == "not_homed"
    assert stand.stage.home(1) == pytest.approx(0.0, abs=1e-4)
    assert stand.axis(1).true_position_mm() == pytest.approx(0.0, abs=1e-6)
    assert stand.stage.state(1).state is AxisState.READY


def test_moves_end_where_they_should_and_homing_again_goes_to_zero(stand: Stand) -> None:
    stand.ready(1, 2)
    results = stand.stage.move_many({1: 5.12344, 2: -3.0})
    assert results[1].position_mm == pytest.approx(5.12344, abs=1e-4)
    assert stand.axis(1).true_position_mm() == pytest.approx(5.12344, abs=1e-6)
    assert stand.stage.move_by(2, -1.0).position_mm == pytest.approx(-4.0, abs=1e-4)
    assert stand.stage.home(1) == pytest.approx(0.0, abs=1e-4)


def test_a_target_outside_or_no_number_sends_nothing(stand: Stand) -> None:
    stand.ready(1)
    before = len(stand.fake.words("GroupMove"))
    for target in (math.nan, 51.0, True, "5"):
        assert code(lambda target=target: stand.stage.move_to(1, target)) == "out_of_limits"
    assert len(stand.fake.words("GroupMove")) == before


def test_motors_are_switched_off_and_on_again_without_losing_the_reference(stand: Stand) -> None:
    stand.ready(1)
    stand.stage.disable(1)
    assert stand.stage.state(1).state is AxisState.MOTOR_OFF
    assert code(lambda: stand.stage.move_to(1, 1.0)) == "motor_off"
    stand.stage.enable(1)
    assert stand.stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)


def test_a_stop_comes_through_beside_a_move_that_runs(slow: Stand) -> None:
    def stopped_after_s() -> float:
        slow.ready(1)
        thread, errors = in_thread(lambda: slow.stage.move_to(1, 40.0))
        wait_until(lambda: slow.axis(1).velocity_now_mm_s > 5)
        asked = time.monotonic()
        slow.stage.stop()

        def arrived() -> list[float]:
            return [at for at, text in slow.fake.received if at > asked and text == "GroupMoveAbort(Group1)"]

        wait_until(arrived)
        thread.join(5.0)
        assert [error.code for error in errors] == ["stage_stopped"]
        assert not slow.axis(1).moving
        rest_mm = slow.axis(1).true_position_mm()
        assert slow.stage.state(1).homed
        assert slow.stage.move_to(1, 0.5).position_mm == pytest.approx(0.5, abs=1e-4)
        return arrived()[0] - asked if rest_mm < 10.0 else math.inf

    within(0.05, stopped_after_s)


def test_many_stops_in_a_row_all_arrive(slow: Stand) -> None:
    slow.ready(1)
    thread, _ = in_thread(lambda: slow.stage.move_to(1, 40.0))
    wait_until(lambda: slow.axis(1).velocity_now_mm_s > 5)
    for _ in range(6):  # more than there are spare connections, while the first ones wait for the axis to rest
        slow.stage.stop(1)
    wait_until(lambda: len(slow.fake.words("GroupMoveAbort(Group1)")) >= 6)
    thread.join(5.0)
    assert all(text.count("(") == 1 for _, text in slow.fake.received)  # none was glued to another one


def test_a_stop_during_the_search_for_home_ends_it_and_the_axis_is_not_homed(slow: Stand) -> None:
    slow.axis(1).define_position(-30.0)
    slow.axis(1)._motor_mm = slow.axis(1)._load_mm = 30.0
    slow.stage.enable(1)
    thread, errors = in_thread(lambda: slow.stage.home(1))
    wait_until(lambda: slow.fake.states["Group1"] == 43)
    slow.stage.stop(1)
    thread.join(5.0)
    assert [error.code for error in errors] == ["stage_stopped"]
    assert not slow.axis(1).moving
    assert not slow.stage.state(1).homed
    assert "GroupKill(Group1)" in slow.fake.words("GroupKill")


def test_a_stop_voids_a_motion_that_waits_and_leaves_other_axes_alone(slow: Stand) -> None:
    slow.ready(1, 2)
    first, first_errors = in_thread(lambda: slow.stage.move_to(1, 20.0))
    wait_until(lambda: slow.axis(1).velocity_now_mm_s > 1)
    second, second_errors = in_thread(lambda: slow.stage.move_to(2, 20.0))
    wait_for_its_turn(second)
    slow.stage.stop(2)
    first.join(10.0)
    second.join(10.0)
    assert not first_errors
    assert [error.code for error in second_errors] == ["stage_stopped"]
    assert not [text for text in slow.fake.words("GroupMoveAbsolute(Group2") if "20" in text]


@pytest.mark.parametrize("order", ["stop first", "stop overtakes", "move first"])
def test_whichever_comes_first_of_stop_and_move_the_axis_rests(
    slow: Stand, order: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow.ready(1)
    send = slow.stage._send_move
    if order == "stop overtakes":  # motion and stop have a connection each
        link = slow.stage._line._moves["Group1"]  # type: ignore[attr-defined]
        at_once = link.send

        def late(function: str) -> None:
            link.function = function
            threading.Timer(0.2, at_once, (function,)).start()

        monkeypatch.setattr(link, "send", late)

    def race(axis: int, position_mm: float) -> None:
        if order != "move first":
            slow.stage.stop()
        send(axis, position_mm)
        if order == "move first":
            slow.stage.stop()

    monkeypatch.setattr(slow.stage, "_send_move", race)
    assert code(lambda: slow.stage.move_to(1, 40.0)) == "stage_stopped"
    wait_until(lambda: not slow.axis(1).moving)
    assert slow.axis(1).true_position_mm() < 5.0


@pytest.mark.fault(54)
@pytest.mark.parametrize("search", [False, True])
def test_another_process_stops_what_moves_by_the_last_words_when_this_one_is_gone(slow: Stand, search: bool) -> None:
    slow.stage.enable(1)
    if search:
        slow.axis(1)._motor_mm = slow.axis(1)._load_mm = 30.0
    else:
        slow.stage.home(1)
    thread, errors = in_thread(lambda: slow.stage.home(1) if search else slow.stage.move_to(1, 40.0))
    wait_until(lambda: slow.axis(1).velocity_now_mm_s != 0)
    words = slow.stage.last_words()
    assert len(words) == 2  # a connection for each group
    script = "import os, sys\nfor word in sys.argv[1:]:\n fd, text = word.split('=')\n os.write(int(fd), text.encode())"
    given = [f"{descriptor}={text.decode()}" for descriptor, text in words]
    subprocess.run([sys.executable, "-c", script, *given], pass_fds=[fd for fd, _ in words], check=True)
    for descriptor, _ in words:
        os.close(descriptor)
    wait_until(lambda: not slow.axis(1).moving)
    assert slow.fake.states["Group1"] == 7
    thread.join(5.0)
    assert len(errors) == 1


def test_positions_are_read_beside_a_move(slow: Stand) -> None:
    slow.ready(1)
    thread, errors = in_thread(lambda: slow.stage.move_to(1, 10.0))
    seen = []
    while thread.is_alive():
        seen.append(slow.stage.position(1))
        slow.stage.state(1)
    assert not errors
    assert seen == sorted(seen)
    assert len({round(mm) for mm in seen}) > 3


def test_a_following_error_is_a_motion_fault_in_the_controllers_words(stand: Stand) -> None:
    stand.ready(1)
    stand.axis(1).faults.jam_mm = (-5.0, 2.0)
    with pytest.raises(StageError, match=r"[Ff]ollowing error") as caught:
        stand.stage.move_to(1, 8.0)
    assert caught.value.code == "motion_fault"
    assert stand.stage.state(1).state is AxisState.MOTOR_OFF


def test_velocities_are_set_read_back_and_refused(driver: str) -> None:
    stand = Stand(driver, options={1: AxisOptions(velocity_mm_s=2.5, acceleration_mm_s2=12.0)})
    try:
        assert stand.axis(1).velocity_mm_s == 2.5
        stand.ready(1)
        taken = stand.stage.set_dynamics(1, velocity_mm_s=3.0)
        assert (taken.velocity_mm_s, taken.acceleration_mm_s2, taken.max_velocity_mm_s) == (3.0, 12.0, 40.0)
        assert code(lambda: stand.stage.set_dynamics(1, velocity_mm_s=41.0)) == "out_of_range"
    finally:
        stand.close()


def test_closing_stops_what_this_driver_moves(slow: Stand) -> None:
    slow.ready(1)
    thread, errors = in_thread(lambda: slow.stage.move_to(1, 40.0))
    wait_until(lambda: slow.axis(1).velocity_now_mm_s > 1)
    slow.stage.close()
    thread.join(5.0)
    assert len(errors) == 1
    wait_until(lambda: not slow.axis(1).moving)
    assert slow.axis(1).true_position_mm() < 20.0


def test_a_lost_controller_is_named_and_found_again_homed_as_it_is(stand: Stand) -> None:
    stand.ready(1)

    def lost_after_s() -> float:
        stand.fake.silent = True
        start = time.monotonic()
        assert code(lambda: stand.stage.position(1)) == "stage_lost"
        seconds = time.monotonic() - start
        stand.fake.silent = False
        assert stand.stage.position(1) == pytest.approx(0.0, abs=1e-4)
        return seconds

    within(2.0, lost_after_s)
    stand.fake.hang_up()
    stand.stage.reconnect()
    assert stand.stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)


def test_a_motion_that_an_earlier_program_left_is_stopped_at_opening(slow: Stand) -> None:
    slow.ready(1)
    slow.stage.close()
    threading.Thread(target=slow.fake.answer, args=("GroupMoveAbsolute(Group1.Pos,40)",), daemon=True).start()
    wait_until(lambda: slow.axis(1).velocity_now_mm_s > 1)
    stage = slow.another()
    assert not slow.axis(1).moving
    assert [message.code for message in stage.errors()] == ["opened_moving"]


def test_abort_stops_and_switches_the_motors_off(slow: Stand) -> None:
    slow.ready(1)
    thread, errors = in_thread(lambda: slow.stage.move_to(1, 40.0))
    wait_until(lambda: slow.axis(1).velocity_now_mm_s > 5)
    slow.stage.abort()
    thread.join(5.0)
    assert [error.code for error in errors] == ["stage_stopped"]
    assert not slow.stage.state(1).motor_on


def test_an_axis_that_counts_in_degrees_is_refused() -> None:
    fake = FakeXPS(unit="deg")
    try:
        stage = make_stage("xps", fake.url, {1: AxisOptions()})
        assert code(stage.open) == "unit_not_length"
    finally:
        fake.close()
