"""One suite over every stage driver, against its simulated controller, over a socket and over a pty."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.stages.protocol import AxisOptions, AxisState, AxisStatus, Stage
from tests.support.patience import within
from tests.support.stage_bench import (
    CONTROLLERS,
    FAKES,
    Bench,
    Transport,
    bench,
    in_thread,
    wait_for_its_turn,
    wait_until,
)

KINDS: list[tuple[str, Transport]] = [
    ("esp301", "socket"),
    ("esp301", "pty"),
    ("smc100", "socket"),
    ("smc100", "pty"),
    ("conex-cc", "pty"),
    ("pi", "socket"),
    ("zaber", "socket"),
    ("zaber", "pty"),
]


def _param(kind: tuple[str, Transport]) -> Any:
    """A driver that a socket has tried is tried over a pty in depth only; a pty is tried with the CONEX-CC."""
    tried = kind[1] == "pty" and (kind[0], "socket") in KINDS
    return pytest.param(kind, id="-".join(kind), marks=[pytest.mark.deep] if tried else [])


@pytest.fixture(params=[_param(kind) for kind in KINDS])
def kind(request: pytest.FixtureRequest) -> tuple[str, Transport]:
    return request.param


@pytest.fixture
def stand(kind: tuple[str, Transport]) -> Iterator[Bench]:
    with bench(*kind) as made:
        yield made


@pytest.fixture
def homed(stand: Bench) -> Bench:
    stand.ready(1, 2)
    return stand


def code_of(caught: pytest.ExceptionInfo[StageError]) -> str:
    return caught.value.code


def test_the_driver_is_a_stage_and_says_who_answers(stand: Bench) -> None:
    assert isinstance(stand.stage, Stage)
    identity = stand.stage.identify()
    assert identity.model
    assert identity.firmware
    assert [axis.axis for axis in identity.axes] == [1, 2]
    assert all(axis.model for axis in identity.axes)


def test_moving_before_homing_is_refused_and_nothing_moves(stand: Bench) -> None:
    with pytest.raises(StageError) as caught:
        stand.stage.move_to(1, 1.0)
    assert code_of(caught) == "not_homed"
    assert not stand.sent("move")


def test_moving_with_the_motor_off_is_refused(homed: Bench) -> None:
    homed.stage.disable(1)
    assert homed.stage.state(1).state is AxisState.MOTOR_OFF
    with pytest.raises(StageError) as caught:
        homed.stage.move_to(1, 1.0)
    assert code_of(caught) == "motor_off"
    assert not homed.sent("move")
    homed.stage.enable(1)
    assert homed.stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)


def test_homing_makes_the_controllers_zero_the_true_zero(stand: Bench) -> None:
    assert stand.controller.true_position_mm(1) == pytest.approx(3.0)
    assert not stand.stage.state(1).homed
    stand.ready(1)
    status = stand.stage.state(1)
    assert status.state is AxisState.READY
    assert status.homed
    assert status.position_mm == pytest.approx(0.0, abs=1e-4)
    assert stand.controller.true_position_mm(1) == pytest.approx(0.0, abs=1e-9)


def test_a_move_returns_what_was_read_back_and_is_true(homed: Bench) -> None:
    result = homed.stage.move_to(1, 5.12344)
    assert result.target_mm == 5.12344
    assert result.position_mm != result.target_mm  # the encoder has steps of 0.1 um
    assert result.position_mm == pytest.approx(5.12344, abs=1e-4)
    assert homed.controller.true_position_mm(1) == pytest.approx(5.12344, abs=homed.step_mm)
    assert homed.stage.move_by(1, -2.0).position_mm == pytest.approx(3.1234, abs=1e-4)
    assert homed.stage.position(2) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("side", ["below", "above"])
def test_one_sided_arrival_takes_up_the_backlash_from_either_direction(kind: tuple[str, Transport], side: str) -> None:
    option = AxisOptions(backlash_mm=0.05, approach_from="below" if side == "below" else "above")
    with bench(*kind, options={1: option, 2: AxisOptions()}) as stand:
        stand.ready(1, 2)
        for axis in (1, 2):
            stand.axis(axis).faults.backlash_mm = 0.03
        true = []
        for away in (2.0, 6.0):
            for axis in (1, 2):
                stand.stage.move_to(axis, away)
                stand.stage.move_to(axis, 4.0)
            true.append([stand.controller.true_position_mm(axis) for axis in (1, 2)])
    # axis 1 with the option arrives at one position; axis 2 without it shows that the lost motion is there
    assert true[0][0] == pytest.approx(true[1][0], abs=1e-6)
    assert true[1][1] - true[0][1] == pytest.approx(0.03, abs=1e-6)


def test_two_axes_move_at_the_same_time(kind: tuple[str, Transport]) -> None:
    with bench(*kind, time_scale=10.0) as stand:
        stand.ready(1, 2)
        results = stand.stage.move_many({1: 15.0, 2: -10.0})
        sent = [entry.at_s for entry in stand.sent("move")]
    # 15 mm at 10 mm/s and ten times real time take 0.175 s
    assert sent[1] - sent[0] < 0.1
    assert results[1].duration_s >= 0.17
    assert [results[axis].position_mm for axis in (1, 2)] == pytest.approx([15.0, -10.0], abs=1e-4)


def test_a_target_that_is_no_place_to_go_is_refused_before_any_byte(homed: Bench) -> None:
    before = len(homed.controller.received)
    for target in (math.nan, math.inf, -math.inf, 50.5, -1e308, True, "5", None, [1.0]):
        for call in (
            lambda target=target: homed.stage.move_to(1, target),
            lambda target=target: homed.stage.move_many({2: 1.0, 1: target}),
        ):
            with pytest.raises(StageError) as caught:
                call()
            assert code_of(caught) == "out_of_limits", target
    assert len(homed.controller.received) == before


def test_a_relative_move_out_of_limits_or_by_nan_does_not_start(homed: Bench) -> None:
    for distance in (math.nan, math.inf, 51.0):
        with pytest.raises(StageError) as caught:
            homed.stage.move_by(1, distance)
        assert code_of(caught) == "out_of_limits"
    assert not homed.sent("move")


def test_soft_limits_only_tighten_the_controllers(kind: tuple[str, Transport]) -> None:
    option = AxisOptions(soft_limits_mm=(-200.0, 4.0), backlash_mm=0.5, approach_from="above")
    with bench(*kind, options={1: option}) as stand:
        limits = stand.stage.limits(1)
        assert (limits.low_mm, limits.high_mm) == pytest.approx((-50.0, 4.0), abs=stand.step_mm)
        assert (limits.controller_low_mm, limits.controller_high_mm) == pytest.approx((-50.0, 50.0), abs=stand.step_mm)
        stand.ready(1)
        # 3.8 mm itself is allowed, but from above only by a detour over 4.3 mm
        with pytest.raises(StageError) as caught:
            stand.stage.move_to(1, 3.8)
        assert code_of(caught) == "out_of_limits"
        assert not stand.sent("move")


def test_an_unknown_axis_is_named(homed: Bench) -> None:
    for call in (homed.stage.position, homed.stage.home, homed.stage.enable, homed.stage.stop):
        with pytest.raises(StageError) as caught:
            call(7)
        assert code_of(caught) == "invalid_axis"


def test_stop_reaches_the_wire_at_once_while_another_thread_waits_in_a_move(kind: tuple[str, Transport]) -> None:
    def stopped_after_s() -> float:
        with bench(*kind, time_scale=1.0, start_mm=0.0, acceleration_mm_s2=200.0) as stand:
            stand.ready(1)
            thread, errors = in_thread(lambda: stand.stage.move_to(1, 40.0))
            wait_until(lambda: stand.axis(1).velocity_now_mm_s > 5)
            asked = time.monotonic()
            stand.stage.stop()
            thread.join(5.0)
            assert [error.code for error in errors] == ["stage_stopped"]
            assert not stand.stage.state(1).moving
            rest_mm = stand.stage.position(1)
            assert rest_mm > 0.0
            # and it is usable afterwards
            assert stand.stage.move_to(1, 0.5).position_mm == pytest.approx(0.5, abs=1e-4)
            return stand.sent("stop")[0].at_s - asked if rest_mm < 10.0 else math.inf

    within(0.05, stopped_after_s)


def test_stop_does_not_wait_for_a_query_in_flight(kind: tuple[str, Transport]) -> None:
    def stopped_after_s() -> float:
        with bench(*kind) as stand:
            stand.controller.line_faults.silent = True
            thread, errors = in_thread(lambda: stand.stage.position(1))
            wait_until(lambda: stand.sent("position", 1))
            asked = time.monotonic()
            stand.stage.stop(1)
            wait_until(lambda: stand.sent("stop", 1))
            thread.join(5.0)
            assert [error.code for error in errors] == ["stage_lost"]
            return stand.sent("stop", 1)[0].at_s - asked

    within(0.05, stopped_after_s)


def test_a_stop_voids_a_motion_that_still_waits_for_its_turn(kind: tuple[str, Transport]) -> None:
    with bench(*kind, time_scale=1.0, start_mm=0.0) as stand:
        stand.ready(1, 2)
        first, first_errors = in_thread(lambda: stand.stage.move_to(1, 40.0))
        wait_until(lambda: stand.sent("move", 1))
        second, second_errors = in_thread(lambda: stand.stage.move_to(2, 40.0))
        wait_for_its_turn(second)
        stand.stage.stop()
        first.join(5.0)
        second.join(5.0)
        assert [error.code for error in first_errors + second_errors] == ["stage_stopped", "stage_stopped"]
        assert not stand.sent("move", 2)
        assert stand.controller.true_position_mm(2) == 0.0


@pytest.mark.parametrize("first", ["stop", "move"])
def test_whichever_of_stop_and_move_is_first_on_the_wire_the_axis_stands_still(
    kind: tuple[str, Transport], first: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench(*kind, time_scale=1.0, start_mm=0.0) as stand:
        stand.ready(1)
        send = stand.stage._send_move

        def race(axis: int, position_mm: float) -> None:
            if first == "stop":
                stand.stage.stop()
            send(axis, position_mm)
            if first == "move":
                stand.stage.stop()

        monkeypatch.setattr(stand.stage, "_send_move", race)
        with pytest.raises(StageError) as caught:
            stand.stage.move_to(1, 40.0)
        assert code_of(caught) == "stage_stopped"
        assert stand.sent("move")
        wait_until(lambda: not stand.axis(1).moving)
        assert stand.controller.true_position_mm(1) < 5.0


def test_stopping_one_axis_leaves_the_other_moving(kind: tuple[str, Transport]) -> None:
    with bench(*kind, time_scale=10.0, start_mm=0.0) as stand:
        stand.ready(1, 2)
        thread, errors = in_thread(lambda: stand.stage.move_to(1, 20.0))
        wait_until(lambda: stand.axis(1).velocity_now_mm_s > 1)
        stand.stage.stop(2)
        thread.join(5.0)
        assert not errors
        assert stand.stage.position(1) == pytest.approx(20.0, abs=1e-4)


def test_stop_ends_homing_and_the_axis_counts_as_not_homed(kind: tuple[str, Transport]) -> None:
    with bench(*kind, time_scale=1.0, start_mm=30.0) as stand:
        stand.stage.enable(1)
        thread, errors = in_thread(lambda: stand.stage.home(1))
        wait_until(lambda: stand.axis(1).velocity_now_mm_s != 0)
        stand.stage.stop(1)
        thread.join(5.0)
        assert [error.code for error in errors] == ["stage_stopped"]
        assert not stand.stage.state(1).homed


def test_a_stop_between_a_question_and_its_answer_is_a_stop_and_no_fault(
    kind: tuple[str, Transport], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Homing has just been seen to go on when the stop comes; the next answer states that the axis is at rest."""
    with bench(*kind, time_scale=1.0, start_mm=30.0) as stand:
        stand.stage.enable(1)
        read = stand.stage._read_status

        def stopped_first(axis: int) -> AxisStatus:
            if stand.axis(1).velocity_now_mm_s != 0:
                stand.stage.stop(1)
                wait_until(lambda: stand.axis(1).velocity_now_mm_s == 0)
            return read(axis)

        monkeypatch.setattr(stand.stage, "_read_status", stopped_first)
        with pytest.raises(StageError) as caught:
            stand.stage.home(1)
        assert code_of(caught) == "stage_stopped"


