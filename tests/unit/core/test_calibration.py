"""Calibration from intersections made by an independent projection."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereorig.core.calibration import (
    CalibrationOptions,
    CalibrationResult,
    CalibrationView,
    NominalValues,
    calibrate,
    check_known_distance,
)
from stereorig.core.calibration.checks.agreement import lens_faults
from stereorig.core.calibration.fit.lens_form import LensChoice
from stereorig.core.cameras.lens import LensModel, OpenCVLens, SeidelLens
from stereorig.core.errors import CalibrationError, CalibrationInputError
from stereorig.core.names import CAMERAS
from stereorig.core.target import GridTarget
from tests.support.calibration_rigs import (
    TrueCamera,
    aligned_rms_um,
    flat,
    hand_held,
    observed,
    ordinary_pair,
    views_of_poses,
)
from tests.support.calibration_rigs import shape_error_um as rig_shape_error_um
from tests.support.calibration_truth import HELD, NOISE_PX, NOMINAL, PAPER, Array, Grid, make_views, nodes, project


def shape_error_um(result: CalibrationResult) -> float:
    """RMS error of points in the target's volume, seen by the true cameras, after the best rigid alignment."""
    X, Y, Z = (a.ravel() for a in np.meshgrid(*[np.linspace(-4, 4, 5)] * 2, [-1.0, 0.0, 1.0]))
    found = result.pair.triangulate(*(project(c, X, Y, 0.0, Z) for c in PAPER)).xyz_mm
    truth = np.column_stack([X, Y, Z])
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return float(1e3 * np.sqrt(np.mean((a @ u @ vt - b) ** 2)))


@pytest.mark.parametrize(
    ("phd", "standoff", "angle"),
    [(1.0, 1.0, 0.0), (1.2, 0.8, 8.0), (0.8, 1.2, -8.0), (1.2, 1.2, -8.0), (0.8, 0.8, 8.0)],
)
def test_finds_the_cameras_from_poor_nominal_values(phd: float, standoff: float, angle: float) -> None:
    nominal = tuple(
        dataclasses.replace(
            n, phd_px=n.phd_px * phd, standoff_mm=n.standoff_mm * standoff, angle_deg=n.angle_deg + angle
        )
        for n in NOMINAL
    )
    exact = dataclasses.replace(HELD, axis_tilt_sigma_rad=0.0)
    result = calibrate(make_views(noise=0.0), Grid(), (nominal[0], nominal[1]), exact)
    for camera, truth in zip((result.pair.cam1, result.pair.cam2), PAPER, strict=True):
        got = camera.paper_parameters()
        for key, value in got.items():
            name = key.replace("_per_px2", "").rsplit("_", 1)[0] if key != "kappa_per_px2" else "kappa"
            # noise-free; what is left is the weak prior on the centre against rounding
            assert value == pytest.approx(truth[name], rel=1e-4, abs=1e-5), key
    assert result.held_out is not None
    assert result.held_out.mean.rbe_px < 1e-4
    assert shape_error_um(result) < 1e-3


def test_exact_grid_reaches_the_noise_in_held_out_positions() -> None:
    result = calibrate(make_views(), Grid(), NOMINAL, HELD)
    assert result.held_out is not None
    # mean distance of isotropic noise is 1.253 sigma = 0.00276
    assert result.held_out.mean.rbe_px < 0.0035
    assert result.fitted.mean.rbe_px < 0.0030
    np.testing.assert_allclose(result.noise_px, NOISE_PX, rtol=0.1)
    assert result.verdict.level == "good"
    assert shape_error_um(result) < 0.05
    assert result.node_corrections_mm is None


def test_toleranced_grid_is_corrected_from_both_cameras() -> None:
    grid = Grid(node_tolerance_mm=0.004)
    error = np.random.default_rng(3).uniform(-0.004, 0.004, (9, 9, 2))
    views = make_views(grid=grid, error_mm=error)
    result = calibrate(views, grid, NOMINAL, HELD)
    held_fixed = calibrate(views, grid, NOMINAL, dataclasses.replace(HELD, estimate_nodes=False))
    assert result.held_out is not None
    assert held_fixed.held_out is not None
    assert result.held_out.mean.rbe_px < 0.0045
    # 4 um in a box leave 0.087 px against the nominal grid at 33 um/px; this figure must not hide
    assert 0.06 < result.held_out.nominal_mean.rbe_px < 0.11
    assert 0.06 < held_fixed.held_out.mean.rbe_px < 0.11
    assert shape_error_um(result) < 0.75
    assert shape_error_um(result) < shape_error_um(held_fixed)


@pytest.mark.fault(30)
@pytest.mark.parametrize(
    ("positions", "code"),
    [
        ((0.0,), "calibration_one_position"),
        ((2.0, 2.0, 2.0), "calibration_one_position"),
        ((0.0, 0.002), "calibration_dz_too_small"),
        ((0.0, 0.1), "calibration_dz_too_small"),
    ],
)
def test_too_little_travel_is_refused_with_the_predicted_uncertainty(positions: tuple[float, ...], code: str) -> None:
    with pytest.raises(CalibrationInputError, match=r"predicted uncertainty .* um rms of shape") as caught:
        calibrate(make_views(positions), Grid(), NOMINAL)
    assert caught.value.code == code
    assert caught.value.context["predicted_shape"] > 0.0


