"""Where an uncertainty comes from: each cause drawn alone, noise that steps share, and sums of squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from stereorig.core.calibration import COVARIANCE_NAMES, CalibrationOptions, CalibrationView, NominalValues
from stereorig.core.calibration.expect import expect
from stereorig.core.calibration.fit.adjust import adjust, expected_covariance
from stereorig.core.calibration.fit.layout import camera_of
from stereorig.core.calibration.fit.named import named_by_cause, named_derivatives, parameter_names
from stereorig.core.calibration.fit.problem import started
from stereorig.core.calibration.prepare import problem_of
from stereorig.core.cameras.camera import TEN_PARAMETER_NAMES, Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.budget import budget_of, budget_of_difference
from stereorig.core.common.derivatives import Estimator, measured_derivatives
from stereorig.core.common.factor import Causes, ParameterCovariance, factor_of, joined
from stereorig.core.errors import CalibrationInputError
from stereorig.core.field.common import with_common_parts
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import References
from stereorig.core.gauge.area import area_statistics
from stereorig.core.gauge.extensometer import extensometer
from stereorig.core.gauge.reading import difference
from stereorig.core.gauge.rigid import rigid_motion, without_rigid_motion
from stereorig.core.measure import MeasureOptions, PreviousStep, ReferencePair
from stereorig.core.names import BUDGET, CAMERAS, CAUSES
from stereorig.core.target import GridTarget
from stereorig.server.formats.results.reading import read_field
from stereorig.server.formats.results.writing import Provenance, write_field
from tests.accuracy.test_common_part import SHARED, measured_numerically, moved_field
from tests.bench.accuracy.coverage import Grid
from tests.support.calibrated_volume import covariance
from tests.support.calibration_rigs import LENSES, Array, flat, observed, ordinary_pair
from tests.support.field_bench import grid, pair, take
from tests.support.gauge_field import SUBSET

NOISE_PX, POSITIONS, LINES, PITCH_MM = 0.01, (0.0, 10.0, 20.0), (6, 6), 28.0
TILT, SCALE, STEP_MM, PITCH, TOLERANCE_MM = 1e-3, 1e-4, 5e-3, 2e-5, 4e-3
RIG = ordinary_pair(LENSES["pinhole"], roll_deg=45.0)
NODES = GridTarget(pitch_mm=PITCH_MM, lines=LINES, line_width_mm=0.5).inner_points_mm()


def _views(rng: Any, *, stage: Array | None = None, nodes: Array | None = None, noise: float = 0.0) -> Any:
    """Views of the rig; ``stage`` (2, 6) are tilts, scale and steps of each camera's axis."""
    off = np.zeros((2, 6)) if stage is None else stage
    points = flat(NODES if nodes is None else nodes)
    out = []
    for c, camera in enumerate(RIG):
        tilt, scale, steps = off[c, :2], off[c, 2], off[c, 3:]
        along = np.array([*tilt, np.sqrt(1.0 - tilt @ tilt)])
        for dz, step in zip(POSITIONS, steps, strict=True):
            seen = observed(camera.moved((dz * (1.0 + scale) + step) * along), points, rng, noise)
            out.append(CalibrationView(CAMERAS[c], dz, seen))
    return [[v for v in out if v.camera == name] for name in CAMERAS]