@pytest.mark.fault(25)
def test_a_disturbed_reply_is_flushed_and_asked_for_once_more(homed: Bench) -> None:
    homed.stage.move_to(1, 7.25)
    for fault, value in (
        ("stray", b"\0"),
        ("stray", b"\0\xff\x00noise\r\n\0"),
        ("stray", b"\r\n\r\n"),
        ("lose_replies", 1),
        ("halve_replies", 1),
        ("garble_replies", 1),
    ):
        before = len(homed.sent("position", 1))
        setattr(homed.controller.line_faults, fault, value)
        assert homed.stage.position(1) == pytest.approx(7.25, abs=1e-4), (fault, value)
        assert len(homed.sent("position", 1)) - before <= 2
    assert homed.stage.state(1).state is AxisState.READY


@pytest.mark.fault(25)
def test_a_late_reply_is_not_taken_for_the_next_answer(homed: Bench) -> None:
    homed.stage.move_many({1: 7.25, 2: -3.5})
    homed.controller.line_faults.delay_s = 0.35  # longer than the driver waits
    late = threading.Timer(0.3, lambda: setattr(homed.controller.line_faults, "delay_s", 0.0))
    late.start()
    first, second = homed.stage.position(1), homed.stage.position(2)
    late.join()
    assert (first, second) == pytest.approx((7.25, -3.5), abs=1e-4)


