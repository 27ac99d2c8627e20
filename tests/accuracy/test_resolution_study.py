"""The resolution study: transfer against least squares, noise against what was drawn, the choice by brute force."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereorig.core.errors import StereorigError
from stereorig.core.field.points.result import Field
from stereorig.core.progress import no_progress
from stereorig.server.evaluations.door import evaluate
from stereorig.server.evaluations.resolution.document import ResolutionFound
from stereorig.server.evaluations.resolution.evaluation import ResolutionStudy
from stereorig.server.evaluations.resolution.noise import scatter
from stereorig.server.evaluations.resolution.transfer import l10_px, patch_filter, slope_filter
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support.cracked_sheet import drawn
from tests.support.gauge_field import SIGMA, SUBSET, make_field

MM_PER_PX = 0.02 * np.hypot(1.0, 0.1)  # of the field, whose surface climbs by 0.1 along Y


def least_squares(width: int, order: int, period: float) -> float:
    """The middle of a patch that is fitted to a cosine along x."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(width) - width // 2] * 2))
    terms = [np.ones(x.shape), x, y] + ([x * x, x * y, y * y] if order == 2 else [])
    return float(np.linalg.lstsq(np.stack(terms, axis=1), np.cos(2.0 * np.pi * x / period), rcond=None)[0][0])


def bisected(left: Any, low: float, high: float) -> float:
    """The period at which 0.9 is left."""
    for _ in range(50):
        low, high = (0.5 * (low + high), high) if left(0.5 * (low + high)) < 0.9 else (low, 0.5 * (low + high))
    return high


@pytest.mark.parametrize(("order", "in_subsets"), [(1, 3.99), (2, 1.29)])
def test_l10_of_a_patch_is_that_of_its_least_squares_fit(order: int, in_subsets: float) -> None:
    found = l10_px([patch_filter(33, order)])
    true = bisected(lambda period: least_squares(33, order, period), 33.0, 33.0 * 6)
    assert found == pytest.approx(true, rel=1e-6)
    # the known factors are for a subset of many pixels; 1 / 33^2 is 0.1 %
    assert found / 33.0 == pytest.approx(in_subsets, rel=0.01)