@pytest.mark.deep
def test_each_causes_part_of_the_calibrations_covariance_is_what_it_does_alone() -> None:
    rng = np.random.default_rng(4)
    nominals = tuple(NominalValues(RIG[0].size_px, 3535.0, 357.0, a) for a in (-12.5, 12.5))
    options = CalibrationOptions(
        lens="paper", stage_scale_sigma=SCALE, stage_step_sigma_mm=STEP_MM, axis_tilt_sigma_rad=TILT
    )
    target: Any = Grid(PITCH_MM, LINES, TOLERANCE_MM, PITCH)

    def problem(draw: Any, **off: Any) -> Any:
        return problem_of(_views(draw, noise=NOISE_PX, **off), target, nominals, options)  # type: ignore[arg-type]

    exact, start, _ = started(problem(np.random.default_rng(4)))
    layout = exact.layout("paper")
    priors = exact.priors(layout)

    def fitted(draw: Any, noise: Any, **off: Any) -> Any:
        p = problem(draw, **off)
        return adjust(layout, state, p.rows, p.flat_nodes_mm, priors, max_iterations=60, noise_px=noise, rounds=1)

    # the same noise in all views of one cause: without any it would be told as none, and the prior would count nothing
    state = start
    base = fitted(np.random.default_rng(4), np.full(2, NOISE_PX))
    state, noise = base.state, base.noise_px

    def found(**off: Any) -> Any:
        return fitted(np.random.default_rng(4), noise, **off).state

    J = named_derivatives(layout, priors, state.x)
    names = parameter_names(layout, priors)
    whole, by_prior = expected_covariance(layout, state, exact.rows, exact.flat_nodes_mm, priors, noise)
    parts = named_by_cause(layout, priors, state.x, whole, by_prior)
    np.testing.assert_allclose(sum(parts.values()), J @ whole @ J.T, rtol=1e-12, atol=1e-30)
    cameras = StereoPair(*(camera_of(layout, state.x, c) for c in range(2)))
    points = np.array([[0.0, 0.0, 0.0], [40.0, -30.0, 0.0], [-30.0, 45.0, 10.0]])
    rows = measured_derivatives(cameras, points, names, points + np.array([0.5, -0.3, 2.0])).reshape(-1, len(names))

    def moved(**off: Any) -> Array:
        return np.asarray(rows @ J @ (found(**off).x - state.x))

    unit = np.eye(12).reshape(12, 2, 6) * np.array([TILT, TILT, SCALE, STEP_MM, STEP_MM, STEP_MM])
    corners = NODES.reshape(-1, 2)
    sd_mm = TOLERANCE_MM / np.sqrt(3.0)
    shifts = [sd_mm * e.reshape(NODES.shape) for e in np.eye(corners.size)]
    alone = {
        "stage": np.stack([moved(stage=one) for one in unit], axis=1),
        "target": np.stack([moved(nodes=NODES + d) for d in [PITCH * NODES, *shifts]], axis=1),
    }
    for cause, columns in alone.items():
        # one by one, so that only what is not linear is left
        predicted = np.sqrt(np.einsum("ip,pq,iq->i", rows, parts[cause], rows))  # type: ignore[index]
        np.testing.assert_allclose(np.linalg.norm(columns, axis=1), predicted, rtol=0.02, atol=1e-3 * predicted.max())
    drawn = np.stack([rows @ J @ (fitted(rng, noise).state.x - state.x) for _ in range(150)], axis=1)
    predicted = np.sqrt(np.einsum("ip,pq,iq->i", rows, parts["calibration"], rows))
    # 150 draws know a standard deviation to 6 %
    np.testing.assert_allclose(drawn.std(axis=1), predicted, rtol=0.18)


def test_noise_of_the_reference_pair_is_the_same_in_two_steps_and_cancels_in_their_difference() -> None:
    rig = pair()
    rng = np.random.default_rng(8)
    before = np.array([[2.0, -1.5, 0.5]])
    steps = [before + np.array([[0.4, 0.1, 0.3]]), before + np.array([[-0.3, 0.5, -0.4]])]
    noise, draws = 0.01, 4000
    many = np.repeat(before, draws, axis=0)
    of_subset, of_camera2 = noise * rng.standard_normal((2, draws, 2))
    got = []
    for current in steps:
        now = np.repeat(current, draws, axis=0)
        new1, new2 = noise * rng.standard_normal((2, draws, 2))
        seen = [rig.cam1.project(many).xy, rig.cam2.project(many).xy + of_camera2 - of_subset]
        seen_now = [rig.cam1.project(now).xy + new1 - of_subset, rig.cam2.project(now).xy + new2 - of_subset]
        got.append(measured_numerically(rig, seen, seen_now, many, now)[:, 3:])
    at = [Estimator.at(rig, before, current) for current in steps]
    N = np.kron(np.eye(3) + 1.0, np.eye(2)) * noise**2
    own = [a.by_match[0] @ N @ a.by_match[0].T for a in at]  # type: ignore[index]
    new = []
    for a, C in zip(at, own, strict=True):
        new.append(a.new_noise(np.linalg.cholesky(C)[None])[0])
    # 4,000 draws know a standard deviation to 1.1 %
    for k in range(2):
        np.testing.assert_allclose(got[k].std(axis=0), np.sqrt(np.diag(own[k])), rtol=0.04)
    np.testing.assert_allclose((got[1] - got[0]).std(axis=0), np.sqrt(np.diag(new[0] + new[1])), rtol=0.04)
    # and it matters: as if all noise were new, the difference would be a quarter too uncertain
    assert (np.sqrt(np.diag(own[0] + own[1])) > 1.2 * np.sqrt(np.diag(new[0] + new[1]))).all()