@pytest.mark.fault(25)
def test_a_silent_controller_is_lost_within_two_seconds_and_found_again(homed: Bench) -> None:
    def lost_after_s() -> float:
        homed.controller.line_faults.deaf = True
        start = time.monotonic()
        with pytest.raises(StageError) as caught:
            homed.stage.position(1)
        assert code_of(caught) == "stage_lost"
        seconds = time.monotonic() - start
        homed.controller.line_faults.deaf = False
        assert homed.stage.position(1) == pytest.approx(0.0, abs=1e-4)
        return seconds

    within(2.0, lost_after_s)


@pytest.mark.fault(25)
@pytest.mark.parametrize("fault", ["deaf", "silent"])
def test_a_move_is_never_sent_again(homed: Bench, fault: str) -> None:
    homed.axis(1).velocity_mm_s = 0.5  # 50 times real time: 40 mm take 1.6 s
    thread, errors = in_thread(lambda: homed.stage.move_to(1, 40.0))
    wait_until(lambda: homed.sent("move"))
    setattr(homed.controller.line_faults, fault, True)
    thread.join(10.0)
    assert [error.code for error in errors] == ["stage_lost"]
    assert len(homed.sent("move")) == 1
    if fault == "silent":  # it still receives: the axis was stopped
        wait_until(lambda: homed.sent("stop", 1))
        wait_until(lambda: not homed.axis(1).moving)
        assert homed.controller.true_position_mm(1) < 39.0


