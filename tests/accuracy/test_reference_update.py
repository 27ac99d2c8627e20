"""Long sequences: later references, totals composed from them, their error, and points that come back."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.errors import SeedError
from stereorig.core.field.points.assemble import assemble
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.field.sequence.compose import Totals, common_share, follow, since, totals_of
from stereorig.core.measure import MeasureOptions, PreviousStep, ReferencePair
from stereorig.core.status import PointStatus
from tests.bench.accuracy.paper_rig import turn
from tests.support import field_bench
from tests.support import sequence_bench as bench
from tests.support.cut_scenes import below, opened, true_uvw
from tests.support.cut_scenes import reference as crack_reference

PX_UM = 39.0


def random_plane_motions(n: int) -> tuple[np.ndarray, ...]:
    """Rays, planes 1/Z = w . (1, X, Y), and two affine motions of space: the motion of planes that stay planes."""
    rng = np.random.default_rng(5)
    rays = np.concatenate([rng.uniform(-0.03, 0.03, (n, 2)), np.ones((n, 1))], axis=1)
    w = np.concatenate([rng.uniform(1.8e-3, 2.2e-3, (n, 1)), rng.uniform(-1e-3, 1e-3, (n, 2))], axis=1)
    motions = []
    for _ in range(2):
        R = turn(rng.normal(size=3), 0.4).rotation @ (np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
        motions.append((R, rng.normal(size=3) * 3.0 + (np.eye(3) - R) @ np.array([0.0, 0.0, 500.0])))
    return rays, w, *motions


def matrix(rays: np.ndarray, w: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """G of a plane that moves by P -> R P + t: w P is linear in (1, X, Y), so G is too."""
    basis = np.zeros((len(rays), 3, 3))
    basis[:, :, 0] = rays
    basis[:, 0, 1] = basis[:, 1, 2] = 1.0
    return R @ basis + t[:, None] * w[:, None, :]


def plane_seen_later(start: Totals) -> tuple[np.ndarray, np.ndarray]:
    """Rays to the moved points, and their planes about these, by central differences along the plane."""
    P = start.current_cam1_mm
    rays = P / P[:, 2:]
    plane = start.plane
    return rays, np.column_stack([(plane * rays).sum(axis=1), plane[:, 0], plane[:, 1]])


def test_motions_of_planes_compose_exactly() -> None:
    rays, w, (R1, t1), (R2, t2) = random_plane_motions(40)
    start = Totals(rays, w, matrix(rays, w, R1, t1))
    rays_k, w_k = plane_seen_later(start)
    segment = matrix(rays_k, w_k, R2, t2)
    both = matrix(rays, w, R2 @ R1, R2 @ t1 + t2)
    after = follow(start, w_k, segment)
    assert np.abs(after.G - both).max() < 1e-11
    assert np.abs(since(start, Totals(rays, w, both), w_k) - segment).max() < 1e-11


def test_a_field_tells_its_unknowns_to_the_last_digits() -> None:
    pair = bench.rig().pair
    grid = PointGrid.rectangle(100, 100, 200, 180, spacing_px=20)
    n = grid.x_px.size
    rng = np.random.default_rng(2)
    xy = grid.xy_px.reshape(n, 2)
    rays = pair.cam1.rays_cam(xy).xyz_mm
    points = PointFits.empty(n, 3)
    points.w[:] = np.array([1 / 520.0, 2e-4, -3e-4]) * (1 + 0.05 * rng.normal(size=(n, 3)))
    R = turn(np.array([0.2, -0.3, 1.0]), 2.8).rotation @ np.diag([1.4, 0.8, 1.0])
    centre = np.array([0.0, 0.0, 520.0])
    points.G[:] = matrix(rays, points.w, R, (np.eye(3) - R) @ centre)
    points.status[:], points.zncc[:], points.covariance[:] = PointStatus.OK, 0.99, np.eye(5) * 1e-12
    field = assemble(points, pair=pair, grid=grid, fits_image=grid.allowed, shape=None)
    totals = totals_of(field, pair)
    assert np.abs(totals.w / points.w - 1.0).max() < 1e-9
    assert np.abs(totals.G - points.G).max() < 1e-10


def test_pixels_in_common_are_counted_right() -> None:
    rng = np.random.default_rng(3)
    size = 21
    slopes = np.array(
        [
            np.eye(2),
            turn(np.array([0, 0, 1.0]), 0.7).rotation[:2, :2],
            np.diag([2.0, 1.5]),
            np.diag([0.6, 0.9]),
            [[1.1, 0.4], [-0.2, 0.9]],
        ]
    )
    offset = rng.uniform(-4.0, 4.0, (5, 2))
    common, own = common_share(slopes, offset, size)
    positions = rng.uniform(-0.5 * size, 0.5 * size, (400_000, 2))  # of the square, from its middle
    for k in range(5):
        back = np.linalg.solve(slopes[k], (positions + offset[k]).T)
        inside = (np.abs(back) <= 0.5 * size).all(axis=0).mean()
        assert common[k] == pytest.approx(inside / np.linalg.det(slopes[k]), abs=0.004)
    assert own == pytest.approx(np.maximum(1.0, 1.0 / np.linalg.det(slopes)))


@cache
def moving() -> tuple[list[bench.Images], list[np.ndarray]]:
    """Four steps: the plate turns by 2 degrees a step, moves and stretches."""
    scenes = [
        bench.plate(2.0 * n, np.array([0.021, -0.013, 0.02]) * n, np.diag([1 + 0.01 * n, 1 - 0.004 * n]))
        for n in range(5)
    ]
    return [bench.capture(s, seed=k) for k, s in enumerate(scenes)], [bench.truth(s) for s in scenes]


@cache
def moving_measured(mode: str) -> dict[int, Field]:
    return bench.measure(moving()[0], mode)  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["never", "auto", "always"])
def test_displacement_rotation_and_stretch_are_totals(mode: str) -> None:
    fields, (_, truth) = moving_measured(mode), moving()
    for n, field in fields.items():
        assert field.valid.all()
        assert field.uvw_mm is not None
        assert field.rotation_rad is not None
        assert field.stretch is not None
        error = 1e3 * (field.uvw_mm - truth[n])
        assert (np.sqrt(np.mean(error**2, axis=(0, 1))) < (0.25, 0.25, 0.8)).all()
        assert np.median(field.rotation_rad[..., 2]) == pytest.approx(np.deg2rad(2.0 * n), abs=1e-4)
        e11, e22, e12 = np.median(field.stretch, axis=(0, 1))
        principal = np.linalg.eigvalsh([[e11, e12], [e12, e22]])
        assert principal == pytest.approx([-0.004 * n, 0.01 * n], abs=3e-4)
        assert field.xyz_mm == pytest.approx(fields[1].xyz_mm, abs=1e-12)
        matched = 0 if field.references is None else field.references.step
        assert matched == (n - 1 if mode == "always" else 0)


def test_auto_is_total_to_the_last_digit_where_that_serves() -> None:
    for n, field in moving_measured("auto").items():
        total = moving_measured("never")[n]
        assert np.array_equal(field.uvw_mm, total.uvw_mm)  # type: ignore[arg-type]
        assert np.array_equal(field.covariance, total.covariance)


def test_never_is_what_one_step_after_the_other_gives() -> None:
    images = moving()[0]
    reference = ReferencePair(bench.rig().pair, *images[0])
    shape, last = reference.shape(bench.GRID, bench.OPTIONS), None
    for n, field in moving_measured("never").items():
        last = reference.motion(*images[n], bench.GRID, bench.OPTIONS, shape=shape, previous=last)
        assert np.array_equal(field.uvw_mm, last.uvw_mm)  # type: ignore[arg-type]


@pytest.mark.parametrize("n", [2, 3, 4])
def test_a_fresh_worker_goes_on_from_the_files(n: int, tmp_path: Path) -> None:
    known = moving_measured("always")
    fresh = bench.measure_from_files(moving()[0], known, n, "always", tmp_path)
    assert np.array_equal(fresh.status, known[n].status)
    assert np.abs(fresh.uvw_mm - known[n].uvw_mm).max() < 1e-9  # type: ignore[operator]
    assert fresh.covariance == pytest.approx(known[n].covariance, rel=1e-5, abs=1e-15)
    assert fresh.references is not None
    assert known[n].references is not None
    assert fresh.references.noise_px2 == pytest.approx(known[n].references.noise_px2, rel=1e-6)


def test_told_errors_after_updates_are_the_empirical_ones() -> None:
    """Monte Carlo over the noise: five updates, each leaving the reported scatter about the truth."""
    scenes = [bench.plate(0.4 * n, np.array([0.021, -0.013, 0.02]) * n) for n in range(7)]
    clean = [bench.rig().capture(s, noise=0.0) for s in scenes]
    grid = PointGrid.rectangle(90, 90, 430, 390, spacing_px=28)
    errors, sigmas = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        images = [
            [np.clip(np.round(c + rng.normal(0, 2.0, c.shape)), 0, 255).astype(np.uint8) for c in p] for p in clean
        ]
        field = bench.measure(images, "always", grid=grid)[6]
        assert field.uvw_mm is not None
        errors.append(field.uvw_mm)
        sigmas.append(field.sigma_mm[..., 3:])
    known = np.isfinite(np.array(errors)).all(axis=(0, 3))
    assert known.mean() > 0.9
    empirical = np.sqrt(np.mean(np.var(np.array(errors)[:, known], axis=0, ddof=1), axis=0))
    reported = np.sqrt(np.mean(np.array(sigmas)[:, known] ** 2, axis=(0, 1)))
    assert reported / empirical == pytest.approx(np.ones(3), abs=0.12)  # 4 x 160 degrees of freedom: 3 % of scatter


@cache
def fading() -> tuple[list[bench.Images], list[np.ndarray]]:
    """Nine steps in which the pattern goes over to another one, 10 degrees of 90 a step."""
    scenes = [bench.plate(0.5 * n, np.array([0.03, 0.01, 0.01]) * n) for n in range(10)]
    return [bench.capture_fading(s, 10.0 * n, n) for n, s in enumerate(scenes)], [bench.truth(s) for s in scenes]


def test_a_pattern_that_changes_ends_total_correlation_and_not_auto() -> None:
    images, truth = fading()
    with pytest.raises(SeedError):
        ReferencePair(bench.rig().pair, *images[0]).motion(*images[9], bench.GRID, bench.OPTIONS)
    fields = bench.measure(images, "auto")
    references = [0 if f.references is None else f.references.step for f in fields.values()]
    assert references[0] == 0
    assert 1 <= len(set(references)) - 1 <= 4  # it stays with a reference as long as that serves
    for n, field in fields.items():
        assert field.valid.mean() > 0.95
        # the other pattern draws the points along: so it is reported, before an update and after
        error = field.uvw_mm - truth[n]  # type: ignore[operator]
        reported, true = (np.sqrt(np.nanmean(a[..., :2] ** 2)) for a in (field.sigma_mm[..., 3:], error))
        assert 0.75 < reported / true < 1.35


@pytest.mark.fault(38)
def test_points_that_were_hidden_come_back_and_never_in_the_step_that_lost_them() -> None:
    scenes = [bench.plate(0.0, np.array([0.03, 0.01, 0.01]) * n) for n in range(6)]
    images = [bench.capture(s, seed=k) for k, s in enumerate(scenes)]
    for k in (2, 3):
        images[k][0][190:260, 200:270] = 30  # before camera 1 alone
    fields = bench.measure(images, "always")
    hidden = fields[1].valid & ~fields[2].valid
    assert 0.15 < hidden.mean() < 0.6
    assert np.isnan(fields[2].uvw_mm[hidden]).all()  # type: ignore[index]
    assert not fields[3].valid[hidden].any()  # still hidden
    assert fields[4].valid[hidden].mean() > 0.95
    references = fields[4].references
    assert references is not None
    assert set(references.steps[hidden & fields[4].valid]) == {1}  # the newest step that shows them
    assert set(references.steps[~hidden]) == {3}
    for n in (4, 5):
        error = 1e3 * (fields[n].uvw_mm - bench.truth(scenes[n]))  # type: ignore[operator]
        ratio = np.abs(error) / (1e3 * fields[n].sigma_mm[..., 3:])
        assert np.nanmax(ratio) < 5.0
    later = fields[5].references
    assert later is not None
    assert set(later.steps[fields[5].valid]) == {4}  # found again, they go with the others


@pytest.mark.fault(38)
def test_auto_leaves_a_reference_alone_that_only_an_obstacle_hides() -> None:
    scenes = [bench.plate(0.0, np.array([0.03, 0.01, 0.01]) * n) for n in range(5)]
    images = [bench.capture(s, seed=k) for k, s in enumerate(scenes)]
    for k in (2, 3):
        images[k][0][190:260, 200:270] = 30
    fields = bench.measure(images, "auto")
    assert all(f.references is None for f in fields.values())
    assert fields[4].valid.all()


@pytest.mark.fault(39)
@pytest.mark.parametrize("mode", ["auto", "always"])
def test_a_jump_in_mid_sequence_is_found_by_new_seeds(mode: str) -> None:
    """120 px, 40 degrees and 20 % strain between two steps, after an update and before the next."""
    scenes = [
        bench.plate(),
        bench.plate(1.0),
        bench.plate(2.0),
        bench.plate(42.0, (4.0, -2.5, 1.0), np.diag([1.2, 1.1])),
        bench.plate(43.0, (4.0, -2.5, 1.0), np.diag([1.2, 1.1])),
    ]
    images = [bench.capture(s, seed=k) for k, s in enumerate(scenes)]
    grid = PointGrid.rectangle(190, 200, 290, 290, spacing_px=14)
    fields = bench.measure(images, mode, grid=grid)  # type: ignore[arg-type]
    for n in (3, 4):
        seen = bench.rig().pair.cam1.project(fields[n].xyz_mm + fields[n].uvw_mm).xy
        moved = np.linalg.norm(seen - grid.xy_px, axis=-1)
        assert n != 3 or np.nanmedian(moved) > 100.0
        error = 1e3 * np.linalg.norm(fields[n].uvw_mm - bench.truth(scenes[n], grid), axis=-1)  # type: ignore[operator]
        assert fields[n].valid.mean() > 0.95
        assert np.nanmax(error) < 3.0  # 0.08 px
    if mode == "always":
        assert [f.references.step for f in fields.values() if f.references] == [1, 2, 3]


def test_a_reference_that_nothing_is_left_of_is_refused() -> None:
    images = [MeasureImage(i) for i in moving()[0][1]]
    gone = moving_measured("never")[1]
    empty = np.full(gone.shape, PointStatus.LOW_CORRELATION, np.int8)
    field = Field(**{**gone.__dict__, "status": empty})
    from stereorig.core.field.sequence.segment import begin_segment

    with pytest.raises(SeedError, match="step 1"):
        begin_segment(
            1,
            field,
            images[0],
            images[1],
            pair=bench.rig().pair,
            grid=bench.GRID,
            options=bench.OPTIONS,
            slope_share=0.0,
            first=0,
        )


def test_curved_patches_are_followed_too() -> None:
    images, truth = moving()
    fields = bench.measure(images[:3], "always", options=MeasureOptions(subset_px=33, patch="quadratic"))
    for n, field in fields.items():
        assert field.valid.mean() > 0.95
        error = 1e3 * (field.uvw_mm - truth[n])  # type: ignore[operator]
        assert (np.sqrt(np.nanmean(error**2, axis=(0, 1))) < (0.4, 0.4, 1.5)).all()


def test_rest_is_rest() -> None:
    """A plate that does not move: forty pixels off its position would show in a turned frame, nothing shows here."""
    still = bench.plate(0.0, RigidTransform.identity().translation_mm)
    images = [bench.capture(still, seed=k) for k in range(4)]
    for field in bench.measure(images, "always").values():
        assert np.abs(field.uvw_mm).max() < 2e-3


@pytest.mark.fault(37)
def test_a_leg_that_begins_with_an_open_crack_reaches_over_neither_lip() -> None:
    """The line is drawn at the first reference; at the second the lips are opened by four pixels."""
    x = np.linspace(0.0, 263.0, 41)
    line = np.stack([x, 112.0 + 18.0 * np.sin(x / 42.0)], axis=-1)
    side = below(line)
    grid = field_bench.grid(spacing_px=5.0, margin_px=36.0).with_cracks([line])
    options = MeasureOptions(subset_px=21, patch="affine")
    pairs = [crack_reference(), opened(side, seed=2), opened(side, seed=12)]
    images = [(MeasureImage(one), MeasureImage(two)) for one, two in pairs]
    reference = ReferencePair(field_bench.pair(), *images[0])
    fields: dict[int, Field] = {}
    sequence = reference.sequence(
        reference.shape(grid, options),
        grid,
        options,
        reference_update="always",
        images_of=lambda k: images[k],
        field_of=lambda k: fields[k],
    )
    for n in (1, 2):
        fields[n] = sequence.measure(images[n], PreviousStep(1, fields[1]) if n == 2 else None)
    assert fields[2].references is not None
    assert fields[2].references.step == 1
    away = np.array([min(np.hypot(*(line - p).T)) for p in grid.xy_px.reshape(-1, 2)]).reshape(grid.shape)
    lips = away < 10.0
    assert fields[2].uvw_mm is not None
    assert fields[2].valid[lips].mean() > 0.9 * fields[1].valid[lips].mean()
    error = (fields[2].uvw_mm - true_uvw(grid.xy_px, side))[fields[2].valid & lips]
    share = error / fields[2].sigma_mm[fields[2].valid & lips][:, 3:]
    assert 0.7 < np.sqrt(np.mean(share**2)) < 1.3
    assert np.abs(error[:, :2]).max() < 0.015  # the lips part by 120 um
