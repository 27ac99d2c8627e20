"""Smooth structure in offsets beyond their noise."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.region.trend import smooth_terms
from stereorig.core.orientation.matched import MatchedPoints
from stereorig.core.orientation.noise import SharedNoise, effective_variance, robust_weights


def structure_left_px(points: MatchedPoints, offset_px: Float, *, order: int) -> float:
    """Return the root mean square of the polynomial of some order in offsets (n,), less the noise's part.

    Each step has a polynomial of its own: a step's points are at other places and depths.
    """
    square, count = 0.0, 0
    for step in np.unique(points.step):
        of_step = points.step == step
        terms = smooth_terms(points.xy1_px[of_step])
        if order > 2:
            x, y = terms[:, 1], terms[:, 2]
            terms = np.column_stack([terms, x**3, x * x * y, x * y * y, y**3])
        values = offset_px[of_step]
        if len(values) < 4 * terms.shape[1]:
            terms = terms[:, :1]
        weights = np.ones(len(values))
        for _ in range(4):
            smooth = (
                terms @ np.linalg.lstsq(terms * np.sqrt(weights)[:, None], values * np.sqrt(weights), rcond=1e-9)[0]
            )
            weights, _ = robust_weights(values - smooth)
        by_noise = effective_variance(terms, weights, values, SharedNoise.of(points.at(of_step))) * terms.shape[1]
        square += max(float((smooth**2).sum()) - by_noise, 0.0)
        count += len(values)
    return float(np.sqrt(square / max(count, 1)))