@pytest.mark.fault(25)
def test_a_move_survives_single_lost_replies_and_is_sent_once(homed: Bench) -> None:
    for at, loss in enumerate(("lose_replies", "halve_replies", "garble_replies"), start=1):
        before = len(homed.sent("move"))
        thread, errors = in_thread(lambda at=at: homed.stage.move_to(1, float(at)))
        wait_until(lambda before=before: len(homed.sent("move")) > before)
        setattr(homed.controller.line_faults, loss, 1)
        thread.join(10.0)
        homed.controller.line_faults.__dict__[loss] = 0
        assert not errors
        assert len(homed.sent("move")) == before + 1
    assert homed.controller.true_position_mm(1) == pytest.approx(3.0, abs=homed.step_mm)


@pytest.mark.parametrize("jam", ["following_error", "silent"])
def test_a_jammed_axis_is_a_motion_fault_and_stopped(homed: Bench, jam: str) -> None:
    homed.axis(1).faults.jam_mm = (-5.0, 2.0)
    homed.axis(1).faults.jam_kind = "silent" if jam == "silent" else "following_error"
    with pytest.raises(StageError) as caught:
        homed.stage.move_to(1, 8.0)
    assert code_of(caught) == "motion_fault"
    wait_until(lambda: homed.sent("stop", 1))
    assert homed.controller.true_position_mm(1) == pytest.approx(2.0)