def told_field() -> Any:
    """A made-up field with causes of its columns, and a part of its noise that is the reference's."""
    field = moved_field()
    return replace(
        field, causes=Causes(("calibration", "stage", "target"), CAUSES), frozen=0.4 * field.covariance[..., 3:, 3:]
    )


def test_the_squares_of_a_budget_add_up_to_the_square_of_the_value_it_belongs_to() -> None:
    field = told_field()
    reading = extensometer(field, (60.0, 80.0), (133.0, 121.0), shared=SHARED)
    for one in (reading.length0_mm, reading.length_mm, reading.strain):
        assert list(one.budget.document()) == list(BUDGET)
        assert one.budget.sigma == pytest.approx(one.sigma, rel=1e-9)
    # a length at the reference has the reference pair's noise alone
    assert reading.length0_mm.budget.matching == pytest.approx(0.0, abs=1e-9)
    assert reading.length_mm.budget.matching > 0.0  # type: ignore[operator]
    motion = rigid_motion(field, shared=SHARED)
    sigma = np.sqrt(np.diag(motion.covariance))
    np.testing.assert_allclose([one.sigma for one in motion.budgets], sigma, rtol=1e-9)
    left = without_rigid_motion(field, motion, shared=SHARED)
    assert left.frozen is not None
    share = np.trace(left.frozen, axis1=-2, axis2=-1) / np.trace(left.covariance[..., 3:, 3:], axis1=-2, axis2=-1)
    assert (share[left.valid] > 0.3).all()
    assert (share[left.valid] < 0.7).all()
    inside = np.ones(field.shape, bool)
    own = np.sqrt(field.covariance[..., 5, 5])
    mean = area_statistics(
        field,
        field.uvw_mm[..., 2],
        own,
        inside,
        shared=SHARED,
        common=field.common[..., 5, :],
        sigma_reference=np.sqrt(0.4) * own,
    )
    assert mean.mean_reading.budget.sigma == pytest.approx(mean.mean_sigma, rel=1e-9)
    assert mean.mean_reading.budget.reference**2 == pytest.approx(  # type: ignore[operator]
        0.4 * (mean.mean_sigma**2 - mean.mean_sigma_calibration**2), rel=1e-6
    )


def test_what_two_steps_share_cancels_in_their_difference() -> None:
    field = told_field()
    one = extensometer(field, (60.0, 80.0), (133.0, 121.0), shared=SHARED).length_mm
    same = difference(one, one)
    assert same.budget.matching == pytest.approx(np.sqrt(2.0) * one.budget.matching, rel=1e-9)  # type: ignore[operator]
    assert [same.budget.document()[name] for name in BUDGET[1:]] == [0.0] * 4
    assert same.sigma < np.sqrt(2.0) * one.sigma
    # columns are matched by their cause and order, and one that a step lacks is zero there
    few, more = Causes(("calibration", "target"), CAUSES), Causes(("calibration", "calibration", "target"), CAUSES)
    assert joined(few, more).columns == more.columns
    a, b = budget_of(1.0, 0.5, np.array([2.0, 1.0]), few), budget_of(1.0, 0.5, np.array([2.0, 3.0, 1.0]), more)
    both = budget_of_difference(a, b, np.array([2.0, 1.0]), np.array([2.0, 3.0, 1.0]), few, more)
    assert both.document() == pytest.approx(
        {"matching": 1.0, "reference": 0.0, "calibration": 3.0, "stage": 0.0, "target": 0.0}
    )


def test_what_is_not_known_is_missing_from_a_budget_and_said() -> None:
    imported = budget_of(1.0, 0.25, None, None)
    assert list(imported.document()) == ["matching", "reference"]
    assert "calibration not included" in imported.notes
    older = budget_of(1.0, None, np.array([1.0, 2.0]), None)
    assert list(older.document()) == ["matching", "calibration"]
    assert len(older.notes) == 2
    assert budget_of(1.0, 0.25, np.array([1.0]), Causes(("stage",), CAUSES)).notes == ()


def test_a_file_names_the_cause_of_each_column_and_the_references_noise(tmp_path: Path) -> None:
    field = told_field()
    path = tmp_path / "step_0001.nc"
    write_field(path, field, Provenance({"subset_px": SUBSET}, {}, "test"))
    with xr.open_dataset(path) as data:
        assert [str(name) for name in data.cause.values] == ["calibration", "stage", "target"]
        assert data.common_factor.dims == ("row", "col", "component", "cause")
        assert data.reference_covariance.dims[:2] == ("row", "col")
    back = read_field(path)
    assert back.causes == field.causes
    np.testing.assert_allclose(back.frozen, field.frozen, rtol=1e-6)
    # what single precision leaves of the total, here a thousand times the own
    np.testing.assert_allclose(back.covariance, field.covariance, atol=2e-7 * np.nanmax(field.total_covariance))


