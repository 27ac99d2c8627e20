"""The numbers of a tensile test beside the laws that its readings were drawn from, and what goes wrong in a test."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.arrays import Float
from stereorig.server.evaluations.tensile.assessment import Assessed, assessed
from stereorig.server.evaluations.tensile.curve import Curve, with_load_errors
from stereorig.server.evaluations.tensile.planning import Asked
from stereorig.server.evaluations.tensile.profiles import PROFILES
from tests.support.tensile_strip import LAWS, Law, broken, drawn, late, slipped, stated, with_cross_talk

ASKED = Asked(min_steps=5, share=0.01, r_window=(0.08, 0.12), n_window=(0.10, 0.15))
METALS = PROFILES["iso_6892_1"]
DRAWS = 200
FAULTY = 25


def covered(draws: int) -> dict[tuple[str, str], float]:
    """Share of the draws whose 95 % interval holds the law's number, by law and number."""
    found = {}
    for name, law in LAWS.items():
        rng = np.random.default_rng(40)
        cards = [assessed(drawn(law, rng), METALS, ASKED) for _ in range(draws)]
        for key, true in law.truth.items():
            numbers = [card.numbers[key].number for card in cards]
            assert None not in numbers, (name, key)
            held = [abs(one.value - true) <= 1.96 * one.u for one in numbers if one is not None]
            found[name, key] = float(np.mean(held))
    return found


def test_intervals_hold_the_laws_numbers_as_often_as_they_say() -> None:
    shares = covered(DRAWS)
    # 200 draws of a share of 95 % scatter by 1.5 points: four of these for the worst of eight cells
    assert all(0.89 <= share <= 1.0 for share in shares.values()), shares
    assert 0.93 <= np.mean(list(shares.values())) <= 0.98, shares


@pytest.mark.deep
@pytest.mark.timeout(1200)
def test_intervals_of_a_thousand_tests_hold_as_often_as_they_say() -> None:
    shares = covered(1000)
    assert 0.94 <= np.mean(list(shares.values())) <= 0.96, shares
    assert all(0.92 <= share <= 0.98 for share in shares.values()), shares


Change = Callable[[Curve, Law, np.random.Generator], Curve]
#: what goes wrong, and the mark that names it
FAULTS: dict[str, tuple[Change, str]] = {
    "late clock": (lambda curve, law, rng: late(curve, 3.0), "load_late"),
    "grip slips": (lambda curve, law, rng: slipped(curve, law, 20), "grip_slipped"),
    "grip slips at the knee": (lambda curve, law, rng: slipped(curve, law, 60), "grip_slipped"),
    "cross-talk": (lambda curve, law, rng: with_cross_talk(curve, rng, 3.0), "cross_talk"),
    "axes swapped": (lambda curve, law, rng: replace(curve, values=curve.values[[1, 0, 2]]), "channel_swapped"),
    "a temperature for the load": (
        lambda curve, law, rng: with_load(curve, 20.0 + rng.normal(size=len(law.strain))),
        "channel_swapped",
    ),
    "the travel for the load": (lambda curve, law, rng: with_load(curve, 3e4 * law.strain), "channel_swapped"),
    "broken": (lambda curve, law, rng: broken(curve), "failed"),
}
#: MPa, what is known of each material beforehand
EXPECTED = {name: np.array([0.8, 1.2]) * law.truth.get("modulus", 200_000.0) for name, law in LAWS.items()}


def with_load(curve: Curve, stress: Float) -> Curve:
    """Another channel in place of the load."""
    return replace(curve, values=np.stack([*curve.values[:2], stress]))


def named(card: Assessed) -> set[str]:
    """Codes of the marks, and of the reasons why numbers are missing."""
    return {mark.code for mark in card.marks} | {one.lack.code for one in card.numbers.values() if one.lack is not None}


