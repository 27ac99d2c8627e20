"""What a soak says: a series that grows is told from one that does not; a minute of it leaves nothing behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.bench.years.soak import growth, run, verdicts
from tests.support.patience import busy


def _series(slope: float, noise: float, seed: int) -> list[tuple[float, float]]:
    """3,600 samples, one a second, of a value that grows by ``slope`` in fifty minutes."""
    dice = np.random.default_rng(seed)
    at = np.arange(3600.0)
    return list(zip(at, 200.0 + slope * at / 3000.0 + dice.normal(0.0, noise, at.size), strict=True))


@pytest.mark.parametrize(
    ("slope", "verdict"), [(0.0, "flat"), (-30.0, "flat"), (5.0, "flat"), (40.0, "grows"), (16.0, "not decided")]
)
def test_the_verdict_is_that_of_the_true_growth(slope: float, verdict: str) -> None:
    found = growth("memory", _series(slope, 2.0, 1), 600.0, allowed=16.2 if verdict == "not decided" else 16.0)
    assert found.verdict == verdict
    assert found.low < found.grown < found.high


def test_the_interval_holds_the_true_growth_in_95_of_100_runs() -> None:
    held = [(g := growth("x", _series(10.0, 5.0, seed), 600.0, 16.0)).low <= 10.0 <= g.high for seed in range(400)]
    # the samples end a second before the fiftieth minute is over; 95 % of 400, three standard deviations
    assert 0.917 <= np.mean(held) <= 0.983


def test_growth_during_the_warm_up_does_not_count() -> None:
    samples = [(at, value + 500.0 * min(at / 600.0, 1.0)) for at, value in _series(0.0, 2.0, 3)]
    assert growth("memory", samples, 600.0, 16.0).verdict == "flat"


@pytest.mark.deep
@pytest.mark.timeout(300)
def test_a_minute_of_work_leaves_nothing_open(tmp_path: Path) -> None:
    soak = run(tmp_path, 60.0, page=False)
    assert soak.wrong == []
    assert soak.done["captures"] > 30 / busy()
    assert soak.done["exports"] > 2 / busy()
    grown = {one.name for one in verdicts(soak) if one.verdict == "grows"}
    assert not grown & {"open files", "threads"}