@pytest.mark.fault(31)
@pytest.mark.parametrize(
    ("declared", "code", "fragment"),
    [
        (lambda dz: -dz, "positions_sign_reversed", "sign"),
        (lambda dz: 1000.0 * dz, "positions_unit", "micrometres for millimetres"),
        (lambda dz: dz / 25.4, "positions_unit", "inches"),
        (lambda dz: {0.0: 4.0, 2.0: 2.0, 4.0: 0.0, 5.0: 5.0}[dz], "positions_permuted", "seem exchanged"),
        (lambda dz: {0.0: 0.0, 2.0: 4.0, 4.0: 2.0, 5.0: 5.0}[dz], "positions_permuted", "seem exchanged"),
        (lambda dz: {0.0: 0.0, 2.0: 2.5, 4.0: 4.0, 5.0: 5.0}[dz], "position_wrong", r"worst is cam1 at \+2.500"),
    ],
)
def test_wrong_positions_are_refused_with_the_cause(
    declared: Callable[[float], float], code: str, fragment: str
) -> None:
    with pytest.raises(CalibrationInputError, match=fragment) as caught:
        calibrate(make_views(declared=declared), Grid(), NOMINAL)
    assert caught.value.code == code


def changed(views: list[CalibrationView], camera: str, change: Callable[[Array], Array]) -> list[CalibrationView]:
    return [dataclasses.replace(v, xy_px=change(v.xy_px)) if v.camera == camera else v for v in views]


def mirrored(xy: Array) -> Array:
    # seen in a mirror, the family that runs right-and-down is the other one
    return np.swapaxes(np.stack([511.0 - xy[..., 0], xy[..., 1]], -1), 0, 1)


def quarter_turned(xy: Array) -> Array:
    # clockwise: right-and-down becomes left-and-down, left-and-down becomes left-and-up
    turned = np.stack([511.0 - xy[..., 1], xy[..., 0]], -1)
    return np.swapaxes(turned, 0, 1)[::-1]


def half_turned(xy: Array) -> Array:
    return np.stack([511.0 - xy[..., 0], 479.0 - xy[..., 1]], -1)[::-1, ::-1]


@pytest.mark.fault(29)
@pytest.mark.parametrize("angles", [(-29.0, 31.0), (1.0, 24.0), (-4.2, 4.1)])
def test_swapped_cameras_are_named(angles: tuple[float, float]) -> None:
    cameras = [{**c, "gamma": np.radians(a)} for c, a in zip(PAPER, angles, strict=True)]
    nominal = tuple(dataclasses.replace(n, angle_deg=round(a)) for n, a in zip(NOMINAL, angles, strict=True))
    views = make_views(cameras=cameras)
    assert calibrate(views, Grid(), (nominal[0], nominal[1])).fitted.mean.rbe_px < 0.003
    views = [dataclasses.replace(v, camera="cam2" if v.camera == "cam1" else "cam1") for v in views]
    with pytest.raises(CalibrationInputError, match="swapped") as caught:
        calibrate(views, Grid(), (nominal[0], nominal[1]))
    assert caught.value.code == "cameras_swapped"


@pytest.mark.fault(29)
@pytest.mark.parametrize("camera", ["cam1", "cam2"])
def test_a_mirrored_image_is_named(camera: str) -> None:
    with pytest.raises(CalibrationInputError, match=f"{camera} is tilted to the other side") as caught:
        calibrate(changed(make_views(), camera, mirrored), Grid(), NOMINAL)
    assert caught.value.code == "image_mirrored"


@pytest.mark.parametrize("alphas", [(30.0, 52.0), (36.0, 57.0), (62.0, 40.0)])
def test_cameras_rolled_against_each_other_are_no_fault(alphas: tuple[float, float]) -> None:
    cameras = [{**c, "alpha": np.radians(a)} for c, a in zip(PAPER, alphas, strict=True)]
    result = calibrate(make_views(cameras=cameras), Grid(), NOMINAL)
    assert result.verdict.level != "failed"
    assert result.fitted.mean.rbe_px < 0.003


@pytest.mark.fault(29)
def test_an_image_upside_down_is_named() -> None:
    with pytest.raises(CalibrationInputError, match=r"cam2 .* mirrored or turned by 180 degrees") as caught:
        calibrate(changed(make_views(), "cam2", half_turned), Grid(), NOMINAL)
    assert caught.value.code == "image_mirrored"


@pytest.mark.fault(29)
@pytest.mark.parametrize("both", [True, False])
def test_a_quarter_turn_is_named(both: bool) -> None:
    square = [{**c, "aspect": 1.0, "cy": c["cy"] + 16.0} for c in PAPER]
    nominal = tuple(dataclasses.replace(n, image_size_px=(512, 512), aspect=1.0) for n in NOMINAL)
    views = changed(make_views(cameras=square), "cam1", quarter_turned)
    if both:
        views = changed(views, "cam2", quarter_turned)
    with pytest.raises(CalibrationInputError, match="turned by 90 degrees") as caught:
        calibrate(views, Grid(), (nominal[0], nominal[1]))
    assert caught.value.code == "image_rotated"


def tilted(camera: dict[str, float], axis: int, degrees: float) -> dict[str, float]:
    """The camera as it sees a target that is turned about one of its own axes in its plane."""
    own = Rotation.from_euler("XYZ", [camera["beta"], camera["gamma"], camera["alpha"]])
    turned = (own * Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis])).as_euler("XYZ")
    angles = dict(zip(("beta", "gamma", "alpha"), (float(a) for a in turned), strict=True))
    return {**camera, **angles}


