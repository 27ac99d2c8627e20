"""Strain in one place: patches are quadratic there, and what bias remains is in the point's standard deviation."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.sequence.reference_steps import PreviousStep
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.support import field_bench
from tests.support.localised_strain import Motion, Strained, band, kink, necking, notch
from tests.support.matching_scene import Texture, digitise, paper_pair, render

SIZE, SUBSET = 230, 21
PAIR, TEXTURE = paper_pair(size=SIZE), Texture(extent_mm=6.0)
POINTS = PointGrid.rectangle(26, 26, SIZE - 27, SIZE - 27, spacing_px=9)
OPTIONS = MeasureOptions(subset_px=SUBSET)
Images = tuple[np.ndarray, np.ndarray]


def even(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 0.01 * a, -0.003 * b


SCENES: dict[str, Motion | None] = {
    "reference": None,
    "even": even,
    "neck 6 %": necking(0.05),
    "neck 28 %": necking(0.25),
    "kink 2 %": kink(0.02),
    "kink 4 %": kink(0.04),
    "kink 10 %": kink(0.1),
    "band 5 %": band(0.05),
    "band 20 %": band(0.2),
    "notch": notch(0.05),
    "kink 6 %, steep": kink(0.06, 3.0),
    "kink 3 %, steep": kink(0.03, 3.0),
    "neck 60 %": necking(0.54),
    "band 20 %, wide": band(0.2, 2.0, 55.0),
}


@lru_cache(maxsize=4)
def take(name: str) -> Images:
    state = Strained(SCENES[name], (0.01, 0.02, 0.03) if SCENES[name] else (0.0, 0.0, 0.0))
    rng = np.random.default_rng(list(SCENES).index(name))
    one, two = (
        digitise(render(camera, state, TEXTURE, size=SIZE, samples=2), noise=2.0, rng=rng)  # type: ignore[arg-type]
        for camera in (PAIR.cam1, PAIR.cam2)
    )
    return one, two


@lru_cache(maxsize=16)
def measured(name: str, patch: str = "auto") -> tuple[Field, np.ndarray]:
    """Return the field and its errors (r, c, 3), mm."""
    options = MeasureOptions(subset_px=SUBSET, patch=patch)  # type: ignore[arg-type]
    field = ReferencePair(PAIR, *take("reference")).motion(*take(name), POINTS, options)
    state = Strained(SCENES[name], (0.01, 0.02, 0.03))
    before = Strained().material(PAIR.cam1, POINTS.xy_px)
    assert field.uvw_mm is not None
    return field, field.uvw_mm - (state.position(before) - Strained().position(before))


@pytest.mark.parametrize(
    ("name", "share", "least"),
    [
        ("neck 6 %", 0.99, 0.75),
        ("neck 28 %", 0.98, 0.65),
        ("kink 2 %", 0.99, 0.75),
        ("neck 60 %", 0.98, 0.5),
        ("kink 10 %", 0.98, 0.6),  # on the line itself a subset shows two motions
        ("band 5 %", 0.99, 0.6),
        ("band 20 %", 0.97, 0.6),  # the band is as wide as a subset: where it has two borders, narrower ones measure it
        ("band 20 %, wide", 0.98, 0.55),
        ("notch", 0.97, 0.65),  # its strain reaches over the whole of so small a field: more than any noise scatters
    ],
)
def test_where_strain_is_localised_no_valid_point_is_far_off_and_right_points_stay(
    name: str, share: float, least: float
) -> None:
    field, error = measured(name)
    valid = field.valid
    assert valid.mean() > share
    off = np.abs(error[valid]) / field.sigma_mm[valid][:, 3:]
    assert off.max() < 6.0
    of_sigma = np.sqrt((error[valid] ** 2).mean(axis=0) / (field.sigma_mm[valid][:, 3:] ** 2).mean(axis=0))
    assert np.all((of_sigma > least) & (of_sigma < 1.15)), of_sigma


@pytest.mark.parametrize(("name", "most"), [("kink 6 %, steep", 6.0), ("kink 3 %, steep", 6.4)])
def test_on_the_line_of_a_kink_points_that_lie_dense_are_not_far_off(name: str, most: float) -> None:
    dense = PointGrid.rectangle(26, 26, SIZE - 29, SIZE - 29, spacing_px=5)
    field = ReferencePair(PAIR, *take("reference")).motion(*take(name), dense, OPTIONS)
    state, before = Strained(SCENES[name], (0.01, 0.02, 0.03)), Strained().material(PAIR.cam1, dense.xy_px)
    assert field.uvw_mm is not None
    off = np.abs(field.uvw_mm - (state.position(before) - Strained().position(before))) / field.sigma_mm[..., 3:]
    line = field.valid & (np.abs(before @ [np.cos(np.radians(3.0)), np.sin(np.radians(3.0))]) < 0.05)
    assert line.sum() > 20
    assert off[field.valid].max() < most
    assert np.sqrt((off[line] ** 2).mean(axis=0)).max() < 3.0


def test_even_strain_changes_nothing_to_the_last_bit() -> None:
    (chosen, _), (asked, _) = measured("even"), measured("even", "affine")
    assert chosen.patch_degree is None
    assert chosen.patch is not None
    assert chosen.patch.taken_off_mm is None
    assert np.array_equal(chosen.uvw_mm, asked.uvw_mm, equal_nan=True)  # type: ignore[arg-type]
    assert np.array_equal(chosen.covariance, asked.covariance, equal_nan=True)


@pytest.mark.parametrize("kpa", [344.5, 689.0, 1378.0])
def test_the_mean_of_a_plate_that_bends_less_than_noise_shows_is_not_short_and_its_patches_stay_plane(
    kpa: float,
) -> None:
    points, draws, errors = field_bench.grid(spacing_px=10.0), 2, []
    true = field_bench.truth(points, field_bench.scene("plate"), field_bench.scene("plate", kpa)).uvw_mm
    for seed in range(draws):
        reference = ReferencePair(field_bench.pair(), *field_bench.take("plate", seed=seed))
        field = reference.motion(*field_bench.take("plate", kpa, seed=seed), points, OPTIONS)
        assert field.patch is not None
        assert field.uvw_mm is not None
        assert field.patch_degree is None
        assert field.patch.patch == "affine"
        assert field.valid.all()
        errors.append((field.uvw_mm - true) / field.sigma_mm[..., 3:])
    # plane patches alone are short by 0.3, 0.6 and 1.2 of a point's noise in w
    independent = draws * points.xy_px[..., 0].size / (SUBSET / 10.0) ** 2
    assert np.all(np.abs(np.mean(errors, axis=(0, 1, 2))) < 4.0 / np.sqrt(independent))
    assert np.all(np.abs(np.sqrt(np.mean(np.square(errors), axis=(0, 1, 2))) - 1.0) < 0.12)


def test_away_from_a_kink_patches_stay_plane_and_as_precise_and_the_file_says_which_are_not(tmp_path: Path) -> None:
    field, error = measured("kink 2 %")
    degree = field.patch_degree
    assert degree is not None
    assert field.patch is not None
    assert field.patch.patch == "affine"
    assert "where strain is localised" in field.patch.reason
    ab = Strained().material(PAIR.cam1, POINTS.xy_px)
    away = np.abs(ab @ [np.cos(np.radians(12.0)), np.sin(np.radians(12.0))]) / 0.033
    assert (degree[field.valid & (away > 45.0)] == 1).mean() > 0.97
    assert (degree[field.valid & (away < 8.0)] == 2).all()
    spread = error[field.valid & (degree == 1)].std(axis=0)
    assert np.all(spread < 1.15 * measured("even")[1].std(axis=(0, 1)))
    write_field(tmp_path / "step_0001.nc", field, Provenance({}, {}, "test"))
    read = read_field(tmp_path / "step_0001.nc").patch_degree
    assert read is not None
    np.testing.assert_array_equal(read, degree)


@pytest.mark.parametrize("cut", [None, Cuts([[(115.0, 60.0), (115.0, 170.0)]])])
def test_points_of_narrower_subsets_are_said_and_none_is_where_the_user_asked_for_a_patch(cut: Cuts | None) -> None:
    points = replace(POINTS, cuts=cut)
    reference, found = ReferencePair(PAIR, *take("reference")), {}
    for patch in ("auto", "quadratic"):
        options = MeasureOptions(subset_px=SUBSET, patch=patch, keep_rejected=True)  # type: ignore[arg-type]
        found[patch] = reference.motion(*take("band 20 %"), points, options)
    narrower, asked = found["auto"], found["quadratic"]
    assert narrower.patch is not None
    said = re.search(r"subsets of 13 px at (\d+) points", narrower.patch.reason)
    assert said is not None
    assert int(said[1]) >= 10
    assert asked.patch is not None
    assert "subsets of" not in asked.patch.reason
    assert narrower.valid.mean() > 0.94  # some subsets are cut by more than half
    assert narrower.valid.sum() > asked.valid.sum() + 10
    # a point has numbers once: as a valid or as a rejected one
    assert narrower.rejected is not None
    assert not np.isfinite(narrower.rejected.zncc[narrower.valid]).any()
    assert np.isfinite(narrower.covariance[narrower.valid]).all()


def test_quadratic_patches_under_strain_are_not_reported_twice_too_wide() -> None:
    field, error = measured("neck 28 %", "quadratic")
    ratio = np.median(np.abs(error[field.valid]) / field.sigma_mm[field.valid][:, 3:], axis=0) / 0.6745
    assert np.all((ratio > 0.65) & (ratio < 1.15)), ratio


def test_steps_matched_against_later_references_say_which_patches_are_quadratic() -> None:
    names = ("reference", "kink 2 %", "kink 4 %")
    reference = ReferencePair(PAIR, *take("reference"))
    shape = reference.shape(POINTS, OPTIONS)
    fields: list[Field] = [shape]
    images = [(MeasureImage(one, "camera 1"), MeasureImage(two, "camera 2")) for one, two in map(take, names)]
    chain = reference.sequence(
        shape, POINTS, OPTIONS, reference_update="always", images_of=lambda n: images[n], field_of=lambda n: fields[n]
    )
    for n in (1, 2):
        fields.append(chain.measure(images[n], None if n == 1 else PreviousStep(n - 1, fields[n - 1])))
    last = fields[2]
    assert last.references is not None
    assert last.patch_degree is not None
    assert (last.patch_degree[last.valid] > 0).all()
    assert (last.patch_degree == 2).any()
