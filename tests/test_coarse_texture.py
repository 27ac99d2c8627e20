"""Coarse texture under noise: gradients of the noise must not pass for texture, in the steps and in the covariance."""

from __future__ import annotations

import numpy as np
import pytest
from matching_scene import Plane, Texture, digitise, paper_pair, render, true_g, true_w

from core.errors import InputError
from core.matching import MatchOptions, fit_motion, prepare
from core.matching.geometry import covariance_xyzuvw, motion_geometry
from core.matching.kernels.point import take_noise_out
from core.matching.kernels.reference import N_REFERENCE, reference_sums, set_up_reference

SUBSET = 33


def gram(image, interpolation, lens):
    prepared = prepare(image, interpolation)
    ref, box = np.empty((N_REFERENCE, SUBSET**2), np.float32), np.empty(4)
    inside, xc, yc, f2 = set_up_reference(
        prepared.pixels, *prepared.gradients, lens, 40.0, 38.0, SUBSET, ref, box, np.empty((2, 10))
    )
    assert inside
    hessian = np.empty((9, 9))
    reference_sums(ref, SUBSET**2, f2, np.empty((10, 9)), np.empty(9), np.empty(9), hessian)
    return hessian, box, xc, yc


@pytest.mark.parametrize("interpolation", ["cubic", "quintic"])
def test_what_noise_adds_to_the_hessian_is_known(interpolation: str) -> None:
    lens = paper_pair().cam1.lens.kernel_parameters()
    rng = np.random.default_rng(4)
    yy, xx = np.mgrid[:80, :80]
    smooth = 120.0 + 40.0 * np.sin(xx / 7.0 + 0.3 * np.cos(yy / 9.0)) * np.cos(yy / 8.0)
    truth, box, xc, yc = gram(smooth, interpolation, lens)
    noise = 1.5
    left, right, added = np.zeros((9, 9)), np.empty((9, 9)), np.zeros((9, 9))
    runs = 150
    for _ in range(runs):
        noisy, *_ = gram(smooth + rng.normal(0.0, noise, smooth.shape), interpolation, lens)
        take_noise_out(noisy, lens, xc, yc, box, SUBSET, noise**2, 3 if interpolation == "cubic" else 5, right)
        left += right / runs
        added += noisy / runs
    unit = np.sqrt(np.diag(truth))
    scale = np.outer(unit, unit)
    assert np.abs((added - truth) / scale).max() > 0.1  # there is something to take out
    assert np.abs((left - truth) / scale).max() < 0.025


@pytest.mark.slow
def test_the_covariance_of_coarse_texture_tells_the_truth() -> None:
    pair, texture = paper_pair(), Texture(blob_mm=0.17)
    before, after = Plane(), Plane(np.array([0.0123, -0.0241, 0.0371]))
    clean = [render(c, p, texture) for p in (before, after) for c in (pair.cam1, pair.cam2)]
    axis = np.linspace(30.0, clean[0].shape[0] - 31.0, 12)
    xy = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    w, G = true_w(pair.cam1, before, xy), true_g(pair.cam1, before, after, xy)
    options = MatchOptions(subset_px=SUBSET)
    scores, shares = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        images = [prepare(digitise(image, noise=4.0, rng=rng)) for image in clean]
        fit = fit_motion(pair, *images, xy, w, G, options)
        ok = fit.status == 0
        shares.append(ok.mean())
        uvw = motion_geometry(pair, xy, fit.w, fit.G).uvw_mm
        cov = covariance_xyzuvw(pair, xy, fit.w, fit.G, fit.covariance)
        sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1)[:, 3:])
        scores.append(((uvw - after.origin) / sigma)[ok])
    z = np.concatenate(scores)
    print(f"valid {np.mean(shares):.3f}, error over sigma rms {np.sqrt((z**2).mean(0))}")
    assert np.mean(shares) > 0.85
    assert (np.sqrt((z**2).mean(0)) < 1.3).all()


def test_a_message_is_one_line_of_sentences() -> None:
    assert str(InputError("5 lines found", code="few", remedy="Look.")) == "few: 5 lines found. Remedy: Look."
    assert str(InputError("Nothing found.", code="few", remedy="Look.")) == "few: Nothing found. Remedy: Look."
