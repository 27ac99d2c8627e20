"""Grid detection on images whose truth comes from an independent renderer."""

from __future__ import annotations

import numpy as np
import pytest

from core.grid import GridOptions, detect_grid
from tests.support.grid_images import PAPER_TARGET, grid_image, paper_camera, truth_px


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


def test_reported_sigma_is_the_error() -> None:
    camera = paper_camera(-30.0)
    z = []
    for seed in range(4):
        image = grid_image(camera, seed=seed)
        view = detect_grid(image, PAPER_TARGET, options=GridOptions(line_model="parabola"))
        z.append((view.xy_px - truth_px(camera, PAPER_TARGET)) / view.sigma_px)
    assert 0.8 < np.std(z) < 1.2
