"""A smooth misfit of any shape is no mismatch; a wrong match is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.checks.epipolar_mismatch import EpipolarLimits, epipolar_mismatches

ROWS, COLS, SPACING = 60, 80, 10.0
LIMITS = EpipolarLimits(5.0, 0.005)
NOISE_PX = 0.0034  # of a public pair at 33 px
SUBSET_PX = 33


def positions(rows: int = ROWS, cols: int = COLS) -> Float:
    y, x = np.mgrid[:rows, :cols]
    return np.stack([x.ravel(), y.ravel()], -1) * SPACING + 40.0


def noise(seed: int, sd: float = NOISE_PX, shape: tuple[int, int] = (ROWS, COLS)) -> Float:
    """White noise over subsets that overlap: averaged over a subset's width, with the stated standard deviation."""
    fine = np.random.default_rng(seed).standard_normal((shape[0] + 2, shape[1] + 2))
    wide = sum(fine[i : i + shape[0], j : j + shape[1]] for i in range(3) for j in range(3)) / 3.0
    return np.asarray(sd * wide).ravel()


def mismatches(e: Float, sigma: float | Float = NOISE_PX, ok: Bool | None = None, subset_px: int = SUBSET_PX) -> Bool:
    n = len(e)
    return epipolar_mismatches(
        e,
        np.broadcast_to(np.asarray(sigma), (n,)),
        np.ones(n, bool) if ok is None else ok,
        xy_px=positions(),
        shape=(ROWS, COLS),
        subset_px=subset_px,
        limits=LIMITS,
    )


def unit() -> tuple[Float, Float]:
    y, x = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLS * 1j]
    return x.ravel(), y.ravel()


def corners(height_px: float) -> Float:
    x, y = unit()
    far = np.maximum(np.hypot(x - 1, y - 1), 0.0)
    return np.asarray(height_px * (np.exp(-((far / 0.45) ** 2)) + np.exp(-(((np.hypot(x + 1, y + 1)) / 0.45) ** 2))))


SHAPES: dict[str, Callable[[], Float]] = {
    "constant": lambda: np.full(ROWS * COLS, 0.4),
    "roll": lambda: 1.0 * unit()[0],
    "fifth degree": lambda: 0.3 * (unit()[0] ** 5 - unit()[1] ** 5 + unit()[0] ** 3 * unit()[1] ** 2),
    "two corners": lambda: corners(0.15),
    "steep corners": lambda: 0.5 * (np.hypot(*unit()) / np.sqrt(2.0)) ** 6,
    "waves": lambda: 0.04 * np.sin(6.0 * unit()[0]) * np.cos(5.0 * unit()[1]),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_smooth_misfit_of_any_shape_is_no_mismatch(name: str) -> None:
    # 4800 points, limits of 5 standard deviations and 0.005 px: 6e-7 of normal errors lie beyond
    assert mismatches(SHAPES[name]() + noise(1)).sum() == 0


@pytest.mark.parametrize("name", SHAPES)
def test_a_wrong_match_is_found_on_any_smooth_misfit(name: str) -> None:
    e, rng = SHAPES[name]() + noise(2), np.random.default_rng(3)
    wrong = rng.random(len(e)) < 0.05
    # twice the limit of 5 sd and 0.005 px: whatever the noise of the point itself is
    e[wrong] += rng.choice([-1.0, 1.0], wrong.sum()) * rng.uniform(0.06, 2.0, wrong.sum())
    found = mismatches(e)
    assert found[wrong].all()
    assert (found & ~wrong).sum() == 0


def test_parts_of_a_region_may_differ_by_what_a_misfit_changes_between_them() -> None:
    x, y = unit()
    ok = (x < -0.3) | ((x > 0.6) & (y > 0.2))
    e = noise(4) + np.where(x > 0.0, 0.04, 0.0)
    assert mismatches(e, ok=ok).sum() == 0
    # a crack, and a step where the misfit is that of another place in camera 2's image
    assert mismatches(noise(5) + np.where(x + 0.3 * y > 0.1, 0.06, 0.0)).sum() == 0
    small = (x < 0.3) | ((x > 0.75) & (y > 0.75))  # 70 points
    assert mismatches(noise(4) + np.where(x > 0.3, 0.04, 0.0), ok=small).sum() == 0


@pytest.mark.parametrize("jump_px", [0.08, 0.3, -1.0])
def test_a_group_smaller_than_a_subset_that_agrees_with_itself_is_wrong(jump_px: float) -> None:
    # subsets 33 px wide on 10 px share pixels: nine points can be one wrong match
    e = noise(6).reshape(ROWS, COLS)
    wrong = np.zeros((ROWS, COLS), bool)
    corner = (57, 77) if abs(jump_px) > 0.1 else (53, 71)  # in the corner less could be a lens's
    for r, c in ((10, 10), (30, 50), (0, 40), corner):
        wrong[r : r + 3, c : c + 3] = True
    e[wrong] += jump_px
    found = mismatches(e.ravel()).reshape(ROWS, COLS)
    assert found[wrong].all()
    assert (found & ~wrong).sum() == 0


def test_a_large_group_off_by_more_than_any_lens_is_wrong() -> None:
    e = noise(7).reshape(ROWS, COLS)
    wrong = np.zeros((ROWS, COLS), bool)
    wrong[20:35, 30:50] = True
    e[wrong] += 0.5
    found = mismatches(e.ravel()).reshape(ROWS, COLS)
    assert found[wrong].all()
    assert (found & ~wrong).sum() == 0


def test_a_part_of_the_image_with_more_noise_is_judged_by_its_own() -> None:
    x, _ = unit()
    sigma = np.where(x > 0.2, 5.0, 1.0) * NOISE_PX
    e = noise(8) * sigma / NOISE_PX
    assert mismatches(e, sigma).sum() == 0
    # not told by the reported standard deviation, by up to three times
    assert mismatches(noise(9) * np.where(x > 0.2, 2.0, 1.0)).mean() < 1e-3


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_scattered_wrong_matches_do_not_hide_one_another(share: float) -> None:
    rng = np.random.default_rng(10)
    e = noise(11)
    wrong = rng.random(len(e)) < share
    e[wrong] = rng.uniform(-3.0, 3.0, wrong.sum())
    found = mismatches(e)
    far = wrong & (np.abs(e) > 0.06)
    assert found[far].all()
    # right points that stand alone among wrong ones may go
    assert (found & ~wrong).sum() / (~wrong).sum() < 0.01
