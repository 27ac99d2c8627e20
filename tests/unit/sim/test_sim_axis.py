"""The simulated axis moves as mechanics say: ramps, lost motion, scale, tilt, jams."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereorig.sim.controllers.axis import SimAxis, SimClock, brake, trapezoid


class HandClock(SimClock):
    """A clock that the test turns."""

    def __init__(self) -> None:
        super().__init__()
        self.at = 0.0

    def now(self) -> float:
        return self.at


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


def axis_on(clock: HandClock, **options: float) -> SimAxis:
    return SimAxis(clock, **{"velocity_mm_s": 5.0, "acceleration_mm_s2": 20.0, "resolution_mm": 1e-4, **options})


def test_a_long_move_takes_distance_over_speed_plus_one_ramp() -> None:
    profile = trapezoid(0.0, 30.0, 0.0, 5.0, 20.0)
    assert profile.end_s == pytest.approx(30.0 / 5.0 + 5.0 / 20.0)
    assert profile.at(profile.end_s / 2) == (pytest.approx(15.0), pytest.approx(5.0))


def test_a_short_move_never_reaches_full_speed() -> None:
    profile = trapezoid(0.0, 0.2, 0.0, 5.0, 20.0)
    # two parabolas: half the way on each ramp
    assert profile.end_s == pytest.approx(2 * math.sqrt(0.2 / 20.0))
    assert profile.at(profile.end_s / 2)[1] == pytest.approx(math.sqrt(0.2 * 20.0))


@given(start=st.floats(-50, 50), goal=st.floats(-50, 50), velocity=st.floats(0.1, 50), ramp=st.floats(1.0, 500))
def test_every_move_is_smooth_within_its_limits_and_ends_at_its_goal(
    start: float, goal: float, velocity: float, ramp: float
) -> None:
    profile = trapezoid(start, goal, 0.0, velocity, ramp)
    times = np.linspace(0.0, profile.end_s, 200)
    x, v = np.array([profile.at(float(t)) for t in times]).T
    assert profile.at(0.0)[0] == pytest.approx(start, abs=1e-9)
    assert x[-1] == goal
    assert np.all(np.abs(v) <= velocity * (1 + 1e-9))
    step = profile.end_s / 199 if profile.end_s else 0.0
    assert np.all(np.abs(np.diff(x)) <= velocity * step * (1 + 1e-6) + 1e-9)
    assert np.all(np.abs(np.diff(v)) <= ramp * step * (1 + 1e-6) + 1e-9)
    assert np.all(np.diff(x) * np.sign(goal - start) >= -1e-9)


def test_braking_takes_half_the_square_of_the_speed_over_the_ramp() -> None:
    profile = brake(10.0, -4.0, 2.0, 20.0)
    assert profile.goal_mm == pytest.approx(10.0 - 4.0**2 / (2 * 20.0))
    assert profile.end_s == pytest.approx(2.0 + 4.0 / 20.0)
    assert profile.at(3.0) == (profile.goal_mm, 0.0)


def test_a_stop_leaves_the_axis_where_the_ramp_ends(clock: HandClock) -> None:
    axis = axis_on(clock)
    axis.move_to(20.0)
    clock.at = 1.0
    before = axis.encoder_mm
    axis.stop()
    clock.at = 10.0
    assert not axis.moving
    assert axis.encoder_mm == pytest.approx(before + 5.0**2 / 40.0, abs=2e-4)


def test_lost_motion_shows_only_after_turning_back(clock: HandClock) -> None:
    axis = axis_on(clock)
    axis.faults.backlash_mm = 0.03
    positions = []
    for target in (5.0, 4.99, 4.0, 4.01, 5.0):
        axis.move_to(target)
        clock.at += 10.0
        positions.append(axis.true_position_mm())
    # upwards the load is at the motor; back by 0.01 it stays, back by more it lags by 0.03
    assert positions == pytest.approx([5.0, 5.0, 4.03, 4.03, 5.0])


def test_a_wrong_screw_and_a_tilted_axis_show_in_the_truth_only(clock: HandClock) -> None:
    axis = axis_on(clock)
    axis.faults.scale_error = 2e-3
    axis.faults.tilt = (1e-3, -2e-3)
    axis.move_to(10.0)
    clock.at = 10.0
    assert axis.encoder_mm == pytest.approx(10.0)
    assert axis.true_position_mm() == pytest.approx(10.02)
    assert axis.true_displacement_mm() == pytest.approx((0.01002, -0.02004, 10.02))


def test_the_encoder_has_steps(clock: HandClock) -> None:
    axis = axis_on(clock, resolution_mm=1e-3)
    axis.move_to(1.23456)
    clock.at = 10.0
    assert axis.encoder_mm == pytest.approx(1.235, abs=1e-9)
    assert axis.true_position_mm() == pytest.approx(1.23456)


def test_homing_moves_the_zero_of_the_encoder(clock: HandClock) -> None:
    axis = axis_on(clock, start_mm=7.0)
    assert axis.encoder_mm == 0.0
    axis.move_home()
    clock.at = 10.0
    axis.set_home()
    assert axis.encoder_mm == 0.0
    assert axis.true_position_mm() == 0.0
    axis.define_position(2.5)
    assert axis.encoder_mm == pytest.approx(2.5)
    assert axis.true_position_mm() == 0.0


def test_a_jam_trips_the_following_error_and_a_switch_its_limit(clock: HandClock) -> None:
    axis = axis_on(clock)
    axis.faults.jam_mm = (-1.0, 3.0)
    axis.move_to(10.0)
    clock.at = 5.0
    assert axis.take_trouble() == "following_error"
    assert axis.take_trouble() is None
    assert not axis.moving
    assert axis.true_position_mm() == 3.0
    axis.faults.jam_mm = None
    axis.faults.limit_switches_mm = (-2.0, 4.0)
    axis.move_to(-5.0)
    clock.at = 20.0
    assert axis.take_trouble() == "negative_limit"
    assert axis.true_position_mm() == -2.0


def test_asking_from_many_threads_does_not_disturb_the_lost_motion() -> None:
    axis = SimAxis(SimClock(20.0), velocity_mm_s=10.0, acceleration_mm_s2=100.0)
    axis.faults.backlash_mm = 0.05
    axis.move_to(5.0)
    seen: list[float] = []

    def ask() -> None:
        while axis.moving:
            seen.append(axis.true_position_mm() - axis.encoder_mm)

    threads = [threading.Thread(target=ask) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert axis.true_position_mm() == pytest.approx(5.0)
    axis.move_to(1.0)
    while axis.moving:
        axis.true_position_mm()
    assert axis.true_position_mm() == pytest.approx(1.05)


def test_a_clock_must_run_forwards() -> None:
    with pytest.raises(ValueError, match="positive"):
        SimClock(0.0)
