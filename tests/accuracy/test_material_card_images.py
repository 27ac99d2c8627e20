"""Modulus and Poisson's ratio of a strip seen in rendered stereo images, within what the card says of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.strip_images import TRUTH, cards, within

pytestmark = pytest.mark.timeout(600)


def test_the_modulus_of_a_rendered_strip_is_within_its_uncertainty(tmp_path: Path) -> None:
    for card in cards(tmp_path, 3, seed=1):
        for symbol, true in TRUTH.items():
            one = card.numbers[symbol]
            assert one.state == "good", one
            assert one.value is not None
            assert one.u is not None
            # beyond four standard uncertainties lies one draw in 16,000
            assert abs(one.value - true) < 4.0 * one.u, (symbol, one)
            assert one.u < 0.1 * true, (symbol, one)


@pytest.mark.deep
@pytest.mark.timeout(3600)
def test_intervals_of_a_hundred_rendered_tests_hold_as_often_as_they_say(tmp_path: Path) -> None:
    found = list(cards(tmp_path, 100, seed=2))
    # of 100 draws with 95 % fewer than 88 hold in one of 500 cases
    assert all(within(found, symbol) >= 0.88 for symbol in TRUTH)
