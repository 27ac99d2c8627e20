"""Grid detection on images whose truth comes from an independent renderer."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.core.errors import TargetError
from stereorig.core.grid import GridOptions, detect_grid
from tests.support.grid_images import PAPER_TARGET, grid_image, paper_camera, render_cover, truth_px


@pytest.mark.parametrize(
    ("gamma_deg", "alpha_deg"), [(-30.0, 45.0), (30.0, 44.3), (0.0, 45.0), (35.0, 60.0), (-35.0, 30.0)]
)
def test_every_intersection_of_the_paper_rig_is_found_within_the_localisers_error(
    gamma_deg: float, alpha_deg: float
) -> None:
    camera = paper_camera(gamma_deg, alpha_deg=alpha_deg)
    image = grid_image(camera)
    truth = truth_px(camera, PAPER_TARGET)
    # 0.0022 px an axis is the bound for a parabola a line on this image, 0.0045 what the paper's localiser reaches
    for localiser, limit in (("profile", 0.0028), ("paper", 0.0062)):
        view = detect_grid(image, PAPER_TARGET, localiser=localiser)  # type: ignore[arg-type]
        error = view.xy_px - truth
        assert error.shape == (9, 9, 2)
        assert np.sqrt(np.mean(error**2)) < limit, localiser
        assert np.abs(error).max() < 6.0 * limit


@pytest.mark.parametrize("gamma_deg", [-70.0, 74.0])
def test_a_grid_seen_at_seventy_degrees_is_found_within_its_sigma(gamma_deg: float) -> None:
    camera = paper_camera(gamma_deg)
    view = detect_grid(grid_image(camera), PAPER_TARGET)
    z = (view.xy_px - truth_px(camera, PAPER_TARGET)) / view.sigma_px
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert view.sigma_px.max() < 0.05


def test_lines_that_a_camera_sees_too_obliquely_are_no_dirt() -> None:
    with pytest.raises(TargetError, match=r"sees the target at about (69|70|71) degrees off its normal") as refused:
        detect_grid(grid_image(paper_camera(-70.0, alpha_deg=0.0)), PAPER_TARGET)
    assert refused.value.code == "target_too_small"


def test_reported_sigma_is_the_error() -> None:
    camera = paper_camera(-30.0)
    z = []
    for seed in range(4):
        image = grid_image(camera, seed=seed)
        view = detect_grid(image, PAPER_TARGET, options=GridOptions(line_model="parabola"))
        z.append((view.xy_px - truth_px(camera, PAPER_TARGET)) / view.sigma_px)
    assert 0.8 < np.std(z) < 1.2


def test_covariance_of_a_node_is_that_of_the_two_lines_offsets() -> None:
    camera = paper_camera(-30.0, kappa_per_px2=2e-8)
    view = detect_grid(grid_image(camera), PAPER_TARGET, options=GridOptions(line_model="local"))
    lines = view.line_offsets
    assert lines is not None
    N = np.stack([lines.normal_a, lines.normal_b], axis=-2)
    np.testing.assert_allclose(np.linalg.norm(N, axis=-1), 1.0, atol=1e-12)
    V = np.zeros((9, 9, 2, 2))
    for i in range(9):
        for j in range(9):
            V[i, j] = np.diag([lines.covariance_a[i, j, j], lines.covariance_b[j, i, i]])
    inverse = np.linalg.inv(N)
    np.testing.assert_allclose(inverse @ V @ np.swapaxes(inverse, -1, -2), view.covariance_px2, rtol=1e-9)
    # across a line of family a means along the steps from one such line to the next, less those along it
    along_a = np.diff(view.xy_px, axis=1)
    assert (
        np.abs(np.sum(lines.normal_a[:, :-1] * along_a, axis=-1)).max() < 0.01 * np.linalg.norm(along_a, axis=-1).min()
    )


def test_neighbouring_nodes_of_a_line_scatter_together_as_predicted() -> None:
    camera = paper_camera(-30.0)
    clean = 200.0 - 160.0 * render_cover(camera, PAPER_TARGET)
    truth = truth_px(camera, PAPER_TARGET)
    whitened, found, told = [], [], []
    for seed in range(12):
        noisy = clean + np.random.default_rng(seed).normal(0.0, 2.0, clean.shape)
        image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        view = detect_grid(image, PAPER_TARGET, options=GridOptions(line_model="local"))
        lines = view.line_offsets
        assert lines is not None
        error = view.xy_px - truth
        for normal, covariance, swap in (
            (lines.normal_a, lines.covariance_a, False),
            (lines.normal_b, lines.covariance_b, True),
        ):
            offset = np.sum(normal * error, axis=-1)
            for e, C in zip(offset.T if swap else offset, covariance, strict=True):
                whitened.append(np.linalg.solve(np.linalg.cholesky(C), e))
                sd = np.sqrt(np.diag(C))
                found.append(np.mean((e[1:] / sd[1:]) * (e[:-1] / sd[:-1])))
                told.append(np.mean(np.diag(C, 1) / (sd[1:] * sd[:-1])))
    # 216 lines of 8 neighbours: the mean of 1728 products of two normal variables, each of variance 1 + r^2
    assert np.mean(told) < -0.1
    assert abs(np.mean(found) - np.mean(told)) < 4.0 / np.sqrt(1728)
    # 1944 whitened offsets: their mean square is 1 within 4 sqrt(2 / 1944), and 4 % for the pieces' own estimate of
    # the noise and the grey levels' rounding
    assert abs(np.mean(np.square(whitened)) - 1.0) < 4.0 * np.sqrt(2.0 / 1944) + 0.04