def test_a_fault_before_the_first_look_at_a_move_is_no_refusal(homed: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    homed.axis(1).faults.jam_mm = (-5.0, 0.01)
    homed.axis(1).faults.jam_kind = "following_error"
    send = homed.stage._send_move

    def send_and_wait(axis: int, position_mm: float) -> None:
        send(axis, position_mm)
        wait_until(lambda: not homed.axis(1).moving)

    monkeypatch.setattr(homed.stage, "_send_move", send_and_wait)
    with pytest.raises(StageError) as caught:
        homed.stage.move_to(1, 8.0)
    assert code_of(caught) == "motion_fault"


def test_an_axis_that_says_it_moves_and_does_not_is_found_out(kind: tuple[str, Transport]) -> None:
    def found_out_after_s() -> float:
        with bench(*kind, time_scale=1.0, start_mm=0.0) as stand:
            stand.ready(1)
            stand.axis(1).faults.jam_mm = (-5.0, 2.0)
            stand.axis(1).faults.jam_kind = "silent"
            start = time.monotonic()
            with pytest.raises(StageError, match="has stood at") as caught:
                stand.stage.move_to(1, 40.0)
            assert code_of(caught) == "motion_fault"
            return time.monotonic() - start

    within(3.5, found_out_after_s)  # not the 4 s and more of the whole move


@pytest.mark.parametrize("target", [8.0, -8.0])
def test_a_limit_switch_is_a_motion_fault_in_the_controllers_words(homed: Bench, target: float) -> None:
    homed.axis(1).faults.limit_switches_mm = (-6.0, 6.0)
    with pytest.raises(StageError) as caught:
        homed.stage.move_to(1, target)
    assert code_of(caught) == "motion_fault"
    texts = " ".join(message.text for message in homed.stage.errors()).lower()
    side = "positive" if target > 0 else "negative"
    assert ("limit" if homed.driver in FAKES else side) in texts  # which do not name the side
    assert homed.stage.errors() == ()


def test_positions_can_be_read_while_another_thread_moves(kind: tuple[str, Transport]) -> None:
    with bench(*kind, time_scale=20.0, start_mm=0.0) as stand:
        stand.ready(1)
        thread, errors = in_thread(lambda: stand.stage.move_to(1, 40.0))
        seen = []
        while thread.is_alive():
            seen.append(stand.stage.position(1))
        thread.join()
        assert not errors
        assert seen == sorted(seen)
        assert all(-1e-4 <= mm <= 40.0001 for mm in seen)
        assert len({round(mm) for mm in seen}) > 3


def test_closing_stops_what_moves(kind: tuple[str, Transport]) -> None:
    with bench(*kind, time_scale=1.0, start_mm=0.0) as stand:
        stand.ready(1)
        thread, errors = in_thread(lambda: stand.stage.move_to(1, 40.0))
        wait_until(lambda: stand.axis(1).velocity_now_mm_s > 1)
        stand.stage.close()
        thread.join(5.0)
        assert len(errors) == 1
        wait_until(lambda: not stand.axis(1).moving)
        assert stand.controller.true_position_mm(1) < 20.0


@pytest.mark.parametrize("driver", [*CONTROLLERS, *FAKES])
def test_a_line_that_breaks_is_lost_and_can_be_opened_again(driver: str) -> None:
    with bench(driver, "socket") as stand:  # a pty cannot be hung up and opened again under the same name
        stand.ready(1)
        stand.server.hang_up()
        with pytest.raises(StageError) as caught:
            stand.stage.position(1)
        assert code_of(caught) == "stage_lost"
        stand.stage.close()
        stand.stage.open()
        assert stand.stage.position(1) == pytest.approx(0.0, abs=1e-4)


def test_velocities_are_set_and_refusals_named(kind: tuple[str, Transport]) -> None:
    with bench(*kind, options={1: AxisOptions(velocity_mm_s=2.5, acceleration_mm_s2=12.0)}) as stand:
        stand.ready(1)
        assert stand.axis(1).velocity_mm_s == pytest.approx(2.5)
        assert stand.axis(1).acceleration_mm_s2 == pytest.approx(12.0)
        with pytest.raises(StageError, match="velocity") as caught:
            stand.another({1: AxisOptions(velocity_mm_s=1e6)})
        assert code_of(caught) == "out_of_range"


def test_velocity_and_acceleration_are_set_at_run_time_and_read_back(homed: Bench) -> None:
    stage = homed.stage
    assert stage.dynamics(1).velocity_mm_s == pytest.approx(10.0)
    taken = stage.set_dynamics(1, velocity_mm_s=2.5)
    assert (taken.velocity_mm_s, taken.acceleration_mm_s2) == pytest.approx((2.5, 40.0))
    assert homed.axis(1).velocity_mm_s == pytest.approx(2.5)
    assert homed.axis(2).velocity_mm_s == pytest.approx(10.0)
    taken = stage.set_dynamics(1, acceleration_mm_s2=12.0)
    assert (taken.velocity_mm_s, taken.acceleration_mm_s2) == pytest.approx((2.5, 12.0))
    assert homed.axis(1).acceleration_mm_s2 == pytest.approx(12.0)
    assert stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)
    stage.home(1)
    assert homed.axis(1).velocity_mm_s == pytest.approx(2.5)  # homing keeps it
    if homed.driver == "esp301":  # it reports its limits: four times and ten times the power-on values
        assert (taken.max_velocity_mm_s, taken.max_acceleration_mm_s2) == pytest.approx((40.0, 400.0))


