"""The resolution study over rendered stereo images: l10 of a star, subsets measured anew, what a gauge loses."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.server.cli.main import main
from stereorig.server.evaluations.resolution.evaluation import ResolutionStudy
from stereorig.server.evaluations.resolution.settings import ResolutionSettings
from stereorig.server.evaluations.resolution.transfer import l10_px, patch_filter
from tests.accuracy.test_resolution_study import bisected, least_squares, still, study
from tests.support.copied_tests import write_test_of
from tests.support.gauge_field import STEP, SUBSET
from tests.support.matching_scene import Plane, Texture, digitise, render

SIZE = 420
PHD_PX, AWAY_MM = 5400.0, 390.0
MM_PER_PX = AWAY_MM / PHD_PX
NEAR_PX = 72
#: patch, its order, and the periods of its star about its l10 of 84 and 27 px
STARS: list[tuple[Any, int, float, float]] = [("affine", 1, 65.0, 105.0), ("quadratic", 2, 21.0, 34.0)]
TEXTURE = Texture(blob_mm=1.5 * MM_PER_PX, extent_mm=20.0)
pytestmark = pytest.mark.timeout(600)


def stereo() -> StereoPair:
    """Two lenses without distortion, 10 degrees to both sides of the normal of the plane z = 0."""

    def camera(turn_deg: float) -> Camera:
        return Camera.from_paper(
            phd_px=PHD_PX,
            cx_px=0.5 * SIZE,
            cy_px=0.5 * SIZE,
            kappa_per_px2=0.0,
            aspect=1.0,
            alpha_rad=0.0,
            beta_rad=0.0,
            gamma_rad=np.radians(turn_deg),
            x0_mm=0.0,
            y0_mm=0.0,
            z0_mm=AWAY_MM,
        )

    return StereoPair(camera(-10.0), camera(10.0))


@dataclass(frozen=True)
class Star(Plane):
    """b moves by A cos(2 pi b / p); the period p grows along a from ``low_mm`` to ``high_mm``."""

    low_mm: float = 1.0
    high_mm: float = 2.0
    size_mm: float = 0.0

    def period(self, a: Float) -> Float:
        return self.low_mm + (self.high_mm - self.low_mm) * np.clip(a / (0.9 * SIZE * MM_PER_PX) + 0.5, 0.0, 1.0)

    def material(self, camera: Camera, xy: Float) -> Float:
        at = super().material(camera, xy)
        a, seen = at[..., 0], at[..., 1]
        b = seen
        for _ in range(12):  # each step is nearer by the strain, a few percent
            b = seen - self.size_mm * np.cos(2.0 * np.pi * b / self.period(a))
        return np.stack([a, b], axis=-1)


def star_over_theory(patch: Any, order: int, low: float, high: float) -> float:
    """l10 that a star shows over that of the least-squares fit; its periods grow from ``low`` to ``high`` px.

    Far from its middle line the waves run askew, and a subset loses more of them: only points near the line are taken.
    """
    pair, rng = stereo(), np.random.default_rng(1)
    size_mm = 0.15 * MM_PER_PX
    star = Star(low_mm=low * MM_PER_PX, high_mm=high * MM_PER_PX, size_mm=size_mm)
    images = [
        [
            digitise(render(camera, plane, TEXTURE, size=SIZE, samples=3), noise=0.0, rng=rng)
            for camera in (pair.cam1, pair.cam2)
        ]
        for plane in (Plane(), star)
    ]
    grid, options = (
        PointGrid.rectangle(30, 0.5 * SIZE - NEAR_PX, SIZE - 31, 0.5 * SIZE + NEAR_PX, spacing_px=9),
        MeasureOptions(subset_px=SUBSET, patch=patch),
    )
    reference = ReferencePair(pair, *images[0])
    field = reference.motion(*images[1], grid, options, shape=reference.shape(grid, options))
    assert field.uvw_mm is not None
    good = field.valid
    assert good.mean() > 0.95
    a, b, moved = field.xyz_mm[good, 0], field.xyz_mm[good, 1], field.uvw_mm[good, 1]
    period = star.period(a)
    table = np.geomspace(0.4 * low, 2.5 * high, 300)
    left = np.array([least_squares(SUBSET, order, one) for one in table])

    def misfit(longer: float) -> float:
        # the transfer of a filter whose l10 is so many times longer
        share = np.interp(period / MM_PER_PX / longer, table, left)
        return float(np.sum((moved - size_mm * share * np.cos(2.0 * np.pi * b / period)) ** 2))

    return float(minimize_scalar(misfit, bounds=(0.7, 1.4), method="bounded").x)


@pytest.mark.parametrize(("patch", "order", "low", "high"), STARS)
def test_l10_of_a_star_rendered_in_stereo_is_the_transfers(patch: Any, order: int, low: float, high: float) -> None:
    theory = bisected(lambda one: least_squares(SUBSET, order, one), 0.5 * low, 1.5 * high)
    assert l10_px([patch_filter(SUBSET, order)]) == pytest.approx(theory, rel=1e-6)
    assert star_over_theory(patch, order, low, high) == pytest.approx(1.0, abs=0.03)


PAIRS, NOISE, ROI = 10, 4.0, (40, 40, 379, 379)


@pytest.fixture(scope="module")
def static(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StereoPair, list[list[Any]]]:
    """A test with two static pairs, measured with 21 px, and the images of many more."""
    pair, rng = stereo(), np.random.default_rng(2)
    clean = [render(camera, Plane(), TEXTURE, size=SIZE, samples=3) for camera in (pair.cam1, pair.cam2)]
    images = [[digitise(one, noise=NOISE, rng=rng) for one in clean] for _ in range(PAIRS + 1)]
    folder = tmp_path_factory.mktemp("static")
    write_test_of(folder / "test", pair, images[:3])
    region = ["--roi", ",".join(map(str, ROI)), "--subset", "21", "--step", "7", "--patch", "affine"]
    assert main(["measure", str(folder / "test"), *region, "--out", str(folder / "results")]) == 0
    return folder, pair, images


def card_of(folder: Path, capsys: pytest.CaptureFixture[str], **asked: Any) -> dict[str, Any]:
    given = [part for name, value in asked.items() for part in ("--set", f"{name}={json.dumps(value)}")]
    capsys.readouterr()
    main(["evaluate", "resolution", str(folder), "--set", "static_steps=[1,2]", *given, "--json"])
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_the_setting_chosen_of_several_subsets_is_near_the_best_by_brute_force(
    static: tuple[Path, StereoPair, list[list[Any]]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, pair, images = static
    windows, feature = [3, 5, 7], 15.0
    card = card_of(
        folder / "results",
        capsys,
        subsets_px=[15, 31],
        spacing_multiples=[1],
        strain_windows=windows,
        smallest_feature_mm=feature,
    )
    assert [one["subset_px"] for one in card["subsets"]] == [21, 15, 31]
    assert len(card["settings"]) == 9
    assert not card["marks"]
    rows = {one["item"]: one["value"] for one in card["reporting"]}
    assert rows["Stereo-angle"] == "20 degrees"
    assert rows["Subset size"] == f"{card['chosen']['subset_px']} px"
    assert rows["Lens"] is None
    # blobs of 1.5 px (sd) under a tanh: an autocorrelation of 2 sqrt(ln 2) 2 sd = 5 px at half of its height
    assert float(rows["Pattern feature size"].split()[0]) == pytest.approx(4.0 * np.sqrt(np.log(2.0)) * 1.5, rel=0.15)
    loudest: dict[tuple[int, int], float] = {}
    for subset in (15, 21, 31):
        grid, options = PointGrid.rectangle(*ROI, spacing_px=7), MeasureOptions(subset_px=subset, patch="affine")
        reference = ReferencePair(pair, *images[0])
        shape = reference.shape(grid, options)
        fields = [reference.motion(*one, grid, options, shape=shape) for one in images[1:]]
        noise = np.sqrt(np.mean([np.nanvar(one.uvw_mm, axis=(0, 1)) for one in fields], axis=0))
        of_card = next(one for one in card["subsets"] if one["subset_px"] == subset)["numbers"]
        for k, name in enumerate("uvw"):
            number = of_card[f"noise_{name}"]
            assert abs(number["value"] - noise[k]) < 4.0 * number["u"] + 0.05 * noise[k], (subset, name)
        for window in windows:
            strains = [surface_strain(one, StrainOptions(window=window), subset_px=subset).strain for one in fields]
            loudest[subset, window] = float(np.sqrt(np.nanmean(np.square(strains), axis=(0, 1, 2)).max()))
    able = {(one["subset_px"], one["strain_window"]) for one in card["settings"] if one["l10_mm"] <= feature}
    assert 1 <= len(able) < 9
    chosen = card["chosen"]["subset_px"], card["chosen"]["strain_window"]
    assert loudest[chosen] <= 1.1 * min(loudest[one] for one in able), (chosen, loudest)


def test_without_the_images_the_measured_subset_alone_is_studied_and_this_is_said(
    static: tuple[Path, StereoPair, list[list[Any]]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = static[0]
    image = folder / "test" / "steps" / "0002" / "cam1.tif"
    held = image.read_bytes()
    image.unlink()
    try:
        card = card_of(folder / "results", capsys, subsets_px=[15], strain_windows=[5])
    finally:
        image.write_bytes(held)
    assert [one["subset_px"] for one in card["subsets"]] == [21]
    assert [mark["code"] for mark in card["marks"]] == ["images_missing"]


def test_what_a_gauge_loses_at_the_steepest_place_is_that_of_a_wave(tmp_path: Path) -> None:
    """A wave of strain along x, as plane patches see it: its crests are too low by what the window and they lose."""
    static = [replace(one, uvw_mm=0.01 * one.uvw_mm) for one in still(3, 2, rows=60, cols=60) if one.uvw_mm is not None]
    period_px, height, window = 260.0, 0.01, 5
    turn = 2.0 * np.pi / period_px
    x = static[0].x_px - 250.0
    # 0.02 mm a pixel along x
    u = least_squares(SUBSET, 1, period_px) * height * 0.02 * np.sin(turn * x) / turn
    field: Field = replace(static[0], uvw_mm=np.stack([u, 0.0 * u, 0.0 * u], axis=-1))
    card = study(tmp_path, [*static, field], static_steps=[1, 2], spacing_multiples=[1], strain_windows=[window])
    assert card.steepest_step == 3
    one = card.settings[0]
    at = STEP * (np.arange(window) - window // 2)
    kept = float(np.polyfit(at, least_squares(SUBSET, 1, period_px) * np.sin(turn * at) / turn, 1)[0])
    found = one.numbers["bias_exx"]
    assert found.state == "good"
    assert found.value is not None
    assert found.u is not None
    # the second derivative is seen through the same gauge and a window of its own: a few percent too small
    assert abs(found.value) == pytest.approx(height * (1.0 - kept), rel=0.15, abs=3.0 * found.u)
    # crests and troughs lie a half period apart
    away = (one.steepest_px["bias_exx"][0] - 250.0) / (0.5 * period_px)
    assert abs(away - round(away)) < 0.1
    assert one.numbers["bias_eyy"].state == "doubtful"
    lost = card.displacement["bias_u"]
    assert lost.value is not None
    assert abs(lost.value) == pytest.approx(
        height * 0.02 / turn * (1.0 - least_squares(SUBSET, 1, period_px)), rel=0.15, abs=3.0 * (lost.u or 0.0)
    )


def test_static_steps_alone_have_no_steepest_place(tmp_path: Path) -> None:
    card = study(tmp_path, still(3, 2), strain_windows=[5], spacing_multiples=[1])
    assert card.steepest_step is None
    assert card.settings[0].numbers["bias_exx"].why.startswith("no_loaded_step")
    assert ResolutionStudy.settings is ResolutionSettings
