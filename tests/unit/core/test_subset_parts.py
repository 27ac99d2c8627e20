"""A part of a subset that lies on another face, or shows something else, is found in the residuals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from core.field.parts.subset_parts import Pull, pull_of_parts
from core.field.parts.subset_residuals import SubsetResiduals

N, WIDTH, NOISE = 100, 27, 2.0


def subsets(shift_px: float, columns: int, degree: int = 1, *, hidden_px: int = 0) -> Pull:
    """Soft speckle, of which the first columns are shifted along x; ``hidden_px`` wide, the middle shows grey."""
    rng = np.random.default_rng(7)
    texture = gaussian_filter(rng.normal(size=(N, WIDTH, WIDTH)), (0.0, 1.8, 1.8))
    texture *= 50.0 / texture.std()
    gx, gy = np.gradient(texture, axis=2), np.gradient(texture, axis=1)
    residual = rng.normal(0.0, np.sqrt(2.0) * NOISE, texture.shape)
    residual[:, :, :columns] += shift_px * gx[:, :, :columns]
    if hidden_px:
        middle = slice(WIDTH // 2 - hidden_px // 2, WIDTH // 2 + hidden_px // 2 + 1)
        residual[:, :, middle] += texture[:, :, middle]
    reference = texture - texture.mean(axis=(1, 2), keepdims=True)
    return pull_of_parts(SubsetResiduals(residual, gx, gy, reference), np.ones(texture.shape, bool), degree)


@pytest.mark.parametrize("degree", [1, 2])
def test_noise_alone_is_no_parts_doing(degree: int) -> None:
    pull = subsets(0.0, 0, degree)
    # 200 tests of some thirty parts each: five standard deviations are what the check asks for
    assert (pull.significance < 5.0).mean() > 0.99
    assert not pull.other_centre.any()


@pytest.mark.parametrize("degree", [1, 2])
def test_a_border_that_lies_on_another_face_stands_out_though_the_rest_matches(degree: int) -> None:
    pull = subsets(0.8, 5, degree)
    # a curved patch takes up the more of it, and texture is poor in some borders
    assert (pull.significance[:, 0] > 5.0).mean() > 0.9


def test_without_the_part_the_match_is_that_of_the_rest() -> None:
    pull = subsets(0.5, 9)
    without = np.take_along_axis(pull.shift_px[:, 0], pull.part[:, 0, None], axis=1)[:, 0]
    # least squares by hand: a third of a line shifted by d pulls a straight line's middle by d / 3, the rest by none
    assert np.median(np.abs(without)) == pytest.approx(0.5 / 3.0, rel=0.25)


def test_a_wire_before_the_middle_of_a_subset_is_seen_there_alone() -> None:
    # where the speckle behind is as grey as the wire there is nothing to see
    assert subsets(0.0, 0, hidden_px=4).other_centre.mean() > 0.6
    assert not subsets(0.5, 5).other_centre.any()
