"""Noise that is not white, and has nothing to do with the texture: columns, rows, pixels that correlate.

The residual test's blocks of some pixels ignore that a column crosses a whole subset, and that pixels on both sides of
a block's border correlate. If residuals are noise alike over the field, their autocovariance over a sample of subsets
is the noise's own, with lines in it as ridges; with the autocorrelation of a subset's gradients it gives the variance
of a match, for any kind of noise. Residuals that follow the texture (blur, light) are no such noise: in blocks they sum
to less than their autocovariance predicts.
"""

from __future__ import annotations

import numpy as np
from numpy import fft
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.points.fitter import Fitter, PointFits
from stereorig.core.field.points.subset_residuals import SubsetResiduals, subset_residuals
from stereorig.core.matching.defects import SURE, box_about, line_covariance, strips_along
from stereorig.core.matching.kernels.cluster_robust import blocks_across
from stereorig.core.robust import spread_indices

_FAR_PX = 8  # farther than blur or a lens' error correlates
_MIN_RIDGE = 0.04  # share of the residuals' variance, far along a line: less changes a variance by less than a tenth
_MIN_SHARE = 0.02  # share of the noise's variance: lines in an image for which residuals are examined
_COLOURED = 1.5  # multiple of white noise's variance: with less correlation the pixels are left to the blocks
# (depth, offset): variance in blocks over the one predicted from the autocovariance; with blur the depth's is 0.82 and
# less, and the offset's variance, which the fit underestimates, is 1.1 to 1.2 for noise, too
_LEAST, _MOST = np.array([0.85, 0.85]), np.array([1.2, 1.4])
_ENOUGH = 96  # number of subsets whose gradients are sufficient
_ALIKE = 1.6  # 90 % quantile over median of the subsets' residual energy: stains and flakes have more


def shows_lines(fitter: Fitter, points: PointFits, xy_px: Float) -> bool:
    """Return True if one of the reference's images shows columns or rows that its noise does not explain."""
    ok = points.ok
    least = _MIN_SHARE * float(np.nanmedian(points.noise[ok])) ** 2
    box = box_about(xy_px[ok], fitter.options.subset_px, fitter.ref1.shape)
    for image, part in ((fitter.ref1, box), (fitter.ref2, np.s_[:, :])):
        for axis in range(2):
            strips = strips_along(image.raw[part], axis)
            found, sd = line_covariance(strips, strips)
            if found > max(SURE * sd, least):
                return True
    return False


def noise_factor(
    fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float, seen_in_blocks: Float
) -> Float | None:
    """Return (2,) the variances of (w0, offset) over those of white noise; None if residuals are no such noise.

    Parameters
    ----------
    fitter, points
        The matcher of a shape, and its points.
    index
        (m,) a sample of valid points.
    xy_px
        (n, 2) px of camera 1.
    seen_in_blocks
        (2,) the ratio from blocks of the residuals; NaN if it is not known.
    """
    found = _samples(fitter, points, index, xy_px)
    if not found:
        return None
    some, covariance = found[0]
    whole = np.median(_variances(some, covariance, 1), axis=0)
    if _has_ridge(covariance):
        return np.asarray(whole)
    if whole.max() < _COLOURED:
        return None
    across = blocks_across(fitter.options.subset_px)
    agrees = seen_in_blocks / np.median(_variances(some, covariance, across), axis=0)
    return np.asarray(whole) if (agrees > _LEAST).all() and (agrees < _MOST).all() else None


def line_factor(fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float) -> Float | None:
    """Return (5,) as :func:`noise_factor` for a motion's (w0, G00, G10, G20, offset); None without columns or rows."""
    found = _samples(fitter, points, index, xy_px)
    if len(found) < 3 or not any(_has_ridge(covariance) for _, covariance in found):
        return None
    # the fit takes all images to be as noisy as its quietest comparison
    least = min(covariance[0, 0] for _, covariance in found)
    before, own, now = (
        np.median(_variances(some, covariance, 1), axis=0) * covariance[0, 0] / least for some, covariance in found
    )
    along, across = 0.5 * (before + now)
    return np.array([along, own[0], own[1], along, across])


def _samples(
    fitter: Fitter, points: PointFits, index: NDArray[np.intp], xy_px: Float
) -> list[tuple[SubsetResiduals, Float]]:
    """Subsets and their residuals' autocovariance, by comparison; none if residuals differ from point to point."""
    each, visible = subset_residuals(fitter, points, index, xy_px, slice(None))
    whole = visible.all(axis=(1, 2))
    out = []
    for residuals in each if whole.any() else ():
        residuals = SubsetResiduals(*(part[whole] for part in residuals))
        energy = (residuals.residual**2).mean(axis=(1, 2))
        if np.quantile(energy, 0.9) > _ALIKE * np.median(energy):
            return []
        some = spread_indices(len(energy), _ENOUGH)
        out.append((SubsetResiduals(*(part[some] for part in residuals)), _autocovariance(residuals.residual)))
    return out


def _has_ridge(covariance: Float) -> bool:
    return bool(max(_ridge(covariance), _ridge(covariance.T)) > _MIN_RIDGE * covariance[0, 0])


def _autocovariance(values: Float) -> Float:
    """(2 s, 2 s) mean products at each lag of images (m, s, s); index 0 is lag 0, negative lags come from the end."""
    side = values.shape[1]
    size = (2 * side, 2 * side)
    total = fft.irfft2((np.abs(fft.rfft2(values, s=size)) ** 2).mean(axis=0), s=size)
    pairs = fft.irfft2(np.abs(fft.rfft2(np.ones((side, side)), s=size)) ** 2, s=size)
    return np.where(pairs > 0.5, total / np.maximum(pairs, 0.5), 0.0)


def _ridge(covariance: Float) -> float:
    """Return the covariance far along columns, less that at the same distance between columns."""
    far = slice(_FAR_PX, max(len(covariance) // 2 - 4, _FAR_PX + 1))
    return float(covariance[far, 0].mean() - 0.5 * (covariance[far, 2].mean() + covariance[far, -2].mean()))


def _variances(residuals: SubsetResiduals, covariance: Float, across: int) -> Float:
    """(m, 2) variances along and across the epipolar line over white noise's, summed over ``across`` squared parts."""
    side = residuals.along.shape[1]
    size = covariance.shape
    gradients = np.stack([residuals.along, residuals.across], axis=1)
    part = np.arange(side) * across // side
    score, gram = np.zeros((len(gradients), 2, 2)), np.zeros((len(gradients), 2, 2))
    spectrum = fft.rfft2(covariance)
    for a in range(across):
        for b in range(across):
            inside = (part == a)[:, None] & (part == b)
            found = fft.rfft2(gradients * inside, s=size)
            # Parseval: the sum over lags of the covariance times the gradients' autocorrelation
            score += _sum(found, spectrum.real, size)
            gram += _sum(found, np.ones_like(spectrum.real), size)
    inverse = np.linalg.inv(gram)
    return np.asarray(
        np.diagonal(inverse @ score @ inverse, axis1=1, axis2=2)
        / (covariance[0, 0] * np.diagonal(inverse, axis1=1, axis2=2))
    )


def _sum(found: NDArray[np.complex128], weight: Float, size: tuple[int, ...]) -> Float:
    twice = np.full(found.shape[-1], 2.0)
    twice[0] = twice[-1] = 1.0
    return np.asarray(
        np.einsum("mikl,mjkl,kl->mij", found, found.conj(), weight * twice, optimize=True).real / (size[0] * size[1])
    )
