"""Channels at an exposure: the value between readings, how far it can be wrong, and readings that are none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.live.channels import ReadingAt, appears_in, has_moved, reading_at, stuck_since

Array = NDArray[np.float64]


def sampled(signal: Callable[[Array], Array], *, rate_hz: float, noise: float, seed: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 1.0 / rate_hz) + rng.uniform(-0.1, 0.1) / rate_hz
    return t, signal(t) + noise * rng.normal(size=t.size)


def over_sigma(signal: Callable[[Array], Array], *, rate_hz: float, noise: float, digit: float = 0.0) -> Array:
    found = []
    for seed in range(300):
        t, y = sampled(signal, rate_hz=rate_hz, noise=noise, seed=seed)
        y = np.round(y / digit) * digit if digit else y
        at = float(np.random.default_rng(1000 + seed).uniform(5.0, 15.0))
        one = reading_at(t, y, at, resolution=digit)
        assert isinstance(one, ReadingAt)
        found.append((one.value - float(signal(np.array(at)))) / one.u)
    return np.array(found)


@pytest.mark.parametrize(
    ("signal", "noise", "digit", "least"),
    [
        (lambda t: 100.0 * t, 1.0, 0.0, 0.8),
        (lambda t: 100.0 * t, 0.0, 1.0, 0.4),
        (lambda t: 100.0 * np.sin(2.0 * t), 0.5, 0.0, 0.5),
        (lambda t: 100.0 * np.sin(6.0 * t), 0.0, 0.0, 0.1),
        (lambda t: np.zeros_like(t), 1.0, 0.1, 0.8),
    ],
    ids=["ramp with noise", "ramp in whole digits", "slow cycles", "fast cycles", "at rest"],
)
def test_errors_at_the_exposure_are_as_large_as_stated(
    signal: Callable[[Array], Array], noise: float, digit: float, least: float
) -> None:
    ratio = over_sigma(signal, rate_hz=10.0, noise=noise, digit=digit)
    rms = float(np.sqrt(np.mean(ratio**2)))
    # never below what is true by more than the scatter of 300 draws; how far above is no error of the measurement
    assert least <= rms <= 1.12


def test_a_jump_between_two_readings_is_in_the_uncertainty() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    rng = np.random.default_rng(1)
    errors, sigmas = [], []
    for at_jump in rng.uniform(4.0, 4.1, 400):
        at = float(rng.uniform(4.0, 4.1))
        one = reading_at(t, np.where(t < at_jump, 1000.0, 400.0), at)  # the specimen breaks
        assert isinstance(one, ReadingAt)
        errors.append(one.value - (1000.0 if at < at_jump else 400.0))
        sigmas.append(one.u)
    assert float(np.sqrt(np.mean(np.square(errors)))) <= 1.05 * float(np.sqrt(np.mean(np.square(sigmas))))


def test_beyond_the_last_reading_it_is_held_and_in_a_gap_it_is_not_known() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    held = reading_at(t, 100.0 * t, float(t[-1]) + 0.05)
    assert isinstance(held, ReadingAt)
    assert held.held_s == pytest.approx(0.05)
    assert abs(held.value - 100.0 * (t[-1] + 0.05)) <= 1.0001 * held.u  # it went on at its rate
    assert "old" in str(reading_at(t, t, 11.0))
    assert "not read yet" in str(reading_at(t, t, -1.0))
    gap = np.delete(t, slice(40, 60))
    assert "apart" in str(reading_at(gap, gap, 5.0))


def test_a_late_line_counts_by_the_slope() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    one = reading_at(t, 100.0 * t, 5.03, u_time_s=0.02)
    assert isinstance(one, ReadingAt)
    assert one.u == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize(
    ("noise", "digit", "run", "stuck"),
    [
        (1.0, 0.1, 60, True),
        (1.0, 1.0, 60, True),
        (1.0, 0.1, 5, False),
        (0.3, 1.0, 60, False),  # a quantity at rest within a digit stays the same for long
        (1.0, 2.0, 15, False),
    ],
)
def test_digits_that_stay_the_same_for_longer_than_the_noise_allows(
    noise: float, digit: float, run: int, stuck: bool
) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        y = np.round((50.3 + noise * rng.normal(size=500)) / digit) * digit
        y[-run:] = y[-run]
        t = np.arange(500) / 10.0
        found = stuck_since(t, y)
        assert (found is not None and found[1]) == stuck
        if found is not None and stuck:
            assert t[-run - 3] <= found[0] <= t[-run]


def test_sound_channels_are_never_stuck_nor_another_ones() -> None:
    for seed in range(40):
        rng = np.random.default_rng(seed)
        t = np.arange(2000) / 50.0
        digit = 10.0 ** rng.integers(-3, 1)
        slow = np.cumsum(rng.normal(size=t.size)) * 0.05
        load, stroke = (np.round((k * slow + rng.normal(size=t.size)) / digit) * digit for k in (3.0, -2.0))
        for y in (load, stroke):
            assert all(stuck_since(t[:n], y[:n]) is None for n in range(100, 2000, 50))
        assert not appears_in((t, load), (t + 0.003, stroke), 0.05)


def test_a_clean_ramp_that_comes_to_rest_may_be_at_rest_itself() -> None:
    t = np.arange(500) / 10.0
    ramp = np.minimum(t, 40.0)
    assert stuck_since(t, ramp) == (40.0, False)
    assert has_moved(t, t, 40.0)
    assert not has_moved(t, ramp, 40.1)


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_readings_of_one_channel_that_appear_in_another_are_found(share: float) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(600) / 20.0
    load, stroke = np.round(500.0 + 10.0 * t + rng.normal(size=600), 1), np.round(5.0 + 0.1 * t, 3)
    mixed = np.where(rng.uniform(size=600) < share, load, stroke)
    assert appears_in((t, load), (t + 0.004, mixed), 0.1)
    assert not appears_in((t, mixed), (t + 0.004, load), 0.1) or share > 0.9
    assert not appears_in((t, stroke), (t, load), 0.1)
