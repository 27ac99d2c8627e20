"""The matcher bound to its images: what it takes over from a sample of points."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.field.points.fitter import Fitter
from stereorig.core.matching import MatchOptions, prepare
from stereorig.core.matching.options import FIRST_RATE
from tests.support.matching_scene import paper_pair


def fitter() -> Fitter:
    image = prepare(np.random.default_rng(1).normal(128.0, 30.0, (40, 40)))
    return Fitter(
        pair=paper_pair(), ref1=image, ref2=image, cur1=image, cur2=image, options=MatchOptions(), min_zncc=0.6
    )


def rate_after(*rates: float) -> float:
    return fitter().converging(np.array(rates)).options.first_rate


def test_the_rate_of_a_sample_is_that_which_nine_in_ten_reach() -> None:
    rates = np.arange(1, 102) * 1e-4  # the ninetieth of a hundred intervals ends at 91e-4
    assert rate_after(*rates) == pytest.approx(91e-4)
    assert rate_after(*rates, *[np.nan] * 50) == pytest.approx(91e-4)  # points that took a single step say nothing


def test_a_slow_sample_and_a_small_one_leave_the_rate_as_it_was() -> None:
    assert rate_after(*[0.4] * 100) == FIRST_RATE
    assert rate_after(*[0.001] * 29) == FIRST_RATE
    assert rate_after(*[0.001] * 30) == pytest.approx(0.001)


def test_the_matcher_itself_keeps_its_rate() -> None:
    one = fitter()
    assert one.converging(np.full(100, 0.001)).options.first_rate == pytest.approx(0.001)
    assert one.options.first_rate == FIRST_RATE
