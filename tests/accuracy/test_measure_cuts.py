"""Cracks drawn as lines: both lips are measured up to the line, by their own side alone, as well as they say."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.field.region.find_visible import with_visibility
from stereorig.core.field.region.line_crossings import squared_distance
from stereorig.core.field.region.region import PointGrid
from stereorig.core.matching.fit import fit_motion
from stereorig.core.matching.options import MatchOptions
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.status import PointStatus
from stereorig.core.threads import available_threads, set_threads, threads
from stereorig.sim.catalog import make_scene
from stereorig.sim.panel import CrackedPanel
from stereorig.sim.rig import SimRig
from stereorig.sim.truth import truth_at
from tests.accuracy import test_measure_crack as panel
from tests.support import field_bench as bench
from tests.support.cut_scenes import STILL, below, opened, reference, true_uvw
from tests.support.requirements import ROOT

OPTIONS = MeasureOptions(subset_px=21, patch="affine")
X = np.linspace(0.0, 263.0, 41)
LINES = {
    "straight": np.array([(0.0, 107.3), (263.0, 118.1)]),
    "kinked": np.array([(0.0, 95.2), (110.4, 100.3), (150.7, 140.1), (263.0, 133.4)]),
    "curved": np.stack([X, 112.0 + 18.0 * np.sin(X / 42.0)], axis=-1),
}


def distance_px(points: NDArray[np.float64], cuts: Cuts) -> NDArray[np.float64]:
    flat = [min(squared_distance(x, y, piece) for piece in cuts.pieces_px) ** 0.5 for x, y in points.reshape(-1, 2)]
    return np.array(flat).reshape(points.shape[:2])


@pytest.mark.fault(37)
@pytest.mark.parametrize("kind", LINES)
def test_both_lips_stand_up_to_the_line(kind: str) -> None:
    line = LINES[kind]
    side = below(line)
    plain = bench.grid(spacing_px=5.0, margin_px=36.0)
    grid = plain.with_cracks([line])
    pair = ReferencePair(bench.pair(), *reference())
    current = opened(side)
    field = pair.motion(*current, grid, OPTIONS)
    away = distance_px(grid.xy_px, Cuts([line]))
    lips, true = away < 10.0, true_uvw(grid.xy_px, side)
    assert lips.sum() > 100
    without = pair.motion(*current, plain, OPTIONS)
    assert without.uvw_mm is not None
    over = without.valid & (away < 5.0)
    wrong = np.abs(without.uvw_mm - true)[over][:, :2].max(initial=0.0)
    assert over.sum() < 0.4 * (away < 5.0).sum() or wrong > 0.02
    # with the line nearly every point is valid
    assert field.uvw_mm is not None
    assert field.valid[lips].mean() > 0.97
    error = field.uvw_mm - true
    v = field.valid & lips
    share = error[v] / field.sigma_mm[v][:, 3:]
    assert np.abs(share).max() < 5.5
    assert 0.8 < np.sqrt(np.mean(share**2)) < 1.25
    assert np.abs(error[v][:, :2]).max() < 0.012  # the lips part by 120 um
    # far from it nothing changes but where growth came from
    both = field.valid & without.valid & (away > 18.0)
    assert both.sum() > 0.9 * (away > 18.0).sum()
    moved = np.abs(field.uvw_mm - without.uvw_mm)[both] / field.sigma_mm[both][:, 3:]
    assert moved.max() < 0.1
    assert field.cuts is grid.cuts


@pytest.mark.fault(37)
def test_a_crack_that_ends_inside_the_field() -> None:
    rig = SimRig.from_toml(ROOT / "config" / "sim_panel.toml")
    pair = StereoPair(panel.cut(rig.cam1.camera), panel.cut(rig.cam2.camera))
    before, after = make_scene(rig, "panel", load=0.0), make_scene(rig, "panel", load=35.6)
    model = CrackedPanel()
    along = np.linspace(-model.half_crack_mm, model.half_crack_mm, 21) * np.sqrt(0.5)
    line = pair.cam1.project(np.stack([along, -along, np.full_like(along, -model.bow_mm)], axis=-1)).xy
    columns, rows = panel.SIZE
    plain = PointGrid.rectangle(20, 20, columns - 21, rows - 21, spacing_px=5)
    images, current = panel.take(pair, before, rig, 1), panel.take(pair, after, rig, 2)
    field = ReferencePair(pair, *images).motion(*current, plain.with_cracks([line]), OPTIONS)
    without = ReferencePair(pair, *images).motion(*current, plain, OPTIONS)
    away = distance_px(plain.xy_px, Cuts([line]))
    assert without.valid[away < 8.0].mean() < 0.2
    assert field.valid.mean() > 0.98
    true = truth_at(before, pair.cam1, plain.xy_px, now=after)
    assert field.uvw_mm is not None
    v = field.valid & (away < 10.0)
    error = np.abs(field.uvw_mm - true.uvw_mm)[v]
    # the field at a crack's tips bends within a subset
    assert np.median(error[:, :2] / field.sigma_mm[v][:, 3:5]) < 1.0
    assert error[:, :2].max() < 0.02
    middle = np.abs(true.xyz_mm[..., 0]) < 20.0
    lower = field.y_px > np.interp(field.x_px, line[:, 0], line[:, 1])
    near = v & middle & (away < 6.0)
    opening = field.uvw_mm[near & lower].mean(axis=0) - field.uvw_mm[near & ~lower].mean(axis=0)
    expected = true.uvw_mm[near & lower].mean(axis=0) - true.uvw_mm[near & ~lower].mean(axis=0)
    np.testing.assert_allclose(opening[:2], expected[:2], atol=0.003)


@pytest.mark.fault(37)
def test_what_shows_through_a_hole_counts_for_nothing() -> None:
    """Another surface, which does not move, fills the hole in all four images."""
    hole = np.array([(95.5, 80.5), (160.5, 80.5), (160.5, 140.5), (95.5, 140.5)])
    behind = bench.take("sphere", 0.0, seed=9)
    images = [
        [i.copy() for i in bench.take("block", 1.0, STILL, seed=1)],
        [i.copy() for i in opened(lambda xy: xy[..., 0] < -1e9)],
    ]
    positions = bench.pair().cam2.project(truth_of(hole)).xy
    for state in images:
        for image, other, corners in zip(state, behind, (hole, positions), strict=True):
            # well inside: the rim of the body moves by a pixel or two
            (x0, y0), (x1, y1) = np.sort(corners, axis=0)[1:3].round().astype(int) + np.array([[4, 4], [-4, -4]])
            image[y0 : y1 + 1, x0 : x1 + 1] = other[y0 : y1 + 1, x0 : x1 + 1]
    plain = bench.grid(spacing_px=5.0)
    grid = plain.without_holes([hole])
    reference_pair = ReferencePair(bench.pair(), *images[0])
    field = reference_pair.motion(*images[1], grid, OPTIONS)
    inside = (plain.x_px > 95) & (plain.x_px < 161) & (plain.y_px > 80) & (plain.y_px < 141)
    assert (field.status[inside] == PointStatus.MASKED).all()
    rim = ~inside & (plain.x_px > 85) & (plain.x_px < 171) & (plain.y_px > 70) & (plain.y_px < 151)
    assert field.valid[rim].mean() > 0.97
    true = true_uvw(plain.xy_px, lambda xy: xy[..., 0] < -1e9)
    assert field.uvw_mm is not None
    share = (field.uvw_mm - true)[field.valid & rim] / field.sigma_mm[field.valid & rim][:, 3:]
    assert np.abs(share).max() < 5.5
    assert np.sqrt(np.mean(share**2)) < 1.3


def truth_of(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of the still block at positions of camera 1's image, system frame."""
    return truth_at(bench.scene("block", 1.0, STILL), bench.pair().cam1, positions).xyz_mm