def _source(**parts: Any) -> ParameterCovariance:
    whole = covariance()
    given = {"calibration": 0.5 * whole, "stage": 0.3 * whole, "target": 0.2 * whole} | parts
    return ParameterCovariance(pair(), COVARIANCE_NAMES, whole, given)  # type: ignore[arg-type]


def test_a_columns_cause_is_the_same_in_all_steps_and_each_cause_keeps_its_variance() -> None:
    points = np.random.default_rng(3).uniform(-3.0, 3.0, (200, 3))
    near = factor_of(_source(), points, points + np.array([0.01, 0.0, 0.02]))
    far = factor_of(_source(), points, points + np.array([0.5, -0.4, 1.0]))
    both = joined(near.causes, far.causes)
    one, two = near.causes.aligned(near.values, far.causes), far.causes.aligned(far.values, near.causes)
    assert one.shape[-1] == two.shape[-1] == len(both.columns)
    # positions are the same in both steps: so are their factors, but for columns that a step leaves out
    off = np.linalg.norm((two - one)[:, :3], axis=-1)
    assert (off < 0.06 * np.linalg.norm(two[:, :3], axis=-1)).all()  # the root of what two choices leave out
    squares = far.causes.squares(far.values)
    whole = np.sum(list(squares.values()), axis=0)
    for cause, share in (("calibration", 0.5), ("stage", 0.3), ("target", 0.2)):
        np.testing.assert_allclose(squares[cause] / whole, share, atol=0.02)  # type: ignore[index]


def test_parts_that_no_covariance_can_have_are_refused() -> None:
    whole = covariance()
    _source().check()
    with pytest.raises(CalibrationInputError, match="add up to") as error:
        _source(stage=0.4 * whole).check()
    assert error.value.code == "covariance_parts_differ"
    bad = 0.3 * whole
    bad[0, 9] = bad[9, 0] = 1.2 * bad[0, 9]
    with pytest.raises(CalibrationInputError, match=r"part of stage .* eigenvalue of -") as error:
        _source(stage=bad, calibration=0.8 * whole - bad).check()
    assert error.value.code == "covariance_not_positive"


def test_a_field_gets_its_factor_and_the_references_share_of_its_noise() -> None:
    field = replace(moved_field(), common=None)
    got = with_common_parts(field, _source(), pair())
    assert got.causes is not None
    assert got.frozen is not None
    new = got.covariance[..., 3:, 3:] - got.frozen
    assert (np.linalg.eigvalsh(new[got.valid]) >= 0.0).all()
    assert (np.linalg.eigvalsh(got.frozen[got.valid]) >= -1e-15).all()
    none = with_common_parts(field, None, pair())
    assert none.common is None
    assert none.frozen is not None


def measured_field(reference: Any, now: Any, points: Any, options: MeasureOptions) -> Any:
    """A displacement by the measurement, from rendered images."""
    first = ReferencePair(pair(), *reference)
    return first.motion(*now, points, options, shape=first.shape(points, options))


@pytest.mark.deep
def test_rendered_steps_scatter_by_their_new_noise_about_one_reference_pair() -> None:
    points = grid(spacing_px=20.0)
    options = MeasureOptions(subset_px=21)
    motion = (0.2, 0.1, 0.3, 0.0, 0.0, 0.0)
    now = [take("block", 1.0, motion, seed=100 + k) for k in range(12)]
    once = take("block", seed=1)
    about_one = [measured_field(once, images, points, options) for images in now]
    about_many = [measured_field(take("block", seed=200 + k), images, points, options) for k, images in enumerate(now)]
    ok = np.all([f.valid for f in about_one + about_many], axis=0)
    new, every = (np.stack([f.uvw_mm[ok] for f in fields]).std(axis=0, ddof=1) for fields in (about_one, about_many))
    told = with_common_parts(about_one[0], None, pair())
    assert told.frozen is not None
    own = np.diagonal(told.covariance[ok][:, 3:, 3:], axis1=1, axis2=2)
    frozen = np.diagonal(told.frozen[ok], axis1=1, axis2=2)
    # 12 draws at some hundred points, which share few pixels, know a share to some per cent
    for k in range(3):
        seen = float(np.sqrt(np.mean(new[:, k] ** 2) / np.mean(every[:, k] ** 2)))
        stated = float(np.sqrt(1.0 - frozen[:, k].mean() / own[:, k].mean()))
        assert seen == pytest.approx(stated, rel=0.1)


