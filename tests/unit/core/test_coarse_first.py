"""A large field grows over a coarse part of its points first, and comes to the field that one pass makes."""

from __future__ import annotations

import numpy as np

from stereorig.core.field.points.result import Field
from stereorig.core.field.region.lay_points import make_grid
from stereorig.core.field.sequence.joint import AGREE_SIGMAS
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.settings import AnalysisSettings
from tests.support import sequence_bench as bench

HOLE = [[200, 170], [235, 165], [240, 205], [205, 210]]
CRACK = [[300, 130], [310, 240], [330, 330]]


def test_both_ways_give_the_same_points_and_values_within_their_uncertainty() -> None:
    images = [bench.capture(bench.plate(0.4 * n, np.array([0.03, -0.02, 0.02]) * n), seed=n) for n in range(2)]
    region = {"rectangle": [130, 120, 390, 360], "holes": [HOLE], "cracks": [CRACK]}
    settings = AnalysisSettings.model_validate({"region": region, "subset_px": 33, "spacing_px": 8})
    grid = make_grid(settings, None, images[0][0].shape)
    reference = ReferencePair(bench.rig().pair, *images[0])

    def measured(coarse_from: int) -> tuple[Field, Field]:
        options = MeasureOptions(subset_px=33, patch="affine", coarse_from=coarse_from)
        shape = reference.shape(grid, options)
        return shape, reference.motion(*images[1], grid, options, shape=shape)

    (shape, motion), coarse = measured(100_000), measured(0)
    assert 0.9 < shape.valid.mean() < 1.0  # the rest lies in the hole
    for one, two in zip((shape, motion), coarse, strict=True):
        np.testing.assert_array_equal(one.status, two.status)
        a, b = (f.xyz_mm if f.uvw_mm is None else f.uvw_mm for f in (one, two))
        off = ((a - b) / one.sigma_mm[..., -3:])[one.valid]
        assert 0.0 < np.sqrt(np.mean(off**2)) < AGREE_SIGMAS
