"""What further steps keep of the reference pair, beside the full comparison and the kernels' numpy twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.field.points.kept_reference import KeptReference
from core.field.sequence.reference_steps import Updating
from core.matching import MatchOptions, fit_motion, fit_shape
from core.matching.arguments import VisiblePixels
from core.matching.fit import keep_reference
from core.matching.image import prepare
from core.matching.kernels.kept import KEPT_PX
from tests.support import sequence_bench as bench
from tests.support.matching_scene import Plane, Texture, digitise, paper_pair, render, true_g, true_w
from tests.support.matching_twin import Twin

AFTER = Plane(np.array([0.02, -0.01, 0.015]), np.array([[1.01, 0.02], [-0.015, 0.995], [0.03, -0.02]]))
SUBSET = 25


def scene(interpolation="cubic", noise=2.0):
    """Prepared images of a plane before and after, points, and starts from the truth."""
    pair = paper_pair(kappa=2e-8)
    rng = np.random.default_rng(5)
    images = [
        digitise(render(camera, plane, Texture(blob_mm=0.05)), noise=noise, rng=rng)
        for plane in (Plane(), AFTER)
        for camera in (pair.cam1, pair.cam2)
    ]
    xy = np.stack(np.meshgrid(np.arange(40.0, 121.0, 8.0), np.arange(40.0, 121.0, 8.0)), axis=-1).reshape(-1, 2)
    starts = true_w(pair.cam1, Plane(), xy), true_g(pair.cam1, Plane(), AFTER, xy)
    return pair, images, [prepare(image, interpolation) for image in images], xy, *starts


def kept_of(pair, prepared, xy, w, options, visible=None):
    shape = fit_shape(pair, *prepared[:2], xy, w, options)
    assert (shape.status == 0).all()
    return shape, keep_reference(pair, *prepared[:2], xy, shape.w, shape.epipolar_px, options, visible)


def off_sigma(fit, other):
    """Differences of the unknowns of the points themselves over their standard deviations."""
    own = [np.column_stack([f.w[:, 0], f.G[:, :, 0], f.epipolar_px]) for f in (fit, other)]
    return (own[0] - own[1]) / np.sqrt(np.diagonal(other.covariance, axis1=1, axis2=2))


@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 3), ("quintic", 5)])
def test_with_what_is_kept_the_solution_is_still_the_twins(interpolation, order):
    pair, images, prepared, xy, w, G = scene(interpolation)
    few = slice(0, len(xy), 40)
    xy, w, G = xy[few], w[few], G[few]
    options = MatchOptions(subset_px=SUBSET, interpolation=interpolation, tolerance_px=3e-6)
    _, kept = kept_of(pair, prepared, xy, w, options)
    first = fit_motion(pair, *prepared, xy, w, G, options, kept=kept)
    fit = fit_motion(pair, *prepared, xy, first.w, first.G, options, kept=kept)
    assert (fit.status == 0).all()
    for i, at in enumerate(xy):
        twin = Twin(pair, images, at, subset=SUBSET, order=order)
        mine = np.array([*fit.w[i], fit.epipolar_px[i], *fit.G[i].ravel()])
        p = twin.solve(mine)
        for k in range(3):
            # as of the full comparison (test_matching_twin.py): the twin's Jacobian is whole, the kernel's is not
            assert np.abs(twin.position(k, p, twin.XY) - twin.position(k, mine, twin.XY)).max() < 6e-4
            assert abs(fit.zncc[i, k] - twin.residual(k, p)[2]) < 1e-5


@pytest.mark.parametrize("interpolation", ["cubic", "quintic"])
@pytest.mark.parametrize("noise", [2.0, 8.0])
def test_points_move_by_far_less_than_their_noise(interpolation, noise):
    pair, _, prepared, xy, w, G = scene(interpolation, noise)
    options = MatchOptions(subset_px=SUBSET, interpolation=interpolation, tolerance_px=1e-5)
    shape, kept = kept_of(pair, prepared, xy, w, options)
    full = fit_motion(pair, *prepared, xy, w, G, options)
    fit = fit_motion(pair, *prepared, xy, w, G, options, kept=kept)
    assert (fit.status == full.status).all()
    off = off_sigma(fit, full)
    assert np.sqrt((off**2).mean(axis=0)).max() < 0.02
    assert np.abs(off).max() < 0.1
    assert np.abs(off.mean(axis=0)).max() < 0.01
    assert (np.abs(fit.zncc - full.zncc) < 0.02 * (1.0 - full.zncc)).all()  # of the misfit
    # what it rests on: with the current pair the points' offsets are other ones, by less than the bound
    moved = np.abs(full.epipolar_px - shape.epipolar_px)
    assert 0.0 < np.median(moved) < KEPT_PX / 2


def test_far_from_the_shapes_result_camera_2_is_compared():
    pair, _, prepared, xy, w, G = scene()
    options = MatchOptions(subset_px=SUBSET, tolerance_px=1e-5, interpolation="cubic")
    shape, _ = kept_of(pair, prepared, xy, w, options)
    full = fit_motion(pair, *prepared, xy, w, G, options)
    # kept where no point ends: every one of these comparisons would pull it there
    elsewhere = keep_reference(pair, *prepared[:2], xy, shape.w, shape.epipolar_px + 5.0 * KEPT_PX, options)
    fit = fit_motion(pair, *prepared, xy, w, G, options, kept=elsewhere)
    assert np.abs(off_sigma(fit, full)).max() < 0.01
    assert np.abs(fit.zncc - full.zncc).max() < 1e-5


def test_nothing_is_kept_of_subsets_that_are_cut_or_outside_or_without_a_shape():
    pair, _, prepared, xy, w, _ = scene()
    options = MatchOptions(subset_px=SUBSET, interpolation="cubic")
    xy, w = xy[:4].copy(), w[:4]
    shape = fit_shape(pair, *prepared[:2], xy, w, options)
    patch = np.ones((1, SUBSET, SUBSET), np.uint8)
    patch[:, :5] = 0
    visible = VisiblePixels(patch, np.array([0, -1, -1, -1], np.int32))
    offset = shape.epipolar_px.copy()
    offset[1] = np.nan
    xy[2] = 3.0
    kept = keep_reference(pair, *prepared[:2], xy, shape.w, offset, options, visible)
    assert (kept[:3] == 0.0).all()
    assert kept[3, 0] == SUBSET**2
    assert np.isfinite(kept[3]).all()


def test_kept_sums_are_those_of_the_subset():
    pair, _, prepared, xy, w, _ = scene()
    options = MatchOptions(subset_px=SUBSET, interpolation="cubic")
    _, kept = kept_of(pair, prepared, xy[:1], w[:1], options)
    half = SUBSET // 2
    rows, cols = (slice(int(v) - half, int(v) + half + 1) for v in (xy[0, 1], xy[0, 0]))
    f = prepared[0].pixels[rows, cols].astype(np.float64)
    side = np.linspace(-1.0, 1.0, SUBSET)
    x, y = np.meshgrid(side, side)
    gx, gy = (g[rows, cols].astype(np.float64) for g in prepared[0].gradients)
    columns = np.stack([g * m for g in (gx, gy) for m in (np.ones_like(x), x, y)]).reshape(6, -1)
    f = (f - f.mean()).ravel()
    np.testing.assert_allclose(kept[0, 2], f @ f, rtol=1e-5)
    np.testing.assert_allclose(kept[0, 5:11], columns.sum(axis=1), atol=1e-4 * np.abs(columns).sum(axis=1).max())
    gram = columns @ columns.T - np.outer(columns.sum(axis=1), columns.sum(axis=1)) / SUBSET**2
    gram -= np.outer(columns @ f, columns @ f) / (f @ f)
    np.testing.assert_allclose(kept[0, 17:38], gram[np.triu_indices(6)], atol=1e-4 * gram.max())


def test_steps_are_those_of_full_comparisons_and_the_same_in_another_process(monkeypatch):
    shift = np.array([0.012, -0.008, 0.02])
    scenes = [bench.plate(0.02 * k, k * shift, np.diag([1.0 + 2e-4 * k, 1.0])) for k in range(4)]
    images = [bench.capture(one, 20 + k) for k, one in enumerate(scenes)]
    used = []
    real = KeptReference.at

    def seen(self, xy):
        used.append(len(xy))
        return real(self, xy)

    monkeypatch.setattr(KeptReference, "at", seen)
    monkeypatch.setattr(Updating, "keeps", True)
    fields = bench.measure(images, "never")
    assert sum(used) > 2 * fields[2].valid.sum() * 0.9  # steps 2 and 3, not the first
    again = bench.measure(images, "never")
    np.testing.assert_array_equal(again[3].uvw_mm, fields[3].uvw_mm)
    monkeypatch.setattr(Updating, "_kept_of", lambda *_: None)
    full = bench.measure(images, "never")
    np.testing.assert_array_equal(full[1].uvw_mm, fields[1].uvw_mm)
    for n in (2, 3):
        assert (full[n].status == fields[n].status).all()
        ok = full[n].valid
        sigma = np.sqrt(np.diagonal(full[n].covariance, axis1=-2, axis2=-1))[ok][:, 3:]
        off = (fields[n].uvw_mm - full[n].uvw_mm)[ok] / sigma
        assert 0.0 < np.sqrt((off**2).mean()) < 0.02


def test_curved_and_rigid_patches_keep_nothing():
    images = bench.capture(bench.still(), 3)
    prepared = tuple(prepare(image, "quintic") for image in images)
    shape = bench.ReferencePair(bench.rig().pair, *images).shape(bench.GRID, bench.OPTIONS)
    options = bench.OPTIONS.match_options()
    given = bench.rig().pair, prepared, shape, bench.GRID.spacing_px
    assert KeptReference.of(*given, options, None) is not None
    for patch in ("rigid", "quadratic"):
        assert KeptReference.of(*given, replace(options, patch=patch), None) is None
    assert KeptReference.of(*given[:2], replace(shape, starts=None), given[3], options, None) is None
    found = KeptReference.of(*given, options, None)
    assert found.at(np.array([[191.5, 180.0]])) is None  # no point of the grid