def _about_later_references(reference: Any, now: Sequence[Any], points: Any, options: MeasureOptions) -> list[Any]:
    """Displacements of the steps ``now``, each but the first matched against the one before."""
    first = ReferencePair(pair(), *reference)
    images = {k: (MeasureImage(one), MeasureImage(two)) for k, (one, two) in enumerate(now, start=1)}
    fields: dict[int, Any] = {}
    sequence = first.sequence(
        first.shape(points, options),
        points,
        options,
        reference_update="always",
        images_of=lambda n: images[n],
        field_of=lambda n: fields[n],
    )
    for k, step in images.items():
        fields[k] = sequence.measure(step, PreviousStep(k - 1, fields[k - 1]) if k > 1 else None)
    return list(fields.values())


@pytest.mark.deep
def test_steps_matched_against_later_references_scatter_by_what_is_told_as_new() -> None:
    points = grid(spacing_px=16.0)
    options = MeasureOptions(subset_px=21, patch="affine")
    motions = [(0.11, 0.06, 0.15, 0.0, 0.0, 0.0), (0.2, 0.1, 0.3, 0.0, 0.0, 0.0), (0.31, 0.17, 0.42, 0.0, 0.0, 0.0)]

    def drawn(seed: int, reference: int) -> list[Any]:
        now = [take("block", 1.0, motion, seed=1000 * k + seed) for k, motion in enumerate(motions, start=1)]
        return _about_later_references(take("block", seed=reference), now, points, options)

    # twelve tests about one reference pair, and twelve whose reference is drawn, too
    about_one, about_many = [drawn(k, 1) for k in range(12)], [drawn(500 + k, 100 + k) for k in range(12)]
    ok = np.all([f.valid for test in about_one + about_many for f in test], axis=0)
    told = [with_common_parts(f, None, pair()) for f in about_one[0]]
    own, frozen = (
        [np.diagonal(part[ok], axis1=1, axis2=2).mean(axis=0) for part in parts]
        for parts in ([f.covariance[..., 3:, 3:] for f in told], [f.frozen for f in told])
    )

    def seen(tests: Sequence[Any], k: int, before: int | None = None) -> Any:
        values = np.stack([t[k].uvw_mm[ok] - (0.0 if before is None else t[before].uvw_mm[ok]) for t in tests])
        return np.sqrt(values.var(axis=0, ddof=1).mean(axis=0))

    # 12 draws at some hundred points, which share few pixels, know a standard deviation to some per cent; what a later
    # reference adds stays below a tenth, and is told in both steps of a difference
    for k in range(3):
        np.testing.assert_allclose(seen(about_one, k), np.sqrt(own[k] - frozen[k]), rtol=0.12)
        np.testing.assert_allclose(seen(about_many, k), np.sqrt(own[k]), rtol=0.12)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        stated = np.sqrt(own[a] - frozen[a] + own[b] - frozen[b])
        for tests in (about_one, about_many):
            np.testing.assert_allclose(seen(tests, b, a), stated, rtol=0.15)
        # as if all were new it would be 1.4 times that
        assert (np.sqrt(own[a] + own[b]) > 1.25 * seen(about_many, b, a)).all()


def test_what_later_references_added_is_no_noise_of_the_first_pair() -> None:
    field = moved_field()
    at_first = with_common_parts(field, None, pair()).frozen
    assert at_first is not None
    steps = np.ones(field.shape, np.int32)
    none = np.zeros((*field.shape, 2, 2))

    def frozen(share: float) -> Any:
        added = np.broadcast_to(share * np.eye(3), (*field.shape, 3, 3))
        later = replace(field, references=References(1, steps, none, none, added))
        return with_common_parts(later, None, pair()).frozen

    scale = np.nanmax(np.abs(at_first))
    np.testing.assert_allclose(frozen(0.0), at_first, atol=1e-9 * scale)
    # where a third was added, two thirds are as against the first reference; where all was, none is frozen
    np.testing.assert_allclose(frozen(1.0 / 3.0), at_first * 2.0 / 3.0, atol=1e-9 * scale)
    np.testing.assert_allclose(frozen(1.0), np.zeros_like(at_first) * at_first, atol=1e-9 * scale)
    unknown = replace(field, references=References(1, steps, none, none))
    assert with_common_parts(unknown, None, pair()).frozen is None


