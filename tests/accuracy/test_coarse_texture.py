"""Coarse texture under noise: gradients of the noise must not pass for texture, in the steps and in the covariance."""

from __future__ import annotations

import numpy as np

from stereorig.core.errors import InputError
from stereorig.core.matching import MatchOptions, fit_motion, prepare
from stereorig.core.matching.geometry import covariance_xyzuvw, motion_geometry
from tests.support.matching_scene import Plane, Texture, digitise, paper_pair, render, true_g, true_w

SUBSET = 33


def test_the_covariance_of_coarse_texture_tells_the_truth() -> None:
    pair, texture = paper_pair(), Texture(blob_mm=0.22)
    before, after = Plane(), Plane(np.array([0.0123, -0.0241, 0.0371]))
    clean = [render(c, p, texture) for p in (before, after) for c in (pair.cam1, pair.cam2)]
    axis = np.linspace(30.0, clean[0].shape[0] - 31.0, 12)
    xy = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    w, G = true_w(pair.cam1, before, xy), true_g(pair.cam1, before, after, xy)
    options = MatchOptions(subset_px=SUBSET)
    scores, shares = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        images = [prepare(digitise(image, noise=3.0, rng=rng)) for image in clean]
        fit = fit_motion(pair, *images, xy, w, G, options)
        ok = fit.status == 0
        shares.append(ok.mean())
        uvw = motion_geometry(pair, xy, fit.w, fit.G).uvw_mm
        cov = covariance_xyzuvw(pair, xy, fit.w, fit.G, fit.covariance)
        sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1)[:, 3:])
        scores.append(((uvw - after.origin) / sigma)[ok])
    z = np.concatenate(scores)
    print(f"valid {np.mean(shares):.3f}, error over sigma rms {np.sqrt((z**2).mean(0))}")
    assert np.mean(shares) > 0.8
    assert (np.sqrt((z**2).mean(0)) < 1.25).all()


def test_a_message_is_one_line_of_sentences() -> None:
    assert str(InputError("5 lines found", code="few", remedy="Look.")) == "few: 5 lines found. Remedy: Look."
    assert str(InputError("Nothing found.", code="few", remedy="Look.")) == "few: Nothing found. Remedy: Look."
