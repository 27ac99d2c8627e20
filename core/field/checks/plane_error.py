"""Bias of plane patches on a curved surface, estimated from a field that they measured.

A plane patch averages the surface below it: its bias is half the second derivative times the subset's second moment,
(h^2 - 1) / 12 px^2 for a subset h wide, along both axes. Inverse depth w and the columns G of the motion are linear in
the image for planes that move, at any tilt, so the bias follows from their Laplacian over neighbouring points. The
neighbours are taken a subset's width away, where their noise is their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.points.fitter import PointFits

_MIN_POINTS = 16
_TRIMMED = 0.02
_FAR_SUBSETS = 2.0


class PlaneError(NamedTuple):
    """Bias and noise of the plane patches that a field was measured with.

    Attributes
    ----------
    error_mm
        rms bias of position (shape) or displacement (motion), less the noise of this estimate.
    below_mm
        Upper bound of it, two standard deviations of the estimate above.
    noise_mm
        Standard deviation of position or displacement from image noise, rms.
    """

    error_mm: float
    below_mm: float
    noise_mm: float


def plane_error(
    points: PointFits, *, shape: tuple[int, int], rays: Float, spacing_px: float, subset_px: int
) -> PlaneError | None:
    """Estimate the plane patches' bias.

    Parameters
    ----------
    points
        n = rows x columns points, fitted with plane patches and checked.
    shape
        Rows and columns.
    rays
        (n, 3) normalised.
    spacing_px, subset_px
        Distance of the points and width of the subset, px.

    Returns
    -------
    PlaneError or None
        None if too few points have neighbours, or the neighbours are too far away.
    """
    separation = max(1, int(np.ceil(subset_px / spacing_px)))
    rows, cols = shape
    if separation * spacing_px > _FAR_SUBSETS * subset_px or min(rows, cols) < 2 * separation + 1:
        return None
    w, G = points.w[:, 0], points.G[:, :, 0]
    moved = points.zncc.shape[1] == 3
    # per unit of w and of G: to mm along the ray, or of displacement
    if moved:
        by_w = -(G - rays) / w[:, None] ** 2
        C = points.covariance
        variance = (by_w**2).sum(1) * C[:, 0, 0] + (C[:, 1, 1] + C[:, 2, 2] + C[:, 3, 3]) / w**2
        variance += 2.0 * (by_w * C[:, 0, 1:4]).sum(1) / w
    else:
        by_w = -rays / w[:, None] ** 2
        variance = (by_w**2).sum(1) * points.covariance[:, 0, 0]
    factor = (subset_px**2 - 1) / 24.0 / (separation * spacing_px) ** 2
    bend_w, noise = _laplacian(w.reshape(shape), separation), _gathered(variance.reshape(shape), separation) * factor**2
    inner = (slice(separation, rows - separation), slice(separation, cols - separation))
    off = factor * bend_w[..., None] * by_w.reshape(rows, cols, 3)[inner]
    if moved:
        bends = np.stack([_laplacian(G[:, i].reshape(shape), separation) for i in range(3)], axis=-1)
        off += factor * bends / w.reshape(shape)[inner][..., None]
    square = (off**2).sum(-1)
    known = np.isfinite(square) & (noise > 0.0)
    if known.sum() < _MIN_POINTS:
        return None
    square, noise, own = square[known], noise[known], variance.reshape(shape)[inner][known]
    # two per cent are left out: single wrong points, and steps at cracks and edges
    used = np.argsort(square / noise)[: len(square) - int(np.ceil(_TRIMMED * len(square)))]
    error2 = max(float(np.mean(square[used] - noise[used])), 0.0)
    below2 = error2 + 2.0 * float(np.std(square[used])) / np.sqrt(len(used))
    return PlaneError(float(np.sqrt(error2)), float(np.sqrt(below2)), float(np.sqrt(np.mean(own))))


def _laplacian(f: Float, k: int) -> Float:
    """Sum of the four neighbours ``k`` points away minus four times the middle, without the rim."""
    return f[: -2 * k, k:-k] + f[2 * k :, k:-k] + f[k:-k, : -2 * k] + f[k:-k, 2 * k :] - 4.0 * f[k:-k, k:-k]


def _gathered(variance: Float, k: int) -> Float:
    """Variance of :func:`_laplacian` for values with this one."""
    v = variance
    return v[: -2 * k, k:-k] + v[2 * k :, k:-k] + v[k:-k, : -2 * k] + v[k:-k, 2 * k :] + 16.0 * v[k:-k, k:-k]