@pytest.mark.fault(29)
@pytest.mark.parametrize(("axis", "degrees"), [(0, 30.0), (0, -38.0), (1, -30.0), (1, 20.0)])
def test_a_tilted_target_is_calibrated_and_its_tilt_is_named_and_no_turn_of_the_image(
    axis: int, degrees: float
) -> None:
    views = make_views(cameras=[tilted(c, axis, degrees) for c in PAPER])
    result = calibrate(views, Grid(), NOMINAL, HELD)
    assert result.verdict.level == "good"
    assert result.fitted.mean.rbe_px < 0.003
    text = next(c.text for c in result.checks if c.name == "angles")
    # the cameras stand up to 1 degree from their nominal angles
    assert float(text.split("tilted by ")[1].split(" degrees")[0]) == pytest.approx(abs(degrees), abs=1.0)
    exchanged = [dataclasses.replace(v, camera="cam2" if v.camera == "cam1" else "cam1") for v in views]
    with pytest.raises(CalibrationInputError, match="swapped"):
        calibrate(exchanged, Grid(), NOMINAL, HELD)


def test_a_principal_point_far_off_is_found_and_named_with_its_amount() -> None:
    # a part of the sensor's image, 1,500 px beside the optical axis: the camera looks at the grid by its rim
    cameras = [{**c, "cx": c["cx"] + 1500.0, "x0": c["x0"] - 1500.0 * c["z0"] / c["phd"]} for c in PAPER]
    result = calibrate(make_views(cameras=cameras), Grid(), NOMINAL, HELD)
    assert result.verdict.level == "warning"
    assert result.fitted.mean.rbe_px < 0.003
    text = next(r for r in result.verdict.reasons if "images of cam2 shrink" in r)
    assert float(text.split("point ")[1].split(" px")[0]) == pytest.approx(1500.0, rel=0.02)
    assert "principal point of cam2" in text
    assert result.pair.cam1.paper_parameters()["cx_px"] == pytest.approx(cameras[0]["cx"], abs=60.0)


@pytest.mark.parametrize(
    ("declared", "remark"),
    [
        ((12000.0, 9000.0), None),
        ((9000.0, 12000.0), "are those declared of the other one"),
        ((9300.0, 9000.0), "pinhole distance of cam1 is 1.... px, 29 % off the declared 9300 px"),
    ],
)
def test_pinhole_distances_that_contradict_the_declared_ones_are_remarked(
    declared: tuple[float, float], remark: str | None
) -> None:
    views = make_views(cameras=[PAPER[0], {**PAPER[1], "phd": 9000.0}])
    nominal = tuple(dataclasses.replace(n, phd_px=p) for n, p in zip(NOMINAL, declared, strict=True))
    reasons = calibrate(views, Grid(), (nominal[0], nominal[1]), HELD).verdict.reasons
    found = [r for r in reasons if "inhole distance" in r]
    assert len(found) == (remark is not None)
    assert remark is None or re.search(remark, found[0])


@pytest.mark.fault(29)
def test_a_camera_at_another_angle_is_named_and_a_small_difference_is_not_held_against_it() -> None:
    off = (NOMINAL[0], dataclasses.replace(NOMINAL[1], angle_deg=5.0))
    with pytest.raises(CalibrationInputError, match="cam2 looks at the target from another angle") as caught:
        calibrate(make_views(), Grid(), off)
    assert caught.value.code == "angle_mismatch"
    near = (NOMINAL[0], dataclasses.replace(NOMINAL[1], angle_deg=18.0))
    assert calibrate(make_views(), Grid(), near).fitted.mean.rbe_px < 0.003


def at_review_noise(**how: Any) -> list[CalibrationView]:
    """Marks as a localiser finds them in images of 2 of 255 grey levels of noise, 0 to 5 mm."""
    return make_views((0.0, 1.0, 2.0, 3.0, 4.0, 5.0), noise=0.0045, **how)


def nominal_of(aspect: float) -> tuple[NominalValues, NominalValues]:
    one, two = (dataclasses.replace(n, aspect=aspect) for n in NOMINAL)
    return one, two


@pytest.mark.fault(32)
@pytest.mark.parametrize(
    ("pitch", "aspect", "long", "percent", "lens"),
    [
        # each scale with one lens, a pitch and an aspect ratio also with the lens that is chosen by itself
        (1.01, 0.9617, 1.0, 1.0, "opencv5"),
        (1.01, 0.9617, 1.0, 1.0, "auto"),
        (1.05, 0.9617, 1.0, 5.0, "opencv5"),
        (2.0, 0.9617, 1.0, 100.0, "opencv5"),
        (1.0, 0.9637, 1.0, None, "opencv5"),
        (1.0, 0.9637, 1.0, None, "auto"),
        (1.0, 1.0, 1.0, None, "opencv5"),
        (1.0, 0.9617, 1.02, 2.0, "opencv5"),
        pytest.param(1.05, 0.9617, 1.0, 5.0, "auto", marks=pytest.mark.deep),
        pytest.param(2.0, 0.9617, 1.0, 100.0, "auto", marks=pytest.mark.deep),
        pytest.param(1.0, 1.0, 1.0, None, "auto", marks=pytest.mark.deep),
        pytest.param(1.0, 0.9617, 1.02, 2.0, "auto", marks=pytest.mark.deep),
    ],
)
def test_scales_that_contradict_each_other_fail_with_the_amount(
    pitch: float, aspect: float, long: float, percent: float | None, lens: LensChoice
) -> None:
    views = at_review_noise(declared=lambda dz: dz / long)
    result = calibrate(views, Grid(pitch_mm=pitch), nominal_of(aspect), CalibrationOptions(lens=lens))
    assert result.verdict.level == "failed"
    found = result.lens.structure[0]
    assert any(reason == found.text and "Stage and grid disagree by" in reason for reason in result.verdict.reasons)
    off, sigma = found.terms["stage over pitch"]
    if percent is not None:
        assert 100.0 * off == pytest.approx(percent, abs=300.0 * sigma)
        assert f"disagree by {100.0 * off:.2f} +- {100.0 * sigma:.2f} %" in found.text
    elif "aspect 1" in found.terms:
        value, spread = found.terms["aspect 1"]
        assert value == pytest.approx(0.9617, abs=4.0 * spread)