def fields_equal(a: Field, b: Field) -> None:
    for name in ("status", "xyz_mm", "uvw_mm", "covariance", "zncc", "iterations"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.skipif(available_threads() < 2, reason="one processor")
def test_threads_change_no_digit() -> None:
    side = below(LINES["kinked"])
    current, before = opened(side), threads()
    fields = []
    try:
        for n in (1, 2):
            set_threads(n)
            grid = bench.grid(spacing_px=8.0, margin_px=36.0).with_cracks([LINES["kinked"]])
            fields.append(ReferencePair(bench.pair(), *reference()).motion(*current, grid, OPTIONS))
    finally:
        set_threads(before)
    fields_equal(*fields)


def test_points_away_from_the_line_are_the_same_to_the_digit() -> None:
    """From the same starts: what the kernels do for a point whose subset is whole does not know of the others."""
    grid = bench.grid(spacing_px=8.0, margin_px=36.0).with_cracks([LINES["straight"]])
    visibility = with_visibility(grid, 21).visibility
    assert visibility is not None
    xy = grid.xy_px.reshape(-1, 2)
    depth = bench.pair().cam1.cam_from_sys.apply(truth_of(xy))[:, 2]
    w = np.stack([1.0 / depth, np.zeros(len(xy)), np.zeros(len(xy))], axis=-1)
    images = (*reference(), *bench.take("block", 1.0, (0.0, 0.0, 0.01, 0.0, 0.0, 0.0), seed=4))
    options = MatchOptions(subset_px=21)
    cut = fit_motion(bench.pair(), *images, xy, w, None, options, visibility.at(xy))
    whole = fit_motion(bench.pair(), *images, xy, w, None, options)
    same = visibility.whole
    assert 100 < same.sum() < len(xy) - 50
    for name in ("w", "G", "covariance", "zncc", "noise", "iterations", "status"):
        a, b = getattr(cut, name), getattr(whole, name)
        np.testing.assert_array_equal(a[same], b[same])
    # the noise of a cut subset is counted by the pixels that are left: 2 grey levels, as it was made
    seen = ~same & (cut.status == PointStatus.OK) & (visibility.share > 0.3)
    assert seen.sum() > 40
    noise, expected = np.mean(cut.noise[seen] ** 2), np.mean(whole.noise[same & (whole.status == 0)] ** 2)
    assert 0.96 < np.sqrt(noise / expected) < 1.04
