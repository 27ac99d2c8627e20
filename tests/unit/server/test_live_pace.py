"""Which pair a live measurement takes that takes longer than the cameras' period, in simulated time."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.server.workflows.live.account import Pace

PERIOD_S = 0.02


def run(takes_s: float, *, waits: bool, periods: int = 2000, lost: float = 0.0) -> tuple[np.ndarray, float]:
    """Measure pairs that come in a period, one in ``1 / lost`` of them lost; return latencies and values a second."""
    dice = np.random.default_rng(5)
    arrivals = [k * PERIOD_S for k in range(periods) if dice.random() >= lost]
    pace, now, at, taken, latencies = Pace(), 0.0, 0, -1, []
    while True:
        # what has come by now, and is noted as it comes
        while at < len(arrivals) and arrivals[at] <= now:
            pace.came(arrivals[at], 0)
            at += 1
        newest = at - 1
        if newest == taken:
            if at == len(arrivals):
                break
            now = arrivals[at]
            continue
        wait_s = pace.wait_s(arrivals[newest], now) if waits else 0.0
        if wait_s > 0.0:
            now = min(now + max(wait_s, 1e-6), arrivals[at] if at < len(arrivals) else np.inf)
            continue
        taken, now = newest, now + takes_s
        latencies.append(now - arrivals[taken])
    return np.array(latencies), len(latencies) / now


@pytest.mark.parametrize("takes_periods", [1.05, 1.35, 1.6, 2.2])
def test_values_are_younger_and_hardly_fewer_than_if_any_pair_were_taken(takes_periods: float) -> None:
    takes_s = takes_periods * PERIOD_S
    latency, rate = run(takes_s, waits=True)
    any_latency, any_rate = run(takes_s, waits=False)
    assert latency[5:].max() <= takes_s + 0.5 * PERIOD_S + 1e-9
    assert np.median(latency) < np.median(any_latency)
    assert rate > 0.8 * any_rate

    def age(latencies: np.ndarray, values_a_second: float) -> float:
        """Mean age of the newest value: what a controller works with."""
        return float(latencies.mean()) + 0.5 / values_a_second

    assert age(latency, rate) <= age(any_latency, any_rate) + 1e-4


def test_every_pair_is_measured_if_measuring_is_faster_than_the_cameras() -> None:
    latency, rate = run(0.6 * PERIOD_S, waits=True)
    assert rate == pytest.approx(1.0 / PERIOD_S, rel=0.01)
    assert latency.max() == pytest.approx(0.6 * PERIOD_S)


def test_a_pair_that_is_lost_is_waited_for_no_longer_than_a_quarter_of_a_period_beyond_its_time() -> None:
    latency, _ = run(1.35 * PERIOD_S, waits=True, lost=0.1)
    assert latency.max() <= (1.35 + 1.25) * PERIOD_S + 2e-6


def test_pairs_that_were_passed_over_do_not_lengthen_the_period() -> None:
    pace = Pace()
    for k in range(4):
        pace.came(0.06 * k, 2)
    assert pace.wait_s(0.18, 0.18 + 0.009) == 0.0
    assert pace.wait_s(0.18, 0.18 + 0.011) == pytest.approx(0.014)
    assert pace.wait_s(0.18, 0.18 + 0.026) == 0.0


def test_nothing_is_waited_for_before_the_period_is_known() -> None:
    pace = Pace()
    for k in range(3):
        pace.came(0.02 * k, 0)
        assert pace.wait_s(0.02 * k, 0.02 * k + 0.015) == 0.0
