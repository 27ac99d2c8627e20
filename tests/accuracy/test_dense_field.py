"""Dense fields against built truth: bias, noise and coverage, and no vector over a crack, a hole or a step."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.dense.field import dense_motion, dense_shape
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.sim.truth import Truth
from tests.support import field_bench as bench
from tests.support.cut_scenes import below, opened, reference, true_uvw
from tests.support.relief_rig import PLATEAU, Body, Feature, Texture, two_cameras
from tests.support.relief_truth import Part

OPTIONS = MeasureOptions(subset_px=21, patch="affine")
STEP_PX = 2
BEND = np.array([(0.0, 95.2), (110.4, 100.3), (150.7, 140.1), (263.0, 133.4)])
CENTRE, RADIUS = np.array([131.0, 110.0]), 24.0


def dense_pair(
    grid: PointGrid, first: bench.Images, second: bench.Images, options: MeasureOptions = OPTIONS
) -> tuple[Field, Field, Field, Field]:
    """Ordinary shape and motion, dense shape and motion."""
    images = [MeasureImage(image) for image in (*first, *second)]
    pair = ReferencePair(bench.pair(), images[0], images[1])
    shape = pair.shape(grid, options)
    motion = pair.motion(images[2], images[3], grid, options, shape=shape)
    dense = dense_shape(bench.pair(), images[:2], shape, grid, options, step_px=STEP_PX)
    return shape, motion, dense, dense_motion(
        bench.pair(), images, shape, motion, dense, grid, options, step_px=STEP_PX
    )  # fmt: skip


def points_of(field: Field) -> PointGrid:
    x, y = field.x_px, field.y_px
    return PointGrid(x, y, np.ones(x.shape, bool), float(STEP_PX), (x[0, 0], y[0, 0], x[-1, -1], y[-1, -1]))


@lru_cache(maxsize=1)
def plates(runs: int = 3) -> tuple[list[tuple[Field, Field, Field, Field]], Truth, Truth]:
    """A clamped plate under pressure, whose deflection bends within a subset, with fresh noise in each run."""
    grid = bench.grid(spacing_px=8.0, margin_px=28.0)
    before, now = bench.scene("plate", 0.0), bench.scene("plate", 689.0)
    found = [
        dense_pair(grid, bench.take("plate", 0.0, seed=seed), bench.take("plate", 689.0, seed=seed))
        for seed in range(runs)
    ]
    return found, bench.truth(grid, before, now), bench.truth(points_of(found[0][3]), before, now)


def errors(fields: list[Field], truth: Truth) -> NDArray[np.float64]:
    """Of X, Y, Z and U, V, W, (runs, r, c, 6) mm."""
    return np.stack([np.concatenate([f.xyz_mm - truth.xyz_mm, f.uvw_mm - truth.uvw_mm], axis=-1) for f in fields])


def test_a_dense_field_has_the_ordinary_ones_noise_and_neither_has_plane_patches_bias() -> None:
    runs, at_points, at_vectors = plates()
    ordinary = errors([run[1] for run in runs], at_points)
    dense = errors([run[3] for run in runs], at_vectors)
    random = [np.sqrt(np.nanmean(np.var(e, axis=0, ddof=1), axis=(0, 1))) for e in (ordinary, dense)]
    # 567 points of 20 independent subsets' area, three runs: 4 % of a standard deviation
    assert (random[1] < 1.12 * random[0]).all()
    assert (random[1] > 0.88 * random[0]).all()
    bias = [abs(float(np.nanmean(e[..., 5]))) for e in (ordinary, dense)]
    # plane patches flatten the deflection by half its curvature times their second moment, some 0.12 um: taken off
    assert max(bias) < 3e-5


def test_reported_uncertainty_holds_for_dense_vectors() -> None:
    runs, _, at_vectors = plates()
    fields = [run[3] for run in runs]
    off = errors(fields, at_vectors) / np.stack([f.sigma_mm for f in fields])
    assert 0.85 < np.sqrt(np.nanmean(off**2)) < 1.15
    share = float((np.abs(off[np.isfinite(off)]) < 2.0).mean())
    assert 0.92 < share < 0.98  # 0.954 of a normal distribution
    assert np.nanmax(np.abs(off)) < 6.0
    # nearly all that lies between measured points is there
    assert all(f.valid.mean() > 0.93 for f in fields)


def test_at_the_ordinary_points_a_dense_vector_and_its_sigma_are_the_ordinary_ones() -> None:
    _, motion, _, dense = plates()[0][0]
    there = np.s_[:: round(8 / STEP_PX), :: round(8 / STEP_PX)]
    apart = (dense.uvw_mm[there] - motion.uvw_mm) / motion.sigma_mm[..., 3:]
    # the same pixels: what differs is the patches' bias, and slopes that the one fits and the other predicts
    assert np.sqrt(np.nanmean(apart[..., :2] ** 2)) < 0.35
    ratio = dense.sigma_mm[there] / motion.sigma_mm
    assert np.nanquantile(ratio, 0.01) > 0.9
    assert np.nanquantile(ratio, 0.99) < 1.1


def wrong(field: Field, true: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Vectors further from the truth than noise takes them: 6 sigma, or 0.3 px."""
    off = np.abs(field.uvw_mm - true)
    return field.valid & ((off > 6.0 * field.sigma_mm[..., 3:]).any(axis=-1) | (off > 0.010).any(axis=-1))


