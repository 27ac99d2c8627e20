"""Makers' controllers: what the contract suite does not ask of Zaber and PI, and Kinesis with its one axis."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from stereorig.core.errors import StageError
from stereorig.drivers.registry import make_stage
from stereorig.drivers.stages.protocol import AxisOptions, AxisState
from tests.support.stage_bench import Bench, bench, in_thread, wait_until


def refused(call: Any) -> StageError:
    with pytest.raises(StageError) as caught:
        call()
    return caught.value


@pytest.mark.parametrize("driver", ["pi", "zaber"])
def test_a_controller_that_lost_its_power_is_not_homed_until_it_is_homed_again(driver: str) -> None:
    with bench(driver, "socket") as stand:
        stand.ready(1)
        stand.controller.__init__(time_scale=50.0, start_mm=7.0)
        assert not stand.stage.state(1).homed
        assert refused(lambda: stand.stage.move_to(1, 1.0)).code == "not_homed"
        stand.ready(1)
        assert stand.stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)


@pytest.mark.fault(54)
@pytest.mark.parametrize("driver", ["pi", "zaber"])
def test_another_process_stops_the_axis_by_the_last_words(driver: str) -> None:
    with bench(driver, "socket", time_scale=1.0, start_mm=0.0) as stand:
        stand.ready(1)
        thread, errors = in_thread(lambda: stand.stage.move_to(1, 40.0))
        wait_until(lambda: stand.axis(1).velocity_now_mm_s > 5)
        [(descriptor, words)] = stand.stage.last_words()
        subprocess.run(
            [sys.executable, "-c", f"import os; os.write({descriptor}, {words!r})"], pass_fds=[descriptor], check=True
        )
        os.close(descriptor)
        thread.join(5.0)
        assert [error.code for error in errors] == ["motion_fault"]  # it rests, and not at its goal
        assert stand.controller.true_position_mm(1) < 39.0


def test_zaber_firmware_6_opens_and_is_named() -> None:
    with bench("zaber", "socket", firmware="6.33") as stand:
        identity = stand.stage.identify()
        assert (identity.model, identity.firmware) == ("Zaber device 50081", "6.33")
        assert [(axis.serial, axis.units) for axis in identity.axes] == [
            ("40001", "microsteps"),
            ("40002", "microsteps"),
        ]


def test_zaber_axes_without_a_ramp_or_without_the_length_of_a_microstep_are_refused() -> None:
    with bench("zaber", "socket") as stand:
        stand.axis(1).acceleration_mm_s2 = 1e-9
        error = refused(lambda: stand.another({1: AxisOptions()}))
        assert (error.code, "acceleration 0 mm/s^2" in error.cause) == ("out_of_range", True)
        stage = make_stage("zaber", stand.server.url, {1: AxisOptions()})
        assert refused(stage.open).code == "unit_not_length"


def test_a_zaber_fault_is_cleared_by_enabling() -> None:
    with bench("zaber", "socket") as stand:
        stand.ready(1)
        stand.axis(1).faults.jam_mm = (-5.0, 2.0)
        assert "stalled and stopped (FS)" in refused(lambda: stand.stage.move_to(1, 8.0)).cause
        assert stand.stage.state(1).state is AxisState.FAULT
        stand.axis(1).faults.jam_mm = None
        stand.stage.enable(1)
        assert stand.stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)


def test_a_pi_controller_of_old_firmware_opens_without_unit_and_name() -> None:
    with bench("pi", "socket", old=True) as stand:
        identity = stand.stage.identify()
        assert (identity.model, identity.firmware) == ("PI C-884.4DB 119012345", "1.2.0.1")
        stand.ready(1)
        assert stand.stage.move_to(1, 2.5).position_mm == pytest.approx(2.5, abs=1e-4)
        assert not stand.stage.errors()


def test_a_pi_axis_in_degrees_is_refused() -> None:
    with pytest.raises(StageError, match="DEG") as caught, bench("pi", "socket", unit="DEG"):
        pass
    assert caught.value.code == "unit_not_length"


def test_pi_errors_are_those_of_the_rest_of_the_service() -> None:
    with bench("pi", "socket") as stand:
        stand.ready(1, 2)
        stand.axis(1).faults.jam_mm = (-5.0, 2.0)
        error = refused(lambda: stand.stage.move_to(1, 8.0))
        assert (error.code, "position error too large" in error.cause) == ("motion_fault", True)
        assert [message.text for message in stand.stage.errors()] == ["position error too large, servo switched off"]
        limits = stand.stage._limits[2]
        stand.stage._limits[2] = replace(limits, high_mm=90.0)  # the driver's own check aside
        assert refused(lambda: stand.stage.move_to(2, 60.0)).code == "out_of_limits"


ONE = {1: AxisOptions(soft_limits_mm=(-50.0, 50.0))}


@pytest.fixture
def kinesis() -> Iterator[Bench]:
    with bench("kinesis", "socket", options=ONE) as made:
        yield made


def test_kinesis_names_the_controller_and_moves_to_what_is_true(kinesis: Bench) -> None:
    identity = kinesis.stage.identify()
    assert (identity.model, identity.firmware) == ("Thorlabs KDC101", "1.2.3")
    assert identity.axes[0].serial == "27000001"
    assert refused(lambda: kinesis.stage.home(1)).code == "motor_off"
    kinesis.stage.enable(1)
    assert refused(lambda: kinesis.stage.move_to(1, 1.0)).code == "not_homed"
    kinesis.stage.home(1)
    assert kinesis.controller.true_position_mm(1) == pytest.approx(0.0, abs=1e-9)
    for target in (5.1234, -3.0):
        assert kinesis.stage.move_to(1, target).position_mm == pytest.approx(target, abs=1e-4)
        assert kinesis.controller.true_position_mm(1) == pytest.approx(target, abs=1e-4)
    kinesis.stage.disable(1)
    assert kinesis.stage.state(1).state is AxisState.MOTOR_OFF


@pytest.mark.parametrize("lag", [1, 3])
def test_a_kinesis_state_that_shows_no_motion_yet_is_no_end_of_it(lag: int) -> None:
    with bench("kinesis", "socket", options=ONE, lag=lag, time_scale=20.0) as stand:
        stand.ready(1)
        assert stand.stage.move_to(1, 20.0).position_mm == pytest.approx(20.0, abs=1e-4)


@pytest.mark.parametrize("model", ["KDC101", "KST101", "KBD101"])
def test_kinesis_velocities_are_in_the_units_of_the_family_and_refused_beyond(model: str) -> None:
    options = {1: replace(ONE[1], velocity_mm_s=2.5, acceleration_mm_s2=12.0)}
    with bench("kinesis", "socket", options=options, model=model) as stand:
        assert stand.axis(1).velocity_mm_s == pytest.approx(2.5, rel=1e-3)
        assert stand.axis(1).acceleration_mm_s2 == pytest.approx(12.0, rel=0.02)  # the unit is coarse
        assert refused(lambda: stand.stage.set_dynamics(1, velocity_mm_s=41.0)).code == "out_of_range"
        wait_until(lambda: stand.axis(1).velocity_mm_s == pytest.approx(2.5, rel=1e-3))
        stand.ready(1)
        assert stand.stage.move_to(1, 1.0).position_mm == pytest.approx(1.0, abs=1e-4)


@pytest.mark.fault(25)
def test_whatever_happens_to_a_kinesis_reply_a_move_is_sent_once(kinesis: Bench) -> None:
    kinesis.ready(1)
    noise = [("stray", b"\0noise\x01P"), ("stray", b"\x06")]
    losses = [(f"{word}_replies", 1) for word in ("lose", "halve", "garble")]
    for at, (fault, value) in enumerate([*losses, *noise]):
        setattr(kinesis.controller.line_faults, fault, value)
        assert kinesis.stage.move_to(1, float(at)).position_mm == pytest.approx(at, abs=1e-4)
        assert len(kinesis.sent("move")) == at + 1
    kinesis.controller.line_faults.deaf = True
    assert refused(lambda: kinesis.stage.position(1)).code == "stage_lost"
    kinesis.controller.line_faults.deaf = False
    assert kinesis.stage.position(1) == pytest.approx(at, abs=1e-4)


@pytest.mark.fault(54)
@pytest.mark.parametrize("how", ["stop", "abort", "last words", "close"])
def test_a_kinesis_move_is_stopped_by_a_stop_an_abort_and_another_process(how: str) -> None:
    with bench("kinesis", "socket", options=ONE, time_scale=1.0, start_mm=0.0) as stand:
        stand.ready(1)
        thread, errors = in_thread(lambda: stand.stage.move_to(1, 40.0))
        wait_until(lambda: stand.axis(1).velocity_now_mm_s > 5)
        if how == "last words":
            [(descriptor, words)] = stand.stage.last_words()
            os.write(descriptor, words)
            os.close(descriptor)
        else:
            getattr(stand.stage, how)()
        thread.join(5.0)
        wait_until(lambda: not stand.axis(1).moving)
        expected = {"stop": ["stage_stopped"], "abort": ["stage_stopped"], "last words": ["motion_fault"]}
        assert [error.code for error in errors] == expected.get(how, [error.code for error in errors][:1])
        assert len(errors) == 1
        assert stand.controller.true_position_mm(1) < 30.0
        assert stand.controller.enabled is (how != "abort")


def test_a_kinesis_search_for_home_that_is_stopped_leaves_the_axis_not_homed() -> None:
    with bench("kinesis", "socket", options=ONE, time_scale=1.0, start_mm=30.0) as stand:
        stand.stage.enable(1)
        thread, errors = in_thread(lambda: stand.stage.home(1))
        wait_until(lambda: stand.axis(1).velocity_now_mm_s != 0)
        stand.stage.stop(1)
        thread.join(5.0)
        assert [error.code for error in errors] == ["stage_stopped"]
        assert not stand.stage.state(1).homed


@pytest.mark.parametrize("jam", ["following_error", "silent"])
def test_a_jammed_kinesis_axis_is_a_motion_fault(kinesis: Bench, jam: str) -> None:
    kinesis.ready(1)
    kinesis.axis(1).faults.jam_mm, kinesis.axis(1).faults.jam_kind = (-5.0, 2.0), jam  # type: ignore[assignment]
    error = refused(lambda: kinesis.stage.move_to(1, 8.0))
    assert error.code == "motion_fault"
    assert ("position error too large" in error.cause) is (jam == "following_error")


def test_what_moves_when_a_kinesis_controller_is_opened_is_stopped(kinesis: Bench) -> None:
    kinesis.ready(1)
    kinesis.stage.close()
    kinesis.controller.clock.time_scale = 1.0
    kinesis.controller.take_line(kinesis.left_moving)
    kinesis.stage.open()
    assert not kinesis.axis(1).moving
    assert [message.code for message in kinesis.stage.errors()] == ["opened_moving"]


def test_a_kinesis_controller_of_unknown_units_of_time_is_refused() -> None:
    with pytest.raises(StageError, match="'KIM101'") as caught, bench("kinesis", "socket", options=ONE, model="KIM101"):
        pass
    assert caught.value.code == "stage_refused"
