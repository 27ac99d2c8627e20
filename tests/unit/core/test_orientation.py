"""Changes of orientation from offsets across epipolar lines: on matches made by formulas of another rig."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, uniform_filter

from stereorig.core.cameras.camera import TEN_PARAMETER_NAMES, Camera
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.orientation import changed, changes_between, consequence_of, estimate_change, judge_offsets
from stereorig.core.orientation.change import ends_of
from stereorig.core.orientation.matched import MatchedPoints
from stereorig.core.orientation.noise import structure_left_px
from stereorig.core.orientation.offsets import StepOffsets, calibration_slopes
from stereorig.core.orientation.propagate import pose_parameters, repaired_covariance
from stereorig.core.orientation.repair import RepairedPair
from tests.support.bumped_rig import SIZE, core_pair, false_strain, plain_camera, pose_points, turned
from tests.support.independent_rig import PlainCamera

NOISE_PX = 0.005


def matches(cam1: PlainCamera, cam2: PlainCamera, rng: np.random.Generator, *, pose: int = 0) -> MatchedPoints:
    """Points on a grid of camera 1, seen by both with noise in camera 2."""
    x, y = np.meshgrid(np.arange(60.0, 741.0, 20.0), np.arange(60.0, 581.0, 20.0))
    xy1 = np.stack([x.ravel(), y.ravel()], axis=1)
    xy2 = cam2.project(pose_points(cam1, pose, xy1))
    inside = ((xy2 > 0.0) & (xy2 < np.array(SIZE))).all(axis=1)
    return MatchedPoints.of(xy1[inside], (xy2 + rng.normal(0.0, NOISE_PX, xy2.shape))[inside], pose)


def joined(cam1: PlainCamera, cam2: PlainCamera, rng: np.random.Generator) -> MatchedPoints:
    return MatchedPoints.joined([matches(cam1, cam2, rng, pose=k) for k in range(3)])


CAM1, CAM2 = plain_camera(-1.0), plain_camera(1.0)
PAIR = core_pair(CAM1, CAM2)


def test_a_change_and_its_numbers_belong_to_each_other() -> None:
    change = np.array([0.01, -0.02, 0.03, 0.015, -0.01])
    after = changed(PAIR, change)
    np.testing.assert_allclose(changes_between(PAIR, after), change, atol=1e-12)
    assert after.baseline_mm == pytest.approx(PAIR.baseline_mm, rel=1e-12)
    assert after.cam1 is PAIR.cam1


def test_a_turn_of_camera_2_about_its_pinhole_is_its_rotation_vector() -> None:
    degrees = (0.4, -0.7, 0.2)
    change = changes_between(PAIR, core_pair(CAM1, turned(CAM2, degrees)))
    np.testing.assert_allclose(np.degrees(change), [*degrees, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("which", [1, 2])
@pytest.mark.parametrize("degrees", [(0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.2, 0.1), (1.2, -1.4, 0.7)])
def test_a_bump_is_found_within_its_uncertainty(which: int, degrees: tuple[float, float, float]) -> None:
    one, two = (turned(CAM1, degrees), CAM2) if which == 1 else (CAM1, turned(CAM2, degrees))
    points = joined(one, two, np.random.default_rng(5))
    estimate = estimate_change(PAIR, points)
    error = estimate.change - changes_between(PAIR, core_pair(one, two))
    # chi-square of five numbers: 1 in 10,000 exceeds 25.7
    assert error @ np.linalg.solve(estimate.covariance, error) < 25.7
    repaired = changed(PAIR, estimate.change)
    # true points, without noise, lie on the repaired pair's epipolar lines
    true2 = two.project(pose_points(one, 0, points.xy1_px[points.step == 0]))
    assert np.sqrt(np.mean(repaired.epipolar_residual_px(points.xy1_px[points.step == 0], true2) ** 2)) < 0.002


def test_the_covariance_is_that_of_many_repetitions() -> None:
    two = turned(CAM2, (0.05, 0.1, -0.02))
    true = changes_between(PAIR, core_pair(CAM1, two))
    rng = np.random.default_rng(11)
    found = [estimate_change(PAIR, matches(CAM1, two, rng)) for _ in range(60)]
    errors = np.array([f.change - true for f in found])
    scaled = [e @ np.linalg.solve(f.covariance, e) / 5.0 for e, f in zip(errors, found, strict=True)]
    # 300 squares: sd of their mean 0.08; more is reported than noise alone, for errors that do not average out
    assert 0.3 < np.mean(scaled) < 1.25


def test_offsets_of_a_narrow_view_leave_the_vergence_to_the_size_of_the_bump() -> None:
    narrow = [replace(c, phd=12 * c.phd) for c in (CAM1, CAM2)]
    pair = core_pair(*narrow)
    moved = turned(narrow[1], (0.05, 0.0, 0.0))
    estimate = estimate_change(pair, matches(narrow[0], moved, np.random.default_rng(3)))
    assert estimate.determined < 4.5
    sigma = np.degrees(np.sqrt(np.diag(estimate.covariance)))
    assert sigma[1] > 3.0 * sigma[2]  # about y: vergence; about the optical axis: determined
    assert np.abs(np.degrees(estimate.change[:3]) - [0.05, 0.0, 0.0]).max() < 0.06


def noise_field(rng: np.random.Generator, points: MatchedPoints, *, correlated: bool) -> MatchedPoints:
    """The points with other noise; correlated as that of subsets that share half of their pixels."""
    rows = 27
    if not correlated:
        noise = rng.normal(0.0, NOISE_PX, points.xy2_px.shape)
    else:
        plane = gaussian_filter(rng.normal(size=(rows + 8, 60)), 1.0)
        at = np.round((points.xy1_px - 60.0) / 20.0).astype(int)
        noise = np.zeros(points.xy2_px.shape)
        noise[:, 1] = plane[at[:, 1], at[:, 0]] / plane.std() * NOISE_PX
    return MatchedPoints(points.xy1_px, points.xy2_px + noise, points.step)


@pytest.mark.parametrize("correlated", [False, True])
def test_noise_alone_is_not_called_a_motion(correlated: bool) -> None:
    rng = np.random.default_rng(2)
    clean = matches(CAM1, CAM2, np.random.default_rng(0))
    clean = MatchedPoints.of(clean.xy1_px, CAM2.project(pose_points(CAM1, 0, clean.xy1_px)))
    called = 0
    for _ in range(50):
        now, before = noise_field(rng, clean, correlated=correlated), noise_field(rng, clean, correlated=correlated)
        offsets = PAIR.epipolar_residual_px(before.xy1_px, before.xy2_px)
        findings = [
            judge_offsets(PAIR, now, own_px=0.004),
            judge_offsets(PAIR, now, before=(before, offsets), against="reference"),
        ]
        called += sum(bool(f and f.camera_moved) for f in findings)
    assert called == 0  # 100 tests at a chance of 1e-4 each


@pytest.mark.parametrize("spacing_px", [5, 10])
def test_noise_that_a_few_overlapping_subsets_share_is_not_called_a_motion(spacing_px: int) -> None:
    """Noise of pixels under random texture, as a least-squares match of each subset would have it."""
    rng, subset_px = np.random.default_rng(1), 21
    side = 200 + spacing_px * np.arange(9)
    xy1 = np.stack([a.ravel() for a in np.meshgrid(side, side)], axis=1).astype(float)
    xy2, at = CAM2.project(pose_points(CAM1, 0, xy1)), xy1.astype(int) - 170
    called = 0
    for _ in range(60):
        seen = []
        for _ in range(2):
            slope = np.gradient(gaussian_filter(rng.normal(size=(160, 160)), 1.5), axis=0)
            sums = [uniform_filter(a, subset_px) for a in (slope * rng.normal(size=slope.shape), slope**2)]
            error = (sums[0] / sums[1])[at[:, 1], at[:, 0]]
            moved = xy2 + np.outer(error * 0.05 / error.std(), [0.0, 1.0])
            seen.append(MatchedPoints.of(xy1, moved, subset_px=subset_px))
        now, before = seen
        offsets = PAIR.epipolar_residual_px(before.xy1_px, before.xy2_px)
        findings = [
            judge_offsets(PAIR, now, own_px=0.004),
            judge_offsets(PAIR, now, before=(before, offsets), against="reference"),
        ]
        called += sum(bool(f and f.camera_moved) for f in findings)
    assert called == 0  # of 120; 103 and 22 before the overlap was counted


def test_a_hundredth_of_a_degree_between_two_steps_is_told_with_its_consequence() -> None:
    before = matches(CAM1, CAM2, np.random.default_rng(0))
    two = turned(CAM2, (0.0, 0.02, 0.0))
    now = matches(CAM1, two, np.random.default_rng(1))
    finding = judge_offsets(
        PAIR, now, before=(before, PAIR.epipolar_residual_px(before.xy1_px, before.xy2_px)), against="reference"
    )
    assert finding is not None
    assert finding.camera_moved
    assert "a camera moved" in finding.text
    assert finding.consequence is not None
    # the truth by other formulas: the true points beside those that the old pair makes of the images
    true = pose_points(CAM1, 0, now.xy1_px)
    strain = 1e6 * false_strain(true, PAIR.triangulate(now.xy1_px, two.project(true)).xyz_mm).max()
    cost = finding.consequence
    assert abs(cost.strain_microstrain - strain) < 4.0 * cost.strain_sigma_microstrain
    assert strain > 500.0  # an offset of 0.015 px only


def drawn(rng: np.random.Generator, covariance: np.ndarray) -> StereoPair:
    """A pair whose parameters are off by a draw of the covariance."""
    off = rng.multivariate_normal(np.zeros(20), covariance)
    cameras = []
    for camera, part in zip((PAIR.cam1, PAIR.cam2), (off[:10], off[10:]), strict=True):
        values = camera.paper_parameters()
        for name, value in zip(TEN_PARAMETER_NAMES, part, strict=True):
            values[name] += value
        cameras.append(Camera.from_paper(**values))
    return StereoPair(*cameras)


SIGMA = np.array([0.3, 0.3, 0.3, 1e-10, 2e-5, 4e-5, 4e-5, 0.01, 0.01, 0.05] * 2)


def test_the_offset_of_a_calibration_s_own_error_is_not_called_a_motion() -> None:
    rng = np.random.default_rng(4)
    covariance = np.diag(SIGMA**2)
    points = matches(CAM1, CAM2, rng)
    with_it, without = [], []
    for _ in range(40):
        pair = drawn(rng, covariance)
        with_it.append(judge_offsets(pair, points, covariance=covariance))
        without.append(judge_offsets(pair, points, own_px=0.004))
    assert not any(f.camera_moved for f in with_it if f)
    assert all(f.camera_moved is False for f in with_it if f)
    assert sum(bool(f.camera_moved) for f in without if f) > 20  # a calibration that claims less than it is off
    # six squares of unit variance at most, sd of 40 means 0.55: errors that do not average out are allowed for besides
    assert 1.0 < np.mean([f.chi_square for f in with_it if f]) < 7.5


def test_a_motion_in_depth_under_an_uncertain_calibration_is_no_camera_s() -> None:
    rng = np.random.default_rng(6)
    covariance = np.diag((4.0 * SIGMA) ** 2)
    before, now = (matches(CAM1, CAM2, rng, pose=k) for k in (1, 2))  # 14 mm and 18 degrees apart
    with_it, without = [], []
    for _ in range(40):
        pair = drawn(rng, covariance)
        held = before, pair.epipolar_residual_px(before.xy1_px, before.xy2_px)
        without.append(judge_offsets(pair, now, before=held, against="reference"))
        with_it.append(judge_offsets(pair, now, before=held, against="reference", covariance=covariance))
    assert all(f.camera_moved is False for f in with_it if f)
    assert sum(bool(f.camera_moved) for f in without if f) > 10
    assert 1.0 < np.mean([f.chi_square for f in with_it if f]) < 7.5  # six squares, as above
    # at the same depths it cancels, and a bump is told as before
    bumped = matches(CAM1, turned(CAM2, (0.0, 0.02, 0.0)), rng)
    still = matches(CAM1, CAM2, rng)
    held = still, PAIR.epipolar_residual_px(still.xy1_px, still.xy2_px)
    told = judge_offsets(PAIR, bumped, before=held, against="reference", covariance=covariance)
    assert told is not None
    assert told.camera_moved


def test_what_is_known_of_a_step_changes_no_digit_of_a_finding() -> None:
    rng = np.random.default_rng(8)
    points, earlier = matches(CAM1, CAM2, rng), matches(CAM1, CAM2, rng)
    points.xy2_px[5] = np.nan  # a point without an offset
    ends = ends_of(PAIR, np.zeros(5))
    known, held = (StepOffsets(PAIR, of, ends=ends) for of in (points, earlier))
    before = earlier, PAIR.epipolar_residual_px(earlier.xy1_px, earlier.xy2_px)
    for _ in range(2):  # what the first call made, the second one takes
        alone, shared = judge_offsets(PAIR, points), judge_offsets(PAIR, known)
        assert alone is not None
        assert shared is not None
        assert alone.points == len(points.xy1_px) - 1
        assert alone.document() == shared.document()
        one = judge_offsets(PAIR, points, before=before, against="reference")
        two = judge_offsets(PAIR, known, before=held, against="reference")
        assert one is not None
        assert two is not None
        assert one.document() == two.document()


def test_slopes_of_the_offset_are_its_differences() -> None:
    points = matches(CAM1, CAM2, np.random.default_rng(7))
    slopes = calibration_slopes(PAIR, points)
    for k in range(20):
        ends = []
        for sign in (1.0, -1.0):
            cameras = []
            for c, camera in enumerate((PAIR.cam1, PAIR.cam2)):
                values = camera.paper_parameters()
                if k // 10 == c:
                    values[TEN_PARAMETER_NAMES[k % 10]] += sign * 0.1 * SIGMA[k]
                cameras.append(Camera.from_paper(**values))
            ends.append(StereoPair(*cameras).epipolar_residual_px(points.xy1_px, points.xy2_px))
        numeric = (ends[0] - ends[1]) / (0.2 * SIGMA[k])
        np.testing.assert_allclose(slopes[:, k], numeric, atol=2e-4 * np.abs(numeric).max() + 1e-6 / SIGMA[k])


def test_an_imported_calibration_s_offset_asserts_nothing() -> None:
    points = matches(CAM1, turned(CAM2, (0.05, 0.0, 0.0)), np.random.default_rng(0))
    finding = judge_offsets(PAIR, points, imported=True)
    assert finding is not None
    assert finding.camera_moved is None
    assert finding.offset_rms_px > 0.5
    assert "does not show that a camera moved" in finding.text


@pytest.mark.parametrize(("turn_deg", "moved"), [(0.0, False), (0.002, None), (0.02, True)])
def test_an_unknown_error_s_own_size_is_no_motion_between_steps(turn_deg: float, moved: bool | None) -> None:
    wrong = turned(CAM2, (0.005, 0.0, 0.0))  # the calibration is wrong by this from the start
    earlier = matches(CAM1, wrong, np.random.default_rng(0))
    points = matches(CAM1, turned(wrong, (turn_deg, 0.0, 0.0)), np.random.default_rng(1))
    own = judge_offsets(PAIR, earlier, imported=True)
    assert own is not None
    before = earlier, PAIR.epipolar_residual_px(earlier.xy1_px, earlier.xy2_px)
    finding = judge_offsets(PAIR, points, before=before, against="reference", own_px=own.offset_rms_px)
    assert finding is not None
    assert finding.camera_moved is moved


def test_offsets_that_no_orientation_explains_are_structure() -> None:
    rng = np.random.default_rng(1)
    points = joined(CAM1, turned(CAM2, (0.1, 0.0, 0.0)), rng)
    assert structure_left_px(points, estimate_change(PAIR, points).residual_px, order=3) < 0.002
    # another distortion
    lens = replace(CAM2, kappa=CAM2.kappa + 1.5e-8)
    points = joined(CAM1, lens, rng)
    assert structure_left_px(points, estimate_change(PAIR, points).residual_px, order=3) > 0.02


@pytest.mark.deep
def test_the_repaired_parameters_covariance_is_that_of_many_repairs() -> None:
    rng = np.random.default_rng(8)
    covariance = np.diag((0.3 * SIGMA) ** 2)
    two = turned(CAM2, (0.1, 0.15, -0.05))
    points = joined(CAM1, two, rng)

    def repaired(old: StereoPair, seen: MatchedPoints) -> RepairedPair:
        new = changed(old, estimate_change(old, seen).change)
        estimate = estimate_change(new, seen, bump_rad=0.003)
        cost = consequence_of(new, seen, estimate.change, estimate.covariance)
        assert cost is not None
        return RepairedPair(new, changes_between(old, new), estimate, seen, 0.0, 0.0, 0.0, 0.0, cost)

    steps = 1e-2 * SIGMA
    stepped = []
    for k in range(20):
        ends = []
        for sign in (1.0, -1.0):
            cameras = [c.paper_parameters() for c in (PAIR.cam1, PAIR.cam2)]
            cameras[k // 10][TEN_PARAMETER_NAMES[k % 10]] += sign * steps[k]
            ends.append(StereoPair(*(Camera.from_paper(**c) for c in cameras)))
        stepped.append((ends[0], ends[1]))
    whole = repaired_covariance(repaired(PAIR, points), covariance, stepped, steps, range(14, 20))
    poses = np.array(
        [pose_parameters(repaired(drawn(rng, covariance), joined(CAM1, two, rng)).pair) for _ in range(80)]
    )
    predicted = np.sqrt(np.diag(whole)[14:])
    # sd of a sd of 80: 8 %; the estimate's own part counts errors that these matches do not have
    np.testing.assert_array_less(poses.std(axis=0), 1.3 * predicted)
    np.testing.assert_array_less(0.6 * predicted, poses.std(axis=0))