def inside(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.hypot(*np.moveaxis(xy - CENTRE, -1, 0)) < RADIUS


@pytest.mark.fault(37)
@pytest.mark.parametrize("drawn", [True, False])
@pytest.mark.parametrize("kind", ["crack", "hole"])
def test_no_vector_is_wrong_beside_a_crack_or_a_hole(kind: str, drawn: bool) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    rim = CENTRE + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    side = below(BEND) if kind == "crack" else inside
    grid = bench.grid(spacing_px=5.0, margin_px=30.0)
    if drawn:
        grid = grid.with_cracks([BEND]) if kind == "crack" else grid.without_holes([rim])
    _, motion, _, dense = dense_pair(grid, reference(), opened(side))
    xy = np.stack([dense.x_px, dense.y_px], axis=-1)
    assert not wrong(dense, true_uvw(xy, side)).any()
    # and where the ordinary points of both sides are, but a subset from the line, there are vectors
    assert dense.valid.mean() > 0.4
    sides = side(xy)
    assert (dense.valid & ~sides).sum() > 500
    assert kind == "hole" or (dense.valid & sides).sum() > 500
    assert motion.valid.mean() > dense.valid.mean() - 0.05


@pytest.mark.deep
@pytest.mark.fault(37)
def test_no_vector_of_a_shape_is_wrong_beside_a_step() -> None:
    # a high and a low plateau, 8 px a mm and 6 px of disparity a mm of height
    high, low = (Feature(PLATEAU, (x, 0.0), (4.5, 8.0), height) for x, height in ((-8.0, 5.0), (7.0, 0.4)))
    part = Part(two_cameras((320, 250)), (Body((high, low), texture=Texture(wavelength_mm=0.7)),))
    images = [MeasureImage(image) for image in part.images()]
    grid = PointGrid.rectangle(14.0, 14.0, 282.0, 214.0, spacing_px=5.0)
    options = MeasureOptions(subset_px=21, patch="affine")
    shape = ReferencePair(part.pair, *images).shape(grid, options)
    dense = dense_shape(part.pair, images, shape, grid, options, step_px=STEP_PX)
    found = part.beside_truth(dense, points_of(dense), 21)
    assert found.wrong == 0
    assert len(set(found.face[dense.valid].tolist())) >= 2  # both plateaus
    assert dense.valid.mean() > 0.2
