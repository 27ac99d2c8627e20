"""Moments in a channel's readings: levels, slopes, peaks, valleys, phases."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.live.channels import Cycles, level_reached, moments, slope_reached


def test_a_level_is_passed_between_two_readings() -> None:
    t = np.arange(0.0, 10.0, 0.1)
    assert level_reached(t, 100.0 * t, 333.0) == pytest.approx(3.33)
    assert level_reached(t, 100.0 * t, 333.0, falling=True) is None
    assert level_reached(t, -100.0 * t, -333.0, falling=True) == pytest.approx(3.33)
    assert level_reached(t, 100.0 * t + 500.0, 333.0) is None  # it was above from the beginning
    assert level_reached(t[:0], t[:0], 1.0) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slope_is_reached_within_its_span(sign: float) -> None:
    t = np.arange(0.0, 10.0, 0.01)
    y = sign * 1000.0 * np.maximum(t - 5.0, 0.0)
    assert slope_reached(t, y, sign * 900.0, over_s=0.1) == pytest.approx(5.09, abs=0.011)
    assert slope_reached(t, y, sign * 1100.0, over_s=0.1) is None


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_peaks_valleys_and_phases_of_a_noisy_cycle_are_where_they_are(noise: float) -> None:
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 20.0, 0.013)
    y = np.cos(2.0 * np.pi * (t - 0.3) / 1.7) + noise * rng.normal(size=t.size)
    cycles = Cycles()
    for part in np.array_split(np.arange(t.size), 57):  # they come bit by bit
        cycles.feed(t[part], y[part])
    off = 0.001 if noise == 0.0 else 0.12
    for found, first in ((moments(cycles, "peak", every=1, phases_deg=[0.0]), 0.3), (cycles.valleys, 1.15)):
        past = [(at_s - first) / 1.7 for at_s in found[1:]]
        assert len(past) >= 9
        assert np.max(np.abs(np.array(past) - np.round(past))) * 1.7 < off
    third = moments(cycles, "phase", every=3, phases_deg=[180.0, 90.0])
    assert len(third) == 2 * ((len(cycles.peaks) - 1) // 3)
    assert third[0] == pytest.approx(cycles.peaks[2] + 1.7 / 4.0, abs=off)
    assert third[1] == pytest.approx(cycles.peaks[2] + 1.7 / 2.0, abs=off)


def test_readings_that_begin_on_the_way_down_begin_with_a_valley() -> None:
    t = np.arange(0.0, 5.0, 0.01)
    cycles = Cycles()
    cycles.see(np.array([-1.0, 1.0]))
    cycles.feed(t, np.cos(2.0 * np.pi * (t + 0.25)))
    assert cycles.valleys[0] == pytest.approx(0.25, abs=1e-3)
    assert cycles.peaks[0] == pytest.approx(0.75, abs=1e-3)


def test_noise_about_rest_has_no_cycles_with_a_stated_reversal() -> None:
    cycles = Cycles(reversal=1.0)
    cycles.feed(np.arange(1000.0), 0.1 * np.random.default_rng(1).normal(size=1000))
    assert cycles.peaks == cycles.valleys == []
