"""Noise of the comparisons: their joint weights, its size from the residuals, its share in the gradients."""

from __future__ import annotations

import math

import numpy as np

from stereorig.core.matching.kernels.naming import inner

# White noise of variance 1 behind a spline, at fraction t between pixels, along one axis: a + b cos(2 pi t), the first
# two Fourier terms of the sum of the cardinal spline's squares (the third is 0.004 and less)
VALUE_NOISE = ((0.8742, 0.1213), (0.9180, 0.0818))  # cubic, quintic
ALIKE_SD = 3.0  # comparisons with residuals as similar as this hold noise alone
UNLIKE = 1.5  # small differences of the views raise residuals by less, and affect the solution less than noise does
MIN_CORRELATION = 0.05  # valid matches have several times as much
MAX_NOISE_SHARE = (
    0.5  # share of the squared gradients; a correlation of 0.5 leaves less, and more is noise mistaken for texture
)

# an image's levels; the misfit is the residuals' sum of squares, followed by the noise of its interpolated grey levels
# over the noise of its pixels, and the number of its pixels that show one pixel of the reference
GAIN, SHIFT, ZNCC, CONTRAST, MISFIT, SMOOTHED, DENSITY = range(7)
N_LEVELS = 7


@inner
def joint_weights(levels, variances, images, weights):
    """Inverse covariance of the comparisons' residuals.

    Residual k is (noise of image k) / contrast_k minus the reference's noise, which all share: covariance diag(v_k /
    (contrast_k^2 density_k)) + v_ref 1 1^T, with the reference's variance first in ``variances``. The noise of an image
    that shows the subset on more pixels averages out more.
    """
    total = 1.0 / variances[0]
    for k in range(images):
        total += _certainty(levels, variances, k)
    for k in range(images):
        a = _certainty(levels, variances, k)
        for o in range(images):
            weights[k, o] = (a if k == o else 0.0) - a * _certainty(levels, variances, o) / total


@inner
def _certainty(levels, variances, k):
    s = min(max(levels[k, CONTRAST], 0.05), 20.0)
    return s * s * levels[k, DENSITY] / variances[1 + k]


@inner
def _spread_over(reach):
    """Mean of cos(2 pi t) for t from -reach to reach."""
    a = abs(2.0 * math.pi * reach)
    if a > 8.0:
        return 0.0
    return math.sin(a) / a if a > 1e-3 else 1.0


@inner
def _mean_cosine(middle, along_x, along_y):
    """Mean of cos(2 pi t) over a subset whose positions extend from ``middle`` by up to these px each way."""
    spread = _spread_over(along_x) * _spread_over(along_y)
    return spread * math.cos(2.0 * math.pi * middle) if spread != 0.0 else 0.0


@inner
def interpolated_noise(warp, half, order):
    """Variance of interpolated grey levels per variance of white noise in the pixels, mean over the subset."""
    a, b = VALUE_NOISE[0] if order == 3 else VALUE_NOISE[1]
    return (a + b * _mean_cosine(warp[0], warp[1] - half, warp[2])) * (
        a + b * _mean_cosine(warp[10], warp[11], warp[12] - half)
    )


@inner
def noise_from_residuals(levels, images, n, unknowns):
    """Variance of one image's noise at weight one, in reference grey levels squared, from the residuals.

    The least noisy of three comparisons counts: the others' residuals are raised by small differences of the views,
    which affect the solution less than noise does.
    """
    freedom = max(n - 2.0 - unknowns / images, 1.0)
    min_variance = np.inf
    for k in range(images):
        min_variance = min(min_variance, _one_variance(levels, k))
    limit = min_variance * (1.0 + ALIKE_SD * math.sqrt(2.0 / freedom))
    total, count = 0.0, 0
    for k in range(images):
        one = _one_variance(levels, k)
        if one <= limit:
            total += one
            count += 1
    return max(total, 0.0) / max(count, 1) / freedom


@inner
def best_correlation(levels, images):
    """The best correlation of the comparisons, at least ``MIN_CORRELATION``."""
    best = MIN_CORRELATION
    for k in range(images):
        best = max(best, levels[k, ZNCC])
    return best


@inner
def unlike_noise(levels, images, n, unknowns):
    """Return the variance by which the noisiest image exceeds the estimate of the least noisy comparison.

    Zero if all are alike. The weights assume equal noise of all images. If one has clearly more (less light, blur, a
    surface that changed), the variance of the unknowns that depend on it is the mean of its variance and the
    reference's, as estimated by its own comparison; so the covariance is that of the noisiest comparison. That image's
    contrast is noise in part, so its residuals, brought to the reference's contrast, are smaller than the noise: by its
    correlation over the best one, which gives the effect of the reference's own noise on a correlation.
    """
    freedom = max(n - 2.0 - unknowns / images, 1.0)
    best = best_correlation(levels, images)
    min_variance, max_variance = np.inf, 0.0
    for k in range(images):
        one = _one_variance(levels, k)
        min_variance = min(min_variance, one)
        max_variance = max(max_variance, one * (best / max(levels[k, ZNCC], MIN_CORRELATION)) ** 2)
    return max(max_variance - UNLIKE * min_variance, 0.0) / freedom


@inner
def _one_variance(levels, k):
    s = min(max(levels[k, CONTRAST], 0.05), 20.0)
    return levels[k, MISFIT] / (1.0 + levels[k, SMOOTHED] / (s * s))


@inner
def share_correction(texture, variance, p, slope_noise, expected_share):
    """Factor on the covariance for a subset whose gradients have another share of noise than the image's mean.

    Parameters
    ----------
    texture
        Sum of the squared gradients, mean of both directions.
    variance, p
        Variance of the noise, and the sum of the weights.
    slope_noise, expected_share
        ``ImageData.slope_noise`` and ``slope_share``.
    """
    share = min(slope_noise * variance * p / texture, MAX_NOISE_SHARE)
    ratio = (1.0 - min(expected_share, MAX_NOISE_SHARE)) / (1.0 - share)
    return ratio * ratio