def good_and_wrong(card: Assessed, law: Law) -> list[str]:
    """Numbers that are called good and are farther from the law's than chance takes them."""
    return [
        f"{key} {one.number.value:.5g} for {true:.5g}, u {one.number.u:.2g}"
        for key, true in law.truth.items()
        if (one := card.numbers[key]).number is not None
        and not one.doubts
        and abs(one.number.value - true) > 4.5 * one.number.u
    ]


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("fault", FAULTS)
def test_what_goes_wrong_is_named_and_no_number_is_good_and_wrong(fault: str, law: Law) -> None:
    change, code = FAULTS[fault]
    rng = np.random.default_rng(41)
    for _ in range(FAULTY):
        card = assessed(change(drawn(law, rng), law, rng), METALS, ASKED, EXPECTED[law.name])
        assert code in named(card), (fault, named(card))
        assert not good_and_wrong(card, law)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_sound_tests_have_no_doubtful_number(law: Law) -> None:
    rng = np.random.default_rng(42)
    cards = [assessed(drawn(law, rng), METALS, ASKED) for _ in range(DRAWS)]
    doubtful = [mark for card in cards for mark in card.marks if mark.spoils]
    # the checks call one sound test in some hundreds doubtful
    assert len(doubtful) <= 4, doubtful


def test_yield_points_and_elongation_are_those_of_a_steel_with_a_yield_drop() -> None:
    # up to 400 MPa, down to 360 and along at 365 to 2 % of strain, then up to 450 at 20 %, where it breaks
    e, nu = 200_000.0, 0.3
    strain = np.concatenate([np.zeros(3), np.linspace(0.0, 0.002, 161)[1:], np.linspace(0.0025, 0.2, 160)])
    stress = np.where(
        strain <= 0.002, e * strain, np.where(strain <= 0.02, 365.0, 365.0 + 85.0 * (strain - 0.02) / 0.18)
    )
    stress[np.flatnonzero(strain > 0.002)[0]] = 355.0  # swings through
    stress[np.flatnonzero(strain > 0.01)[0]] = 360.0
    law = Law("yield drop", strain, -nu * stress / e - 0.5 * (strain - stress / e), stress, {})
    rng = np.random.default_rng(43)
    card = assessed(broken(drawn(law, rng)), METALS, ASKED)
    truth = {"upper_yield": 400.0, "lower_yield": 360.0, "strength": 450.0, "elongation": 0.2 - 450.0 / e}
    for key, true in truth.items():
        number = card.numbers[key].number
        assert number is not None, (key, card.numbers[key].lack)
        assert abs(number.value - true) < 4.0 * number.u, (key, number)
        assert number.u < 0.02 * true, (key, number)


@pytest.mark.parametrize(
    ("steps", "key", "code"),
    [
        (slice(None, None, 20), "modulus", "too_few_steps"),
        (slice(None, 40), "proof", "not_reached"),
        (slice(None), "strength", "not_reached"),
        (slice(None), "r", "not_reached"),
        (slice(None), "upper_yield", "no_yield_point"),
        (slice(None), "elongation", "not_reached"),
    ],
)
def test_a_number_that_the_steps_do_not_have_is_missing_with_its_reason(steps: slice, key: str, code: str) -> None:
    curve = drawn(LAWS["voce"], np.random.default_rng(44))
    part = stated(*curve.values[:, steps], np.arange(curve.values[:, steps].shape[1], dtype=float))
    lack = assessed(part, METALS, ASKED).numbers[key].lack
    assert lack is not None
    assert lack.code == code


def test_the_shared_part_of_the_strain_is_not_averaged_away() -> None:
    """Ten times the steps: the noise' part falls by the root of ten, the part of the cameras stays."""
    parts = []
    for many in (200, 2000):
        strain = np.concatenate([[0.0], np.linspace(0.0, 0.004, many)])
        law = Law("linear", strain, -0.3 * strain, 70_000.0 * strain, {})
        number = assessed(drawn(law, np.random.default_rng(45)), METALS, ASKED).numbers["modulus"].number
        assert number is not None
        parts.append(number.parts)
    assert parts[1]["calibration"] == pytest.approx(0.002 * 70_000.0, rel=0.02)
    assert parts[0]["calibration"] == pytest.approx(parts[1]["calibration"], rel=0.02)
    assert parts[1]["strain"] == pytest.approx(parts[0]["strain"] / np.sqrt(10.0), rel=0.1)


def test_a_stated_lag_of_the_load_is_taken_out() -> None:
    law = LAWS["ramberg_osgood"]
    curve = late(drawn(law, np.random.default_rng(46)), 3.0)
    assert "load_late" in named(assessed(curve, METALS, ASKED))
    told = with_load_errors(curve, scale_u=0.0, offset_u_mpa=0.0, section_u=0.0, late_s=3.0, late_u_s=0.2)
    card = assessed(told, METALS, ASKED)
    assert "load_late" not in named(card)
    number = card.numbers["proof"].number
    assert number is not None
    assert number.parts["clock"] > 0.0
