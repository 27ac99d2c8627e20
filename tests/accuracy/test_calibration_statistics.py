"""The adjustment against a brute-force solver, its covariance against Monte Carlo, its measures against plain loops."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from stereorig.core.calibration import COVARIANCE_NAMES, CalibrationOptions, calibrate
from tests.bench.accuracy.lenses_motions import replicate
from tests.bench.accuracy.line_grid_covariance import detections, normalised_squares
from tests.support.calibration_truth import HELD, NOMINAL, PAPER, Array, Grid, make_views, nodes, project

TEN = ("phd", "cx", "cy", "kappa", "alpha", "beta", "gamma", "x0", "y0", "z0")
SCALE = np.array([1.0, 1.0, 1.0, 1e-9, 1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-1])


# the axes are exact here, and the parameters those of the paper
EXACT = CalibrationOptions(axis_tilt_sigma_rad=0.0, stage_scale_sigma=0.0, aspect_sigma=0.0, lens="paper")


def truth_vector() -> Array:
    return np.array([c[k] for c in PAPER for k in TEN])


def ten_of(result: object) -> Array:
    pair = result.pair  # type: ignore[attr-defined]
    values = {
        f"{n}.{k}": v for n, c in (("cam1", pair.cam1), ("cam2", pair.cam2)) for k, v in c.paper_parameters().items()
    }
    return np.array([values[name] for name in COVARIANCE_NAMES])


def test_the_minimum_is_the_one_a_brute_force_solver_finds() -> None:
    """All 20 + 162 unknowns at once with differences, on the projection written apart."""
    tolerance, sigma = 0.004, 0.0022
    grid = Grid(node_tolerance_mm=tolerance, pitch_scale_sigma=0.0)
    error = np.random.default_rng(5).uniform(-tolerance, tolerance, (9, 9, 2))
    views = make_views((0.0, 2.0, 5.0), grid=grid, error_mm=error, seed=5)
    result = calibrate(views, grid, NOMINAL, EXACT)
    X, Y = nodes(grid)
    noise = {"cam1": result.noise_px[0], "cam2": result.noise_px[1]}
    assert noise["cam1"] == pytest.approx(sigma, rel=0.12)

    def residuals(u: Array) -> Array:
        d = u[20:].reshape(9, 9, 2) * 1e-3
        parts = []
        for v in views:
            c = 0 if v.camera == "cam1" else 1
            p = truth_vector()[10 * c : 10 * c + 10] + u[10 * c : 10 * c + 10] * SCALE
            camera = {**dict(zip(TEN, p, strict=True)), "aspect": 0.9617}
            parts.append(((v.xy_px - project(camera, X + d[..., 0], Y + d[..., 1], v.dz_mm)) / noise[v.camera]).ravel())
            if v.dz_mm == 0.0:
                parts.append((p[1:3] - [255.5, 239.5]) / 20.0)
        parts.append((d / (tolerance / math.sqrt(3.0))).ravel())
        return np.concatenate(parts)

    # the problem is nearly linear at the truth: Gauss-Newton with central differences, no derivative of ours
    u = np.zeros(182)
    for _ in range(3):
        jac = np.column_stack([(residuals(u + e) - residuals(u - e)) / 2e-3 for e in 1e-3 * np.eye(182)])
        u = u - np.linalg.lstsq(jac, residuals(u), rcond=1e-15)[0]
    ours = (ten_of(result) - truth_vector()) / np.tile(SCALE, 2)
    sigma_of = np.sqrt(np.diagonal(result.covariance)) / np.tile(SCALE, 2)
    # ours stops where a step changes the sum of squares by 1e-6: a thousandth of a standard deviation
    np.testing.assert_allclose(ours / sigma_of, u[:20] / sigma_of, atol=0.01)
    assert result.node_corrections_mm is not None
    np.testing.assert_allclose(1e3 * result.node_corrections_mm.ravel(), u[20:], atol=0.02)

    H = jac.T @ jac
    s = 1.0 / np.sqrt(np.diagonal(H))
    covariance = (np.linalg.inv(H * s[:, None] * s) * s[:, None] * s)[:20, :20]
    # the errors of the target as a whole that these independent ones may contain come on top
    ratio = sigma_of / np.sqrt(np.diagonal(covariance))
    assert (ratio > 0.99).all()
    assert (ratio < 1.03).all(), ratio


def monte_carlo(tolerance: float, runs: int, degree: int | None) -> tuple[Array, list[Array], list[Array], Array]:
    grid = Grid(node_tolerance_mm=tolerance, pitch_scale_sigma=0.0)
    found, claimed, shapes = [], [], []
    points = np.stack(np.meshgrid(*[np.linspace(-4, 4, 3)] * 2, [-1.0, 1.0]), -1).reshape(-1, 3)
    seen = [project(c, *points[:, :2].T, 0.0, points[:, 2]) for c in PAPER]
    sigma_shape = []
    for seed in range(runs):
        rng = np.random.default_rng(1000 + seed)
        # Gaussian node errors with the same variance as the bound's box, so that theory and draw agree
        error = rng.standard_normal((9, 9, 2)) * tolerance / math.sqrt(3.0)
        views = make_views((0.0, 5.0), grid=grid, error_mm=error, seed=seed)
        if degree is not None:
            clean = make_views((0.0, 5.0), grid=grid, error_mm=error, noise=0.0)
            views = [
                dataclasses.replace(
                    v, xy_px=c.xy_px + through_lines(v.xy_px - c.xy_px, degree), correlation=9.0 / (degree + 1)
                )
                for v, c in zip(views, clean, strict=True)
            ]
        result = calibrate(views, grid, NOMINAL, EXACT)
        found.append(ten_of(result) - truth_vector())
        claimed.append(result.covariance)
        shapes.append(result.pair.triangulate(*seen).xyz_mm - points)
        sigma_shape.append(result.uncertainty.sigma_mm)
    return np.array(found), claimed, shapes, np.array(sigma_shape)


def through_lines(error: Array, degree: int) -> Array:
    """What a polynomial fitted to each line leaves of independent errors of its points."""
    out = error.copy()
    t = np.arange(9.0)
    for k in range(9):
        out[k, :, 0] = np.polyval(np.polyfit(t, error[k, :, 0], degree), t)
        out[:, k, 1] = np.polyval(np.polyfit(t, error[:, k, 1], degree), t)
    return out


@pytest.mark.normal_depth("0.0-2")
@pytest.mark.parametrize(("tolerance", "degree"), [(0.0, None), (0.004, None), (0.0, 1), (0.0, 2)])
def test_the_covariance_is_what_repeated_calibrations_scatter(tolerance: float, degree: int | None) -> None:
    runs = 30
    found, claimed, shapes, sigma_shape = monte_carlo(tolerance, runs, degree)
    covariance = np.mean(claimed, axis=0)
    ratio = found.std(axis=0) / np.sqrt(np.diagonal(covariance))
    # sd of a sd from 30 runs is 13 %; three of those over 20 correlated figures
    assert (np.abs(ratio - 1.0) < 0.4).all(), ratio.round(2)
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.12)
    # no bias beyond three standard errors, taken together: chi^2 of 20 correlated figures, whitened by the claim
    whitened = np.linalg.solve(np.linalg.cholesky(_scaled(covariance)), (found / _sd(covariance)).T)
    chi2 = float(np.mean(np.sum(whitened**2, axis=0)))
    assert chi2 == pytest.approx(20.0, rel=0.2)
    # and in space, where it matters
    spread = np.sqrt(np.mean(np.square(shapes)))
    assert spread == pytest.approx(float(np.sqrt(np.mean(sigma_shape**2))), rel=0.35)


@pytest.mark.deep
def test_parameters_from_pictures_of_line_grids_scatter_as_their_covariance_says() -> None:
    replicates = 60
    found = float(np.mean(normalised_squares(detections(replicates))))
    # twenty parameters: sd of the mean of their squares is sqrt(2 / (20 * 60)) = 0.04
    assert found == pytest.approx(1.0, abs=2.5 * math.sqrt(2.0 / (20 * replicates)))


@pytest.mark.parametrize("lens", ["pinhole", "p1 p2 of 3e-4"])
@pytest.mark.parametrize("seed", [2, 12])
def test_several_tests_of_one_millimetre_do_not_make_right_rigs_doubtful(lens: str, seed: int) -> None:
    # right by how they are built; of four tests one comes upon each of them with a probability of 0.3 to 0.5 %
    assert replicate(lens, "cameras", seed).level == "good"


def _sd(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.diagonal(covariance)))


def _scaled(covariance: Array) -> Array:
    s = _sd(covariance)
    return np.asarray(covariance / s[:, None] / s)


def test_a_tilted_stage_axis_hides_from_the_residuals_but_not_from_the_declared_covariance() -> None:
    views = make_views(tilt=(1e-3, -0.7e-3))
    trusting = calibrate(views, Grid(), NOMINAL, dataclasses.replace(EXACT, held_out_mm=HELD.held_out_mm))
    declared = calibrate(views, Grid(), NOMINAL, dataclasses.replace(HELD, lens="paper"))  # 1 mrad by default
    assert trusting.held_out is not None
    assert trusting.held_out.mean.rbe_px < 0.0035  # nothing to see, and yet:
    error = trusting.pair.cam1.paper_parameters()["cx_px"] - PAPER[0]["cx"]
    assert error == pytest.approx(12.0, abs=0.5)
    assert abs(error) > 100 * trusting.sigma["cam1.cx_px"]
    after = declared.pair.cam1.paper_parameters()["cx_px"] - PAPER[0]["cx"]
    assert abs(after) < 2 * declared.sigma["cam1.cx_px"]
    assert 5.0 < declared.sigma["cam1.cx_px"] < 12.1
    assert declared.axis_tilt_sigma_rad.min() > 1e-4


def test_measures_follow_equations_15_to_17() -> None:
    """Point by point, with the projection written apart and a ray solved by Newton."""
    result = calibrate(make_views(), Grid(), NOMINAL, dataclasses.replace(EXACT, held_out_mm=HELD.held_out_mm))
    assert result.held_out is not None
    X, Y = nodes(Grid())
    for c, name in enumerate(("cam1", "cam2")):
        p = [cam.paper_parameters() for cam in (result.pair.cam1, result.pair.cam2)][c]
        camera = {k.rsplit("_", 1)[0] if k != "kappa_per_px2" else "kappa": v for k, v in p.items()}
        camera["aspect"] = p["aspect"]
        raz, nsce, rbe, n = 0.0, 0.0, 0.0, 0
        for view in [v for v in make_views() if v.camera == name and v.dz_mm in (2.0, 4.0)]:
            for i in range(9):
                for j in range(9):
                    truth = np.array([X[i, j], Y[i, j]])
                    image = view.xy_px[i, j]
                    rbe += math.dist(image, project(camera, *truth, view.dz_mm))
                    at = truth.copy()
                    for _ in range(5):
                        f = project(camera, *at, view.dz_mm) - image
                        h = 1e-6
                        J = np.column_stack(
                            [
                                (project(camera, *(at + e), view.dz_mm) - project(camera, *at, view.dz_mm)) / h
                                for e in (np.array([h, 0.0]), np.array([0.0, h]))
                            ]
                        )
                        at = at - np.linalg.solve(J, f)
                    raz += math.dist(at, truth)
                    a, b = (in_camera(camera, q, view.dz_mm) for q in (truth, at))
                    f_u, f_v = camera["phd"], camera["aspect"] * camera["phd"]
                    nsce += math.sqrt(
                        ((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2) / (b[2] ** 2 * (f_u**-2 + f_v**-2) / 12.0)
                    )
                    n += 1
        got = result.held_out.per_camera[c]
        assert got.count == n == 162
        assert got.rbe_px == pytest.approx(rbe / n, rel=1e-6)
        assert got.raz_mm == pytest.approx(raz / n, rel=1e-4)
        assert got.nsce == pytest.approx(nsce / n, rel=1e-4)


def in_camera(c: dict[str, float], q: Array, dz: float) -> Array:
    # a unit pinhole at the three axes' directions gives Eqs. (9), (10) back without the lens
    sa, ca, sb, cb = math.sin(c["alpha"]), math.cos(c["alpha"]), math.sin(c["beta"]), math.cos(c["beta"])
    sg, cg = math.sin(c["gamma"]), math.cos(c["gamma"])
    return np.array(
        [
            ca * cg * q[0] - sa * cg * q[1] + c["x0"],
            (sa * cb + ca * sg * sb) * q[0] + (ca * cb - sa * sg * sb) * q[1] + c["y0"],
            (sa * sb - ca * sg * cb) * q[0] + (ca * sb + sa * sg * cb) * q[1] + c["z0"] + dz,
        ]
    )
