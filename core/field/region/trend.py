"""Slow variation over a field, as a quadratic surface over the image."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float


def smooth_terms(xy_px: Float) -> Float:
    """Return the terms (n, 6) of a quadratic surface at points (n, 2), scaled to unit size.

    In the order 1, x, y, x^2, x y, y^2: the first column is a constant, the first three a plane.
    """
    x, y = ((a - a.mean()) / max(float(np.ptp(a)), 1.0) for a in np.ascontiguousarray(xy_px.T))
    return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
