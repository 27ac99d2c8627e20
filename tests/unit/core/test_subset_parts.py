"""A part of a subset that lies on another face, or shows something else, is found in the residuals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stereorig.core.field.parts.subset_parts import Pull, pull_of_parts
from stereorig.core.field.points.subset_residuals import SubsetResiduals

N, WIDTH, NOISE = 100, 27, 2.0


def subsets(shift_px: float, columns: int, degree: int = 1, *, noise: float = NOISE) -> Pull:
    """Soft speckle, of which the first columns are shifted along x."""
    rng = np.random.default_rng(7)
    texture = gaussian_filter(rng.normal(size=(N, WIDTH, WIDTH)), (0.0, 1.8, 1.8))
    texture *= 50.0 / texture.std()
    gx, gy = np.gradient(texture, axis=2), np.gradient(texture, axis=1)
    residual = rng.normal(0.0, np.sqrt(2.0) * noise, texture.shape)
    residual[:, :, :columns] += shift_px * gx[:, :, :columns]
    reference = texture - texture.mean(axis=(1, 2), keepdims=True)
    return pull_of_parts(SubsetResiduals(residual, gx, gy, reference), np.ones(texture.shape, bool), degree)


@pytest.mark.parametrize("degree", [1, 2])
def test_noise_alone_is_no_parts_doing(degree: int) -> None:
    pull = subsets(0.0, 0, degree)
    # 200 tests of some thirty parts each: five standard deviations are what the check asks for
    assert (pull.significance < 5.0).mean() > 0.99
    assert pull.centre.max() < 1.0


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


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("wire_px", [6, 10])
def test_a_wire_before_the_middle_of_a_subset_is_seen_though_it_spoils_the_match_of_all(
    wire_px: int, degree: int
) -> None:
    rng = np.random.default_rng(7)
    behind = gaussian_filter(rng.normal(size=(N, WIDTH, WIDTH)), (0.0, 1.8, 1.8))
    behind *= 50.0 / behind.std()
    x, y = np.meshgrid(np.arange(WIDTH) - WIDTH // 2, np.arange(WIDTH) - WIDTH // 2)
    wire = np.abs(x + 0.4 * y) < 0.5 * wire_px
    seen = [np.where(wire, 0.0, behind), behind]
    f, g = (one + rng.normal(0.0, NOISE, one.shape) for one in seen)
    f, g = (one - one.mean(axis=(1, 2), keepdims=True) for one in (f, g))
    gain = (f * g).sum(axis=(1, 2)) / (g * g).sum(axis=(1, 2))
    residual = f - gain[:, None, None] * g
    gradients = np.gradient(f, axis=2), np.gradient(f, axis=1)
    pull = pull_of_parts(SubsetResiduals(residual, *gradients, f), np.ones(f.shape, bool), degree)
    # where the speckle behind is as grey as the wire there is nothing to see
    assert (pull.centre > 1.0).mean() > 0.8


def test_a_deviating_part_at_the_side_does_not_count_for_the_middle() -> None:
    assert subsets(0.5, 5).centre.max() < 1.0


@pytest.mark.parametrize("noise", [2.0, 30.0])
def test_a_loss_over_the_whole_subset_gives_no_other_centre(noise: float) -> None:
    assert subsets(0.0, 0, noise=noise).centre.max() < 1.0


def folded(rise_px: float, degrees: float) -> Pull:
    """Soft speckle on a surface with a fold through each subset's middle, as a curved patch leaves it."""
    rng = np.random.default_rng(5)
    texture = gaussian_filter(rng.normal(size=(N, WIDTH, WIDTH)), (0.0, 1.8, 1.8))
    texture *= 50.0 / texture.std()
    gx, gy = np.gradient(texture, axis=2), np.gradient(texture, axis=1)
    v, u = (np.mgrid[:WIDTH, :WIDTH] - WIDTH // 2) / (WIDTH // 2)
    angle = np.deg2rad(degrees)
    rise = rise_px * np.abs(np.cos(angle) * u + np.sin(angle) * v)
    residual = rng.normal(0.0, np.sqrt(2.0) * NOISE, texture.shape) + rise * gx
    for one, g in zip(residual, gx, strict=True):  # the parabola that is next to it
        patch = np.stack([g * b for b in (np.ones_like(u), u, v, u * u, u * v, v * v)], axis=-1).reshape(-1, 6)
        one -= (patch @ np.linalg.lstsq(patch, one.ravel(), rcond=None)[0]).reshape(one.shape)
    reference = texture - texture.mean(axis=(1, 2), keepdims=True)
    return pull_of_parts(SubsetResiduals(residual, gx, gy, reference), np.ones(texture.shape, bool), 2, folds=(0,))


@pytest.mark.parametrize("degrees", [0.0, 10.0, 67.0])
def test_a_fold_that_a_curved_patch_hides_is_found_and_what_it_does_to_the_middle(degrees: float) -> None:
    pull = folded(1.5, degrees)
    found = np.take_along_axis(pull.shift_px[:, 0], pull.part[:, 0, None], axis=1)[:, 0]
    sure = pull.significance[:, 0] > 5.0
    assert sure.mean() > 0.9
    # a parabola fitted to |t| over -1 < t < 1 lies 3/16 above it in the middle; over a square's corners somewhat more
    assert np.median(found[sure]) == pytest.approx(-1.5 * 3.0 / 16.0, rel=0.3)


def test_where_there_is_no_fold_none_is_found() -> None:
    pull = folded(0.0, 0.0)
    assert (pull.significance[:, 0] < 5.0).mean() > 0.97