@pytest.mark.fault(32)
def test_right_scales_are_good_and_the_check_says_how_well_they_agree() -> None:
    found = [calibrate(at_review_noise(seed=seed), Grid(), NOMINAL) for seed in range(6)]
    assert [r.verdict.level for r in found] == ["good"] * 6
    check = {c.name: c for c in found[0].checks}["scales"]
    assert check.made
    assert "% farther than it reads" in check.text


def _modern_rig(
    focal_mm: float,
    lens: tuple[float, ...],
    *,
    long: float = 1.0,
    step_mm: float = 0.0,
    axis_rad: tuple[float, float] = (0.0, 0.0),
    bow_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    shear: float = 0.0,
    stretch: float = 0.0,
    aspects: tuple[float, float] = (1.0, 1.0),
    turns_rad: Array | None = None,
    bend_mm: Array | None = None,
    tau_rad: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0)),
    noise_px: float = 0.02,
    roll_deg: float = 2.0,
    seed: int = 1,
) -> tuple[list[CalibrationView], GridTarget, tuple[NominalValues, NominalValues], tuple[TrueCamera, TrueCamera]]:
    """Six positions of two stages before pixels of 3.45 um, with errors of the travel; OpenCV's projection."""
    focal_px, size, pitch_mm = focal_mm / 0.00345, (2448, 2048), 8.0
    standoff_mm = focal_px * 10.0 * pitch_mm / 1.05 / size[1]
    one, two = ordinary_pair(lens, focal_px=focal_px, standoff_mm=standoff_mm, roll_deg=roll_deg)
    if np.any(tau_rad):
        one, two = (
            dataclasses.replace(c, lens=(*lens, *np.zeros(7), *tau)) for c, tau in zip((one, two), tau_rad, strict=True)
        )
    one, two = (
        dataclasses.replace(c, K=c.K * [[1.0], [a], [1.0]] + [[0.0] * 3, [0.0, 0.0, (1.0 - a) * c.K[1, 2]], [0.0] * 3])
        for c, a in zip((one, two), aspects, strict=True)
    )
    cameras = one, two
    at = (np.arange(11) - 5.0) * pitch_mm
    points = flat(np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1))
    x, y = np.moveaxis(points[..., :2] / at.max(), -1, 0)
    second = np.stack([x * x, x * y, y * y], axis=-1)
    points[..., 2] = second @ bow_mm
    points[..., :2] += (
        0.0 if bend_mm is None else np.concatenate([x[..., None], y[..., None], second], axis=-1) @ bend_mm
    )
    points[..., 0] += shear * points[..., 1] + stretch * points[..., 0]
    rng = np.random.default_rng(seed)
    along = np.array([*axis_rad, np.sqrt(1.0 - np.square(axis_rad).sum())])
    views = []
    for name, camera, turn in zip(CAMERAS, cameras, np.zeros((2, 3)) if turns_rad is None else turns_rad, strict=True):
        for share in np.linspace(0.0, 1.0, 6):
            dz = share * 0.1 * standoff_mm
            moved = camera.moved((long * dz + step_mm * rng.standard_normal()) * along)
            turned = points @ Rotation.from_rotvec(share * turn).as_matrix().T
            views.append(CalibrationView(name, float(dz), observed(moved, turned, rng, noise_px)))
    nominal = NominalValues(size, focal_px, standoff_mm, -12.5), NominalValues(size, focal_px, standoff_mm, 12.5)
    return views, GridTarget(pitch_mm=pitch_mm, lines=(13, 13), line_width_mm=0.8), nominal, cameras


@pytest.mark.fault(32)
def test_a_scale_that_a_wide_lens_hides_is_named_with_its_amount_unless_it_is_stated() -> None:
    # a lens of 12 mm on pixels of 3.45 um, five coefficients, OpenCV's projection: the stage reads 0.2 % too little
    views, target, nominal, cameras = _modern_rig(12.0, (-0.1, 0.08, 0.0, 0.0, 0.0), long=1.002)
    result = calibrate(views, target, nominal)
    assert (
        rig_shape_error_um(result.pair, cameras, result.uncertainty.points_mm) > 4e3 * result.uncertainty.shape_rms_mm
    )
    assert result.verdict.level == "good", "no residual shows it"
    (reason,) = (text for text in result.verdict.reasons if "hardly show" in text)
    said = re.search(r"off by ([0-9.]+) % would hardly show in these views and move the shape by ([0-9.]+) um", reason)
    assert said is not None, reason
    assert "State stage_scale_sigma" in reason
    # the same noise on a stage that is right: what the scale alone moves
    right = calibrate(_modern_rig(12.0, (-0.1, 0.08, 0.0, 0.0, 0.0))[0], target, nominal)
    points = right.uncertainty.points_mm
    seen = [camera.project(points).xy for camera in (right.pair.cam1, right.pair.cam2)]
    moved_um = aligned_rms_um(result.pair.triangulate(*seen).xyz_mm, points)
    assert float(said[2]) == pytest.approx(moved_um * float(said[1]) / 0.2, rel=0.1)
    # a certificate of 1e-4 is evidence, the same assumption is none
    certified = calibrate(views, target, nominal, CalibrationOptions(stage_scale_sigma=1e-4))
    assert certified.verdict.level == "good", "no residual shows it"
    assert not any("hardly show" in text for text in certified.verdict.reasons)
    np.testing.assert_array_equal(certified.covariance, result.covariance)
    check = {c.name: c for c in result.checks}["scales"]
    assert not check.made
    hidden = re.search(r"wrong by up to ([0-9.]+) % would not show", check.text)
    assert hidden is not None
    assert float(hidden[1]) > 0.2