def test_a_velocity_that_is_none_goes_over_no_line(homed: Bench) -> None:
    before = len(homed.controller.received)
    for wrong in (0.0, -1.0, math.nan, math.inf, True, "fast", [1.0]):
        for given in ({"velocity_mm_s": wrong}, {"acceleration_mm_s2": wrong}):
            with pytest.raises(StageError) as caught:
                homed.stage.set_dynamics(1, **given)  # type: ignore[arg-type]
            assert code_of(caught) == "out_of_range", given
    assert len(homed.controller.received) == before


def test_a_velocity_beyond_the_controllers_greatest_is_refused_and_the_old_one_stays(homed: Bench) -> None:
    for given in ({"velocity_mm_s": 41.0}, {"acceleration_mm_s2": 401.0}):
        with pytest.raises(StageError) as caught:
            homed.stage.set_dynamics(1, **given)
        assert code_of(caught) == "out_of_range"
    assert homed.stage.dynamics(1).velocity_mm_s == pytest.approx(10.0)
    homed.stage.home(1)
    assert homed.axis(1).velocity_mm_s == pytest.approx(10.0)
    assert homed.axis(1).acceleration_mm_s2 == pytest.approx(40.0)


def test_abort_stops_everything_at_once_and_switches_the_motors_off(kind: tuple[str, Transport]) -> None:
    def aborted_after_s() -> float:
        with bench(*kind, time_scale=1.0, start_mm=0.0, acceleration_mm_s2=200.0) as stand:
            stand.ready(1, 2)
            thread, errors = in_thread(lambda: stand.stage.move_many({1: 40.0, 2: -40.0}))
            wait_until(lambda: stand.axis(1).velocity_now_mm_s > 5 and stand.axis(2).velocity_now_mm_s < -5)
            asked = time.monotonic()
            stand.stage.abort()
            thread.join(5.0)
            assert [error.code for error in errors] == ["stage_stopped"]
            arrived_s = stand.sent("abort")[0].at_s - asked
            for axis in (1, 2):
                status = stand.stage.state(axis)
                assert not status.moving
                assert not status.motor_on
                assert status.state is AxisState.MOTOR_OFF
                assert abs(stand.controller.true_position_mm(axis)) < 20.0
            with pytest.raises(StageError) as caught:
                stand.stage.move_to(1, 0.0)
            assert code_of(caught) == "motor_off"
            stand.stage.enable(1)
            assert stand.stage.move_to(1, 0.5).position_mm == pytest.approx(0.5, abs=1e-4)
            return arrived_s

    within(0.05, aborted_after_s)


def test_abort_at_rest_and_before_homing_does_no_harm(stand: Bench) -> None:
    stand.stage.abort()
    assert not stand.stage.state(1).motor_on
    stand.stage.errors()
    stand.ready(1)
    assert stand.stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)


@pytest.mark.fault(27)
def test_what_an_earlier_program_left_moving_is_stopped_at_opening(kind: tuple[str, Transport]) -> None:
    option = AxisOptions(assume_homed=True)
    with bench(*kind, time_scale=1.0, start_mm=0.0, options={1: option, 2: option}) as stand:
        stand.ready(1, 2)
        # the program that sent this is dead: no client is left to stop it
        stand.stage.close()
        stand.controller.take_line(stand.left_moving)
        wait_until(lambda: stand.axis(1).velocity_now_mm_s > 1)
        stand.stage.open()
        assert not stand.axis(1).moving
        assert stand.controller.true_position_mm(1) < 20.0
        found = [message for message in stand.stage.errors() if message.code == "opened_moving"]
        assert [message.axis for message in found] == [1]
        # the ESP301 cannot report whether that was a search for home; the SMC100 reports its reference
        assert stand.stage.state(1).homed is (stand.driver != "esp301")
        assert stand.stage.state(2).homed


def test_only_the_smc100_has_a_configuration_to_leave(stand: Bench) -> None:
    before = len(stand.controller.commands("PW"))
    with pytest.raises(StageError) as caught:
        stand.stage.leave_configuration(1)
    assert code_of(caught) == "not_in_configuration"
    assert len(stand.controller.commands("PW")) == before


def test_the_wire_is_recorded_on_request(kind: tuple[str, Transport], tmp_path: Path) -> None:
    record = tmp_path / "wire.txt"
    with bench(*kind, record=record) as stand:
        stand.stage.position(1)
        stand.stage.stop()
        wait_until(lambda: stand.sent("stop"))
    text = record.read_text("ascii")
    assert f"> b'{stand.sent('position', 1)[0].text}" in text
    assert "< b'" in text
    assert f"! b'{stand.sent('stop')[0].text}" in text
