"""Calibrations from free poses beside two witnesses, on the same corners: mrcal for covariances, OpenCV for errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereorig.core.calibration import CalibrationOptions, CalibrationView, NominalValues, calibrate
from stereorig.core.calibration.fit.adjust import adjust
from stereorig.core.calibration.fit.layout import camera_of
from stereorig.core.calibration.fit.named import named_covariance, parameter_names
from stereorig.core.calibration.fit.problem import started
from stereorig.core.calibration.prepare import problem_of
from stereorig.core.calibration.uncertainty import volume_uncertainty
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.factor import ParameterCovariance, factor_of
from tests.bench.accuracy.calibration_beside import CASES, HALF, NOT_ABOVE, compare
from tests.support.calibration_rigs import (
    LENSES,
    Array,
    OpenCVResult,
    checkerboard,
    hand_held,
    made,
    ordinary_pair,
    rms,
    stereo_calibrate,
    views_of_poses,
)
from tests.support.mrcal_witness import (
    PACKAGES,
    MrcalResult,
    calibrate_by_mrcal,
    mrcal_is_there,
    ray_slopes,
    shape_sigma_um,
)
from tests.support.requirements import missing

NOISE_PX = 0.02
# mrcal has no priors
OPEN = CalibrationOptions(moves="free", lens="opencv5", centre_sigma_px=1e4, aspect_sigma=10.0)
#: the issue's; both are the inverse of the same normal equations, and agree to some millionths
WITHIN = 0.02


@pytest.fixture(scope="module")
def seen() -> tuple[list[CalibrationView], tuple[NominalValues, NominalValues], OpenCVResult]:
    if not mrcal_is_there():
        missing(PACKAGES)
    rng = np.random.default_rng(4)
    cameras = ordinary_pair(LENSES["pinhole"])
    points = made(checkerboard().points_mm(), rng)
    views = views_of_poses(cameras, points, hand_held(rng, cameras, points, 12), rng, NOISE_PX)
    nominal = NominalValues(cameras[0].size_px, 3700.0)
    return views, (nominal, nominal), stereo_calibrate(views, checkerboard().points_mm(), cameras[0].size_px)


def lengths_agree(source: ParameterCovariance, points: Array, theirs: MrcalResult) -> None:
    """Lengths between points: the common factor beside mrcal's covariance, carried there by OpenCV's derivatives."""
    factor = factor_of(source, points).values
    placed = source.pair.cam1.cam_from_sys
    slopes = ray_slopes(theirs, placed.apply(points))  # camera 1's frame: lengths know of none
    root = np.linalg.cholesky(theirs.covariance)
    for a, b in ((0, 11), (1, 10), (0, 1), (3, 8)):
        along = points[b] - points[a]
        along /= np.linalg.norm(along)
        mine = float(np.linalg.norm(along @ (factor[b] - factor[a])))
        other = float(np.linalg.norm(placed.rotation @ along @ (slopes[b] - slopes[a]) @ root))
        assert mine == pytest.approx(other, rel=WITHIN)


def test_covariances_are_those_of_mrcal_under_opencvs_lens(
    seen: tuple[list[CalibrationView], tuple[NominalValues, NominalValues], OpenCVResult],
) -> None:
    views, nominals, start = seen
    board = checkerboard()
    ours = calibrate(views, board, nominals, OPEN)
    theirs = calibrate_by_mrcal(
        views, board.pitch_mm, [n.image_size_px for n in nominals], start, noise_px=ours.noise_px
    )
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
    mine = [ours.sigma[f"{c}.{n}"] for c in ("cam1", "cam2") for n in names]
    np.testing.assert_allclose(mine, np.sqrt(np.diagonal(theirs.covariance))[:18], rtol=WITHIN)
    points = ours.uncertainty.points_mm
    in_camera = ours.pair.cam1.cam_from_sys.apply(points)
    assert 1e3 * ours.uncertainty.shape_rms_mm == pytest.approx(shape_sigma_um(theirs, in_camera), rel=WITHIN)
    some = np.stack(np.meshgrid([-50.0, 0.0, 50.0], [-40.0, 40.0], [-30.0, 30.0]), axis=-1).reshape(-1, 3)
    lengths_agree(ParameterCovariance(ours.pair, ours.names, ours.covariance), some, theirs)
    # and the minimum is the same: a hundredth of a standard deviation is where ours stops
    lens = ours.pair.cam1.lens
    values = np.array([getattr(lens, n) for n in names])
    np.testing.assert_allclose((values - theirs.intrinsics[0]) / np.array(mine[:9]), 0.0, atol=0.01)


def test_covariances_are_those_of_mrcal_of_a_pinhole(
    seen: tuple[list[CalibrationView], tuple[NominalValues, NominalValues], OpenCVResult],
) -> None:
    views, nominals, start = seen
    board = checkerboard()
    per_camera = [[v for v in views if v.camera == c] for c in ("cam1", "cam2")]
    problem, state, odd = started(problem_of(per_camera, board, nominals, OPEN))
    assert not odd
    layout = problem.layout("paper")
    priors = problem.priors(layout)
    free = priors.free.copy()
    x = state.x.copy()
    for c in range(2):
        kappa = layout.lens(c).start + 3
        free[kappa], x[kappa] = False, 0.0
    priors = replace(priors, free=free, weight=np.where(free, priors.weight, 0.0))
    fitted = adjust(layout, replace(state, x=x), problem.rows, problem.flat_nodes_mm, priors, max_iterations=60)
    theirs = calibrate_by_mrcal(
        views,
        board.pitch_mm,
        [n.image_size_px for n in nominals],
        start,
        lensmodel="LENSMODEL_PINHOLE",
        noise_px=fitted.noise_px,
    )
    names = parameter_names(layout, priors)
    covariance = named_covariance(layout, priors, fitted.state.x, fitted.covariance)
    sigma = dict(zip(names, np.sqrt(np.diagonal(covariance)), strict=True))
    of_theirs = np.sqrt(np.diagonal(theirs.covariance))
    for c, own in (("cam1", of_theirs[:4]), ("cam2", of_theirs[4:8])):
        # fx, cx, cy; the aspect ratio is fy over fx here
        mine = [sigma[f"{c}.phd_px"], sigma[f"{c}.cx_px"], sigma[f"{c}.cy_px"]]
        np.testing.assert_allclose(mine, own[[0, 2, 3]], rtol=WITHIN)
    pair = StereoPair(*(camera_of(layout, fitted.state.x, c) for c in range(2)))
    points = np.stack(np.meshgrid([-50.0, 0.0, 50.0], [-40.0, 40.0], [-30.0, 30.0]), axis=-1).reshape(-1, 3)
    ours = volume_uncertainty(pair, covariance, board, names, points)
    assert 1e3 * ours.shape_rms_mm == pytest.approx(
        shape_sigma_um(theirs, pair.cam1.cam_from_sys.apply(points)), rel=WITHIN
    )
    lengths_agree(ParameterCovariance(pair, names, covariance), points, theirs)


@pytest.mark.normal_depth("pinhole, board of 0.05 mm")
@pytest.mark.parametrize("case", CASES, ids=[c.name for c in CASES])
def test_shapes_are_no_worse_than_opencvs_and_far_better_where_lens_and_board_have_errors(case) -> None:  # type: ignore[no-untyped-def]
    runs = [compare(case, seed, mrcal=False) for seed in (101, 102, 103)]
    ours, opencv = rms([r.ours for r in runs]), rms([r.opencv for r in runs])
    assert case.limit in (HALF, NOT_ABOVE)
    # single replicates on an exact board scatter by a tenth about OpenCV's; the pages have twenty
    assert ours <= opencv * (case.limit if case.limit == HALF else 1.15)