@pytest.mark.fault(32)
@pytest.mark.parametrize("lens", [(0.0, 0.0, 0.0, 0.0, 0.0), (-0.05, 0.1, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize(
    ("check", "wrong"),
    [
        ("aspect", ({"aspects": (1.0001, 1.0)}, {"aspects": (1.0, 1.0001)})),
        ("target_shape", ({"stretch": 1e-4}, {"shear": 1e-4})),
    ],
)
def test_what_an_unstated_aspect_ratio_or_a_sheared_target_would_do_is_named_with_its_amount(
    check: str, wrong: tuple[dict[str, Any], ...], lens: tuple[float, ...]
) -> None:
    views, target, nominal, _ = _modern_rig(35.0, lens)
    options = CalibrationOptions(lens="paper" if not any(lens) else "opencv5")
    right = calibrate(views, target, nominal, options)
    found = {c.name: c for c in right.checks}[check]
    assert not found.made
    said = re.search(r"by ([0-9.]+) % would hardly show in these views and move the shape by ([0-9.]+) um", found.text)
    assert said is not None, found.text
    # the same noise before such errors: their squares add up, and most of a ten-thousandth is left by these views
    points = right.uncertainty.points_mm
    squares = 0.0
    for errors in wrong:
        off_views, _, _, cameras = _modern_rig(35.0, lens, **errors)
        off = calibrate(off_views, target, nominal, options)
        assert off.verdict.level == "good", "no residual shows it"
        seen = [camera.project(points) for camera in cameras]
        before = right.pair.triangulate(*(c.project(points) for c in _modern_rig(35.0, lens)[3])).xyz_mm
        squares += aligned_rms_um(off.pair.triangulate(*seen).xyz_mm, before) ** 2
    assert float(said[1]) == pytest.approx(0.01, rel=0.4)
    assert float(said[2]) == pytest.approx(np.sqrt(squares) * float(said[1]) / 0.01, rel=0.15)


@pytest.mark.parametrize("lens", [(-0.05, 0.1, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_stages_that_turn_over_their_travel_are_named_with_the_angle_and_reported(
    lens: tuple[float, ...], seed: int
) -> None:
    turns_rad = 1.5e-4 * np.random.default_rng(seed).standard_normal((2, 3))
    views, target, nominal, cameras = _modern_rig(25.0, lens, turns_rad=turns_rad, seed=seed)
    result = calibrate(views, target, nominal)
    assert result.verdict.level == "warning"
    said = [re.search(r"by ([0-9.]+) and ([0-9.]+) mrad over the travel", reason) for reason in result.verdict.reasons]
    (found,) = (m for m in said if m)
    true_mrad = 1e3 * np.linalg.norm(turns_rad, axis=1)
    np.testing.assert_allclose([float(found[1]), float(found[2])], true_mrad, atol=0.05)
    # up to five times as much as reported where none was looked for
    true_um = rig_shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
    assert true_um < 2e3 * result.uncertainty.shape_rms_mm


@pytest.mark.parametrize("lens", [(-0.05, 0.1, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("step_mm", [0.003, 0.01])
def test_the_scatter_of_a_stages_positions_is_named_by_its_size_and_reported(
    step_mm: float, lens: tuple[float, ...]
) -> None:
    views, target, nominal, cameras = _modern_rig(25.0, lens, step_mm=step_mm)
    result = calibrate(views, target, nominal, CalibrationOptions(stage_scale_sigma=0.0))
    assert result.verdict.level == "warning"
    said = [re.search(r"positions are off by ([0-9.]+) um rms", reason) for reason in result.verdict.reasons]
    # 18 to 22 um by the terms alone; twelve errors know their rms to a fifth
    assert [float(found[1]) for found in said if found] == [pytest.approx(1e3 * step_mm, rel=0.5)]
    # up to 3.2 times as much as reported where the positions were held
    true_um = rig_shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
    assert true_um < 1.5e3 * result.uncertainty.shape_rms_mm


def test_free_poses_show_the_scale_that_a_stage_alone_hides() -> None:
    views, target, nominal, cameras = _modern_rig(12.0, (-0.1, 0.08, 0.0, 0.0, 0.0))
    assert any("hardly show" in text for text in calibrate(views, target, nominal).verdict.reasons)
    rng = np.random.default_rng(4)
    nodes_mm = target.inner_points_mm()
    poses = hand_held(rng, cameras, flat(nodes_mm), 6, span_mm=20.0, least_share=0.6)
    free = views_of_poses(cameras, flat(nodes_mm), poses, rng, 0.02)
    result = calibrate([*views, *free], target, nominal)
    assert result.verdict.level == "good", result.verdict.reasons
    assert not any("hardly show" in text for text in result.verdict.reasons)


@pytest.mark.parametrize("lens", [(-0.05, 0.1, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0)])
def test_a_bow_that_is_named_is_in_the_reported_error(lens: tuple[float, ...]) -> None:
    ratios = []
    for seed in range(4):
        bow_mm = 0.02 * np.random.default_rng(seed).uniform(-1.0, 1.0, 3)
        views, target, nominal, cameras = _modern_rig(25.0, lens, bow_mm=tuple(bow_mm), seed=seed)
        result = calibrate(views, target, nominal)
        assert any("hold structure (bow:" in reason for reason in result.verdict.reasons), result.verdict.reasons
        assert result.verdict.level == "warning"
        true_um = rig_shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
        ratios.append(true_um / (1e3 * result.uncertainty.shape_rms_mm))
        total = np.sum(list(result.covariance_by_cause.values()), axis=0)
        np.testing.assert_allclose(total, result.covariance, rtol=1e-6, atol=1e-12 * np.abs(total).max())
    # the named amount is known to a tenth; 3 to 18 without it
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("lens", [(-0.05, 0.1, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0)])
def test_a_staged_grid_that_is_stretched_sheared_and_bent_within_its_tolerance_is_in_the_reported_error(
    lens: tuple[float, ...],
) -> None:
    ratios = []
    for seed in range(6):
        bend_mm = 0.01 / 3.0 * np.random.default_rng([35, seed]).standard_normal((5, 2))
        views, target, nominal, cameras = _modern_rig(35.0, lens, bend_mm=bend_mm, noise_px=0.01, seed=seed)
        result = calibrate(views, dataclasses.replace(target, node_tolerance_mm=0.01), nominal)
        true_um = rig_shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
        ratios.append(true_um / (1e3 * result.uncertainty.shape_rms_mm))
    # 1.1 and 3.2 where the points' errors were taken as independent of each other
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.3, ratios


@pytest.mark.parametrize(
    ("tau_rad", "roll_deg"),
    [
        (((0.002, -0.001), (-0.0005, 0.0012)), 2.0),
        (((0.002, -0.001), (-0.0005, 0.0012)), 45.0),
        (((0.001, 0.001), (-0.001, 0.002)), 45.0),
    ],
)
def test_sensors_tilted_by_a_few_milliradians_are_no_prism_and_no_error_of_the_grid(
    tau_rad: tuple[tuple[float, float], tuple[float, float]], roll_deg: float
) -> None:
    views, target, nominal, cameras = _modern_rig(
        25.0, (-0.5, 1.0, 0.0, 0.0, 0.0), tau_rad=tau_rad, roll_deg=roll_deg, noise_px=0.006
    )
    result = calibrate(views, target, nominal, CalibrationOptions(stage_scale_sigma=1e-4))
    assert (result.verdict.level, result.lens.model) == ("good", "opencv5_tilted"), result.verdict.reasons
    # 5.3 times as much as reported where it was called a prism
    true_um = rig_shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
    assert true_um < 2e3 * result.uncertainty.shape_rms_mm


@pytest.mark.parametrize("roll_deg", [2.0, 45.0])
def test_a_sheared_grid_is_no_tilted_sensor(roll_deg: float) -> None:
    lens = (-0.5, 1.0, 0.0, 0.0, 0.0)
    views, target, nominal, _ = _modern_rig(25.0, lens, shear=3e-4, roll_deg=roll_deg, noise_px=0.006)
    result = calibrate(views, target, nominal, CalibrationOptions(stage_scale_sigma=1e-4))
    assert result.verdict.level != "good"
    assert result.lens.model != "opencv5_tilted"


def test_stages_off_their_axes_near_the_limit_of_the_prior_are_no_wrong_aspect_ratio() -> None:
    views, target, nominal, cameras = _modern_rig(25.0, (-0.05, 0.1, 0.0, 0.0, 0.0), axis_rad=(0.003, -0.0015))
    result = calibrate(views, target, nominal, CalibrationOptions(stage_scale_sigma=1e-4))
    assert result.verdict.level == "good", result.verdict.reasons
    true_um = rig_shape_error_um(result.pair, cameras, result.uncertainty.points_mm)
    assert true_um < 1e3 * result.uncertainty.shape_rms_mm


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("periodic", "um rms against the images, most of all +3.000 mm of cam1"),
        ("slipped", "The position +3.000 mm of cam1's stage is off by +9"),
        ("moved", "The target moved in its plane between the views: by about 20"),
        ("tilted", "mrad off the optical axis"),
        ("bowed", "hold structure (bow: XX_mm = 0.01"),
    ],
)
def test_stage_and_target_that_err_are_named(how: str, words: str) -> None:
    X, Y = nodes(Grid())
    rng = np.random.default_rng(0)
    views = []
    for c, (name, camera) in enumerate(zip(CAMERAS, PAPER, strict=True)):
        for k, dz in enumerate((0.0, 1.0, 2.0, 3.0, 4.0, 5.0)):
            error = {"periodic": 0.01 * np.sin(2.0 * np.pi * dz / 1.7 + c), "slipped": 0.1 * (k == 3 and c == 0)}.get(
                how, 0.0
            )
            shift = 0.02 * (how == "moved" and k >= 3)
            bow = 0.03 * (how == "bowed") * (X**2 + Y**2) / 50.0
            tilt = (0.02, 0.0) if how == "tilted" else (0.0, 0.0)
            xy = project(camera, X + shift, Y, dz + error, bow, tilt=tilt)
            views.append(CalibrationView(name, dz, xy + 0.0045 * rng.standard_normal(xy.shape)))
    result = calibrate(views, Grid(), NOMINAL)
    assert result.verdict.level == "warning"
    assert any(words in reason for reason in result.verdict.reasons), result.verdict.reasons
    # one draw each; what is named was 1.5 to 18 times beyond the report
    assert shape_error_um(result) < 1.5e3 * result.uncertainty.shape_rms_mm


def test_default_priors_are_in_the_covariance_and_a_zero_is_exact() -> None:
    views = at_review_noise()
    stated = CalibrationOptions(lens="paper", stage_scale_sigma=0.0, aspect_sigma=0.0)
    exact = calibrate(views, Grid(), NOMINAL, stated)
    usual = calibrate(views, Grid(), NOMINAL, CalibrationOptions(lens="paper"))
    assert usual.sigma["cam1.aspect"] == pytest.approx(1e-4)
    assert usual.pair.cam1.values()["aspect"] == NOMINAL[0].aspect
    assert "cam1.aspect" not in exact.sigma
    np.testing.assert_array_equal(exact.stage.scale_sigma, 0.0)
    assert (usual.stage.scale_sigma > 9e-5).all()
    # an aspect ratio off by 1e-4 both ways moves the shape by what is reported
    off = [calibrate(views, Grid(), nominal_of(a), stated) for a in (0.9616, 0.9618)]
    seen = [camera.project(usual.uncertainty.points_mm).xy for camera in (off[1].pair.cam1, off[1].pair.cam2)]
    moved = off[0].pair.triangulate(*seen).xyz_mm
    both = aligned_rms_um(moved, usual.uncertainty.points_mm) / 2.0
    assert 0.5 * both < 1e3 * usual.uncertainty.shape_rms_mm < 2.0 * both
    square = calibrate(views, Grid(), nominal_of(1.0), CalibrationOptions(lens="paper"))
    assert "cam1.aspect" not in square.sigma
    toleranced = calibrate(views, Grid(node_tolerance_mm=4e-3), NOMINAL, stated)
    assert toleranced.pitch_scale_sigma == pytest.approx(4e-3 / np.sqrt(3.0) / 8.0, rel=0.1)


@pytest.mark.parametrize(
    ("lens", "word"),
    [
        (OpenCVLens(700.0, 700.0, 319.5, 239.5, k1=-0.3, k2=0.11), None),
        (OpenCVLens(700.0, 700.0, 319.5, 239.5, k1=-1.2), "folds"),
        (OpenCVLens(700.0, 700.0, 319.5, 239.5, k1=-9.0, k2=40.0, k3=-30.0), "alone"),
        (OpenCVLens(700.0, 700.0, 319.5, 239.5, p1=0.2), "decentring"),
        (OpenCVLens(700.0, 700.0, 319.5, 239.5, k1=3.0), "border by"),
        (SeidelLens(12000.0, 262.0, 233.0, 2.5e-9, 0.9617), None),
    ],
)
def test_a_lens_that_no_lens_is_is_found(lens: LensModel, word: str | None) -> None:
    faults, folded = lens_faults(lens, (640, 480))
    assert folded == any("folds" in fault for fault in faults)
    assert any(word in fault for fault in faults) if word else not faults


@pytest.mark.fault(32)
def test_a_pitch_wrong_as_much_as_the_stage_shows_in_a_known_distance_and_nowhere_else() -> None:
    views = make_views(declared=lambda dz: 1.005 * dz)
    held = dataclasses.replace(HELD, held_out_mm=(2.01, 4.02))
    result = calibrate(views, Grid(pitch_mm=1.005), NOMINAL, held)
    assert result.verdict.level == "good"
    assert result.held_out is not None
    assert result.held_out.mean.rbe_px < 0.0035
    made = {c.name: c.made for c in result.checks}
    assert made == {
        "held_out": True,
        "positions": True,
        "angles": True,
        "scales": True,
        "known_distance": False,
        "stage_axis": True,  # of the 1 mrad that is assumed
        "aspect": False,
        "target_shape": True,  # a ten-thousandth does less than that of the aspect ratio, which is reported
    }
    marks = np.array([[project(c, -3.0, 1.0, 0.0), project(c, 3.0, 1.0, 0.0)] for c in PAPER])
    check = check_known_distance(
        result.pair, marks, 6.0, covariance=result.covariance, names=result.names, localisation_sigma_px=0.01
    )
    assert not check.agrees
    assert check.ratio == pytest.approx(1.005, abs=2e-4)
    right = calibrate(make_views(), Grid(), NOMINAL, HELD)
    good = check_known_distance(
        right.pair, marks, 6.0, covariance=right.covariance, names=right.names, localisation_sigma_px=0.003
    )
    assert good.agrees
    assert good.ratio == pytest.approx(1.0, abs=2e-5)
    for points, length in ((marks[:1], 6.0), (marks, -1.0), (marks * np.nan, 6.0)):
        with pytest.raises(CalibrationInputError, match="two marks"):
            check_known_distance(right.pair, points, length)


@pytest.mark.fault(34)
@pytest.mark.parametrize(("noise", "level"), [(0.05, "good"), (0.16, "warning"), (0.5, "failed")])
def test_residuals_are_judged_by_the_bands(noise: float, level: str) -> None:
    result = calibrate(make_views((0.0, 1.0, 2.0, 4.0, 5.0), noise=noise), Grid(), NOMINAL, HELD)
    assert result.held_out is not None
    assert result.held_out.mean.rbe_px == pytest.approx(1.25 * noise, rel=0.1)
    assert result.verdict.level == level
    limit = {"good": "within 0.1 px", "warning": "above 0.1 px", "failed": "above 0.3 px"}[level]
    assert any("Held-out RBE of cam1" in r and limit in r for r in result.verdict.reasons)


def test_what_passes_is_no_reason_of_a_calibration_that_is_refused() -> None:
    result = calibrate(at_review_noise(), Grid(pitch_mm=1.01), NOMINAL, HELD)
    with pytest.raises(CalibrationError) as refused:
        result.verdict.check()
    assert refused.value.code == "calibration_rejected"
    assert "usable: Stage and grid disagree by 0.9" in refused.value.cause
    assert "declare both" in refused.value.remedy
    assert not [text for text in (refused.value.cause, *result.verdict.reasons) if "within" in text]


def test_a_stage_that_travels_off_the_optical_axis_is_suspected() -> None:
    # 20 mrad across cam1's axis: the whole image moves in proportion to dZ, which the residuals cannot show
    shift = 12000.0 * 0.02 / 400.0
    views = [
        dataclasses.replace(v, xy_px=v.xy_px + np.array([0.0, shift * v.dz_mm])) if v.camera == "cam1" else v
        for v in make_views()
    ]
    verdict = calibrate(views, Grid(), NOMINAL, HELD).verdict
    assert verdict.level == "warning"
    assert any("principal point of cam1" in reason and "off the optical axis" in reason for reason in verdict.reasons)


@pytest.mark.fault(34)
def test_the_worst_view_is_named() -> None:
    views = make_views()
    bumped = [
        dataclasses.replace(v, xy_px=v.xy_px + np.array([0.5, 0.0])) if (v.camera, v.dz_mm) == ("cam2", 4.0) else v
        for v in views
    ]
    result = calibrate(bumped, Grid(), NOMINAL, HELD)
    assert result.verdict.level == "failed"
    assert any(r.startswith("Worst views: cam2 at +4.000 mm 0.5") for r in result.verdict.reasons)
    assert any("All points of cam2 at +4.000 mm are off the same way" in r for r in result.verdict.reasons)


def test_positions_between_the_ends_are_left_out_in_turn_where_none_is_named() -> None:
    result = calibrate(make_views(), Grid(), NOMINAL)
    assert result.held_out is not None
    assert result.held_out.positions_mm == ((2.0, 4.0), (2.0, 4.0))
    assert not any(view.held_out for view in result.views)
    assert result.verdict.level == "good"

    # a position in the middle that is 0.1 mm off does not pass its own check, however the fit with it looks
    def slipped(dz: float) -> float:
        return dz + 0.1 * (dz == 2.0)

    off = calibrate(make_views(declared=slipped), Grid(), NOMINAL)
    assert off.held_out is not None
    assert off.held_out.mean.rbe_px > 1.5 * off.fitted.mean.rbe_px


def test_with_two_positions_none_is_left_out_and_the_verdict_says_so() -> None:
    result = calibrate(make_views((0.0, 5.0)), Grid(), NOMINAL)
    assert result.held_out is None
    assert result.verdict.level == "warning"
    assert "No position was held out" in result.verdict.reasons[0]


@pytest.mark.parametrize(("held", "code"), [((3.0,), "hold_out_unknown"), ((0.0, 2.0, 4.0, 5.0), "hold_out_all")])
def test_held_out_positions_must_exist_and_leave_some(held: tuple[float, ...], code: str) -> None:
    with pytest.raises(CalibrationInputError) as caught:
        calibrate(make_views(), Grid(), NOMINAL, CalibrationOptions(held_out_mm=held))
    assert caught.value.code == code


def test_read_back_positions_are_used_and_matched_with_the_plan() -> None:
    # commanded 2, arrived at 2.004; each camera's stage by itself
    offsets = {0.0: 0.001, 2.0: 2.004, 4.0: 3.993, 5.0: 5.002}
    X, Y = nodes(Grid())
    views = [
        CalibrationView(name, offsets[dz] * s, project(c, X, Y, offsets[dz] * s))
        for name, c, s in (("cam1", PAPER[0], 1.0), ("cam2", PAPER[1], 1.001))
        for dz in offsets
    ]  # type: ignore[misc]
    result = calibrate(views, Grid(), NOMINAL, HELD)
    assert result.held_out is not None
    assert result.held_out.positions_mm[0] == (2.004, 3.993)
    assert result.held_out.mean.rbe_px < 1e-4


def test_missing_intersections_are_left_out() -> None:
    views = make_views()
    rng = np.random.default_rng(9)
    holes = []
    for v in views:
        xy = v.xy_px.copy()
        xy[rng.random((9, 9)) < 0.15] = np.nan
        holes.append(dataclasses.replace(v, xy_px=xy))
    result = calibrate(holes, Grid(), NOMINAL, HELD)
    assert result.held_out is not None
    assert result.held_out.mean.rbe_px < 0.0035
    for view, given in zip(result.views, holes, strict=True):
        np.testing.assert_array_equal(np.isnan(view.residual_px), np.isnan(given.xy_px))


@pytest.mark.fault(33)
def test_nothing_usable_comes_from_numbers_that_are_not() -> None:
    views = make_views()
    bad = [dataclasses.replace(views[0], dz_mm=float("nan")), *views[1:]]
    with pytest.raises(CalibrationInputError) as caught:
        calibrate(bad, Grid(), NOMINAL)
    assert caught.value.code == "view_not_finite"
    collapsed = [dataclasses.replace(v, xy_px=np.full_like(v.xy_px, 200.0)) for v in views]
    with pytest.raises(CalibrationInputError) as other:
        calibrate(collapsed, Grid(), NOMINAL)
    assert other.value.code == "view_degenerate"


@pytest.mark.fault(33)
@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.deep) for seed in (3, 4, 5))])
def test_nonsense_is_never_called_usable(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scale = (3.0, 20.0, 100.0)[seed % 3]
    views = [
        dataclasses.replace(v, xy_px=np.clip(v.xy_px + scale * rng.standard_normal(v.xy_px.shape), 0.0, 479.0))
        for v in make_views()
    ]
    try:
        result = calibrate(views, Grid(node_tolerance_mm=0.004), NOMINAL, HELD)
    except (CalibrationError, CalibrationInputError):
        return  # refused: the other right outcome
    assert result.verdict.level == "failed"


@pytest.mark.fault(33)
def test_a_solver_that_fails_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr("stereorig.core.calibration.choice.screening.adjust", fails)
    with pytest.raises(CalibrationError, match="Eigenvalues did not converge") as caught:
        calibrate(make_views(), Grid(), NOMINAL)
    assert caught.value.code == "calibration_singular"
    monkeypatch.undo()
    with pytest.raises(CalibrationError, match="did not settle in 1 iterations") as other:
        calibrate(make_views(noise=0.5), Grid(node_tolerance_mm=0.02), NOMINAL, CalibrationOptions(max_iterations=1))
    assert other.value.code == "calibration_not_converged"
