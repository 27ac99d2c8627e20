"""Fields of curved patches: growth over far points, and what a sphere's field comes to."""

from __future__ import annotations

import numpy as np

from stereorig.core.field.growth.grow import Attempts, grow
from stereorig.core.field.points.fitter import PointFits
from stereorig.core.measure import MeasureOptions, measure_shape
from stereorig.core.status import PointStatus
from tests.support.field_bench import grid, pair, take, truth
from tests.support.field_bench import scene as scene_of


class Refusing:
    """A matcher of curved patches that finds nothing and keeps what it was asked."""

    comparisons, terms = 1, 6

    def __init__(self) -> None:
        self.starts: list[np.ndarray] = []

    def fit(self, xy_px: np.ndarray, w: np.ndarray, G: None) -> PointFits:
        del G
        self.starts.append(w)
        fits = PointFits.empty(len(xy_px), 1, 6)
        fits.status[:] = PointStatus.NOT_CONVERGED
        return fits

    def far_from_start(self, xy_px: np.ndarray, *_: object) -> np.ndarray:
        return np.zeros(len(xy_px), bool)


def test_growth_tries_with_and_without_the_neighbours_curvature() -> None:
    # a curvature found in a small noisy patch does not apply several subsets further on
    points = PointFits.empty(9, 1, 6)
    points.w[[0, 2, 6, 8]], points.zncc[[0, 2, 6, 8]] = [2.5e-3, 1e-3, 0.0, 40.0, 0.0, 0.0], 0.99
    points.status[[0, 2, 6, 8]] = PointStatus.OK
    fitter, usable = Refusing(), np.ones(9, bool)
    x, y = (a.ravel() * 0.01 for a in np.meshgrid(np.arange(3.0), np.arange(3.0)))
    rays = np.stack([x, y, np.ones(9)], -1)
    attempts = Attempts.on((3, 3))
    added = grow(fitter, points, attempts=attempts, xy_px=1e4 * rays[:, :2], rays=rays, usable=usable)  # type: ignore[arg-type]
    assert added == 0
    starts = np.concatenate(fitter.starts)
    curved = starts[:, 3] != 0.0
    assert (starts[curved, 3] == 40.0).all()
    # the middle has four attempts, points beside it two
    assert curved.sum() == (~curved).sum() == 6
    moved = np.unique(np.round(starts[~curved, 0] - 2.5e-3, 9))
    np.testing.assert_allclose(moved, [-1e-5, 0.0, 1e-5], atol=1e-12)  # by the slope alone


def test_a_sphere_comes_out_where_it_is_and_as_curved_as_it_is() -> None:
    points = grid()
    images = take("sphere", noise=2.0)
    fields = {
        p: measure_shape(pair(), *images, points, MeasureOptions(subset_px=21, patch=p)) for p in ("quadratic", "auto")
    }
    for field in fields.values():
        assert field.valid.mean() > 0.99
        error = (field.xyz_mm - truth(points, scene_of("sphere")).xyz_mm)[..., 2][field.valid] * 1e3
        assert abs(error.mean()) < 0.05
        assert error.std() < 0.4
        assert field.curvature_per_mm is not None
        mean = field.curvature_per_mm[field.valid].mean(axis=1)
        assert abs(30.0 * mean.mean() - 1.0) < 0.03
        assert field.patch is not None
        assert field.patch.patch == "quadratic"
    assert fields["auto"].patch != fields["quadratic"].patch  # the one with a reason, the other asked for