@pytest.mark.parametrize(("stage_scale", "off_plane"), [(0.0, 0.03), (1e-2, 5e-3)])
def test_a_wrong_pitch_scales_the_targets_plane_and_beyond_it_as_far_as_the_stage_lets_it(
    stage_scale: float, off_plane: float
) -> None:
    pitch = 2e-5
    target = GridTarget(pitch_mm=8.0, lines=(11, 11), line_width_mm=0.3, pitch_scale_sigma=pitch)
    one, two = (NominalValues((1024, 1024), 3535.0, 357.0, angle) for angle in (-12.5, 12.5))
    options = CalibrationOptions(lens="paper", stage_scale_sigma=stage_scale)
    planned = expect((0.0, 10.0, 20.0), target, (one, two), options)
    source = ParameterCovariance(planned.pair, tuple(planned.parameters), planned.covariance, planned.by_cause)
    L, causes = source.columns
    assert causes.columns.count("target") == 1
    points = np.array([[30.0, -20.0, 0.0], [-30.0, 25.0, 0.0], [10.0, 30.0, 8.0], [20.0, 20.0, -8.0]])
    column = measured_derivatives(planned.pair, points, source.names) @ L[:, causes.columns.index("target")]
    column *= np.sign(np.sum(column[:2] * points[:2]))  # a cause's column has either sign
    np.testing.assert_allclose(column[:2] / pitch, points[:2], atol=0.01)
    off = np.linalg.norm(column[2:] / pitch - points[2:], axis=1) / np.linalg.norm(points[2:], axis=1)
    assert (off < off_plane).all(), off


@pytest.mark.deep
def test_the_joint_covariance_of_20_points_has_the_eigenvalues_of_sampled_ones() -> None:
    rng = np.random.default_rng(20)
    rig, noise, draws = pair(), 0.001, 1500
    before = np.column_stack([rng.uniform(-5.0, 5.0, (20, 2)), rng.uniform(-0.5, 0.5, 20)])
    current = before + np.array([0.3, -0.2, 0.8])
    source = ParameterCovariance(rig, COVARIANCE_NAMES, covariance())
    found = factor_of(source, before, current)
    at = Estimator.at(rig, before, current)
    own = at.by_match @ (noise**2 * np.kron(np.eye(3) + 1.0, np.eye(2))) @ np.swapaxes(at.by_match, 1, 2)  # type: ignore[operator]
    F = found.values[:, 3:].reshape(60, -1)
    stated = F @ F.T
    for k in range(20):
        stated[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += own[k]
    seen = [[c.project(p).xy for c in (rig.cam1, rig.cam2)] for p in (before, current)]
    nominal = [camera.paper_parameters() for camera in (rig.cam1, rig.cam2)]
    got = []
    for change in rng.multivariate_normal(np.zeros(20), source.covariance, draws):
        cameras = [
            Camera.from_paper(
                **{**values, **{n: values[n] + d for n, d in zip(TEN_PARAMETER_NAMES, part, strict=True)}}
            )
            for values, part in zip(nominal, np.split(change, 2), strict=True)
        ]
        n = noise * rng.standard_normal((4, 20, 2))  # the reference subset's, camera 2's at t0, both at t
        noisy = [seen[0][0], seen[0][1] + n[1] - n[0]], [seen[1][0] + n[2] - n[0], seen[1][1] + n[3] - n[0]]
        got.append(measured_numerically(StereoPair(*cameras), *noisy, before, current)[:, 3:].ravel())
    sampled = np.cov(np.asarray(got).T)
    value, vector = np.linalg.eigh(stated)
    assert np.linalg.norm(F) ** 2 > 0.3 * np.trace(stated)
    # along the stated axes: 1,500 draws know each variance to 3.7 %
    ratio = np.einsum("ij,ik,kj->j", vector, sampled, vector) / value
    assert np.abs(np.mean(ratio) - 1.0) < 0.03
    assert np.abs(ratio - 1.0).max() < 0.15
    # eigenvalues of samples spread by themselves: beside those of as many draws of the stated covariance
    root = np.linalg.cholesky(stated)
    alike = [np.linalg.eigvalsh(np.cov(root @ rng.standard_normal((60, draws)))) for _ in range(8)]
    np.testing.assert_allclose(np.linalg.eigvalsh(sampled) / np.mean(alike, axis=0), 1.0, atol=0.1)