def test_l10_of_a_strain_is_that_of_a_line_through_fitted_patches() -> None:
    width, spacing, window = 21, 7, 5
    at = spacing * (np.arange(window) - window // 2)

    def left(period: float) -> float:
        # u = sin(k x) / k has the strain cos(k x); each patch keeps a share of u, a line goes through them
        turn = 2.0 * np.pi / period
        seen = least_squares(width, 1, period) * np.sin(turn * at) / turn
        return float(np.polyfit(at, seen, 1)[0])

    found = l10_px([patch_filter(width, 1), slope_filter(window, spacing)])
    assert found == pytest.approx(bisected(left, 60.0, 400.0), rel=1e-6)


def still(seed: int, copies: int, rows: int = 40, cols: int = 40) -> list[Field]:
    """Fields of a surface at rest, with noise as they state it."""
    field = make_field(lambda x: x + 0.0, rows=rows, cols=cols, growing=False)
    return drawn(field, np.random.default_rng(seed), copies)


def study(tmp_path: Path, fields: list[Field], label: str = "static", **asked: Any) -> ResolutionFound:
    files = []
    for n, field in enumerate(fields, 1):
        files.append(tmp_path / f"step_{n:04d}.nc")
        write_field(files[-1], field, Provenance({"subset_px": SUBSET}, {}, "1", step=n, extra={"label": label}))
    made: Any = ResolutionStudy()
    document = evaluate(made, files, asked, no_progress).document
    assert isinstance(document, ResolutionFound)
    return document


def test_noise_is_what_was_drawn_and_what_is_reported(tmp_path: Path) -> None:
    card = study(tmp_path, still(1, 4), spacing_multiples=[1], strain_windows=[5, 9])
    for k, name in enumerate("uvw"):
        noise, ratio = card.displacement[f"noise_{name}"], card.displacement[f"ratio_{name}"]
        assert noise.value is not None
        assert noise.u is not None
        assert abs(noise.value - SIGMA[3 + k]) < 4.0 * noise.u
        assert noise.u < 0.1 * noise.value
        assert ratio.value == pytest.approx(noise.value / SIGMA[3 + k])
    assert not card.marks
    assert card.l10_mm == pytest.approx(3.99 * SUBSET * MM_PER_PX, rel=0.01)
    for one in card.settings:
        noise, ratio = one.numbers["noise_exx"], one.numbers["ratio_exx"]
        assert noise.value is not None
        assert ratio.value is not None
        assert ratio.u is not None
        assert abs(ratio.value - 1.0) < 4.0 * ratio.u
        assert one.numbers["mei_exx"].value == pytest.approx(noise.value * one.l10_mm**2)
    assert card.settings[0].l10_mm < card.settings[1].l10_mm


def test_the_stated_uncertainty_of_a_scatter_is_its_own_scatter() -> None:
    found = []
    for field in still(2, 40):
        assert field.uvw_mm is not None
        one = scatter([field.uvw_mm[..., 0]], [field.uvw_mm[..., 0]], SUBSET, 7.0)
        assert one is not None
        found.append((one.sd, one.u))
    sd, u = np.array(found).T
    # a standard deviation of 40 is known to 11 %; the count of independent values is a rule of thumb
    assert 0.5 < np.std(sd, ddof=1) / np.mean(u) < 1.5
    assert np.mean(sd) == pytest.approx(SIGMA[3], rel=0.05)


def test_the_chosen_setting_is_near_the_best_of_many_static_pairs(tmp_path: Path) -> None:
    asked: dict[str, Any] = {"spacing_multiples": [1, 2], "strain_windows": [3, 5, 7, 9], "smallest_feature_mm": 4.0}
    few, many = tmp_path / "few", tmp_path / "many"
    few.mkdir()
    many.mkdir()
    card, sure = study(few, still(3, 2), **asked), study(many, still(4, 16), **asked)
    assert card.chosen is not None
    assert card.verdict == "met"

    def loudest(one: Any) -> float:
        return max(one.numbers[f"noise_{name}"].value or np.inf for name in ("exx", "eyy", "exy"))

    able = [one for one in sure.settings if one.l10_mm <= 4.0]
    assert 1 <= len(able) < len(sure.settings)
    same = next(
        one
        for one in able
        if (one.spacing_px, one.strain_window) == (card.chosen.spacing_px, card.chosen.strain_window)
    )
    assert loudest(same) <= 1.1 * min(loudest(one) for one in able)
    assert study(few, still(3, 2), **asked, strain_noise=1e-6).verdict == "not met"


def test_a_pair_that_bent_is_marked(tmp_path: Path) -> None:
    bent = [
        replace(field, uvw_mm=field.uvw_mm + [0.0, 0.0, 0.02] * (field.x_px[..., None] / 200.0) ** 2)
        for field in still(5, 2)
        if field.uvw_mm is not None
    ]
    assert [mark.code for mark in study(tmp_path, bent, strain_windows=[5]).marks] == ["noise_differs_w"]


@pytest.mark.parametrize(
    ("rows", "label", "asked", "code"),
    [
        (40, "loaded", {}, "static_missing"),
        (40, "static", {"static_steps": [7]}, "step_missing"),
        (40, "static", {"strain_windows": [4]}, "evaluation_settings"),
        (3, "static", {}, "too_few_points"),
    ],
)
def test_what_is_missing_is_refused_with_a_remedy(
    tmp_path: Path, rows: int, label: str, asked: dict[str, Any], code: str
) -> None:
    with pytest.raises(StereorigError) as error:
        study(tmp_path, still(6, 1, rows=rows, cols=30), label, **asked)
    assert error.value.code == code
    assert error.value.remedy
