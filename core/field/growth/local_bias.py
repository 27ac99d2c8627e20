"""Bias of single plane patches of a motion, from how the patches' slopes change about them.

Strain in one place bends the motion over a few subsets only: the field's mean square does not show it, and points that
it has thrown out are in no sample. The slopes of plane patches half a subset to each side give the bend with a fifth of
a point's noise, so that a point's own bias is known as soon as it matters. Where the motion bends evenly, their mean
over a few subsets is known far better: it is taken off. Less than a point's noise, it would be most of the error of a
field's mean.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.field.points.fitter import PointFits

_FAR_SUBSETS = 2.0
_SLOPE_OVER_LEVEL = float(np.sqrt(12.0))  # standard deviations of a plane patch's slope, per width, and of its middle
# multiples of a point's noise: a curved patch has 1.9 times that; and at neighbours of such points
_WORTH, _AS_WELL = 1.6, 0.8
_COUNTS = 0.4  # share of a point's noise, from which a bias is stated
_SURELY, _BESIDE = 5.5, 3.0  # standard deviations of the estimate, for one among many points, and for its neighbours
_CURVED_NOISE = 1.0  # noise of a curved patch's displacement: its bend is most of it, and the bend of those about it
_ASIDE = 0.6  # subsets to each side, from which bends are compared: from half of one much of a kink's bend is there too
_BEYOND = 2.2  # standard deviations of a change of bend; from 2.5 on, 1 in 35,000 points about kinks was 6 sigma off
# stated share of the change of bend: a kink through the middle leaves 0.95 of it, smooth strain a tenth
_OF_A_KINK = 0.35
_ACROSS = 0.1  # share of it in the other directions
_AT_LEAST = 3  # neighbouring points: a single one is a wrong match
_SMOOTH_SUBSETS = 1.5  # to each side of a point, over which the mean bias is taken
# share of a point's noise, rms of such means by noise alone, as measured at spacings of 1/4 to 1 subset
_BY_NOISE = 0.05
_WHOLE = 0.01  # share of the usual noise of a bend: between the nearest neighbours to both sides
_CHANCE = 4.0  # multiple of its scatter over so many windows as the field holds


class LocalBias(NamedTuple):
    """Bias of n plane patches' displacements.

    Attributes
    ----------
    change
        (n, 4) of w0, G00, G10, G20 by the bend; zero if it is not known.
    share
        (n,) the largest of the displacement's biases along camera 1's axes, over its standard deviation by noise.
    noise
        (n,) standard deviation of ``share`` by noise.
    off
        (n, 3) biases of displacements along camera 1's axes, mm.
    variance
        (n, 3) of these displacements by noise, mm^2.
    """

    change: Float
    share: Float
    noise: Float
    off: Float
    variance: Float


def local_bias(
    points: PointFits, *, shape: tuple[int, int], rays: Float, spacing_px: float, subset_px: int
) -> LocalBias | None:
    """Estimate the bias of each plane patch of a motion.

    Parameters
    ----------
    points
        n = rows x columns points of a motion with their covariances; bends are taken from the plane terms alone.
    shape
        Rows and columns.
    rays
        (n, 3) normalised.
    spacing_px, subset_px
        Distance of the points and width of the subset, px.

    Returns
    -------
    LocalBias or None
        None if neighbours are too far away.
    """
    k = max(1, round(0.5 * subset_px / spacing_px))
    if k * spacing_px > _FAR_SUBSETS * subset_px or min(shape) < 3 * k + 1 or not points.ok.any():
        return None
    second_moment = (subset_px**2 - 1) / 24.0
    ok = points.ok
    change, noise2 = np.zeros((len(ok), 4)), np.zeros(len(ok))
    for axis in (0, 1):
        px = float(np.median(np.diff(rays[:, axis].reshape(shape), axis=1 - axis))) / spacing_px
        for q in range(4):
            slope = (points.w if q == 0 else points.G[:, q - 1])[:, 1 + axis]
            bend, reach = _bend(np.where(ok, slope, np.nan).reshape(shape), k, 1 - axis)
            change[:, q] += second_moment * px / spacing_px * bend.ravel()
        of_slope = _SLOPE_OVER_LEVEL / subset_px
        noise2 += 2.0 * (second_moment * of_slope / np.maximum(spacing_px * reach.ravel(), 1.0)) ** 2
    off, variance = _displaced(points, rays, change)
    # rejected neighbours count with a usual point's noise
    variance = np.where(ok[:, None], variance, np.median(variance[ok], axis=0))
    return LocalBias(change, _share(off, variance), np.sqrt(noise2), off, variance)


def mean_bias(
    bias: LocalBias, known: Bool, *, shape: tuple[int, int], spacing_px: float, subset_px: int
) -> Float | None:
    """Return the mean of biases about each of the ``known`` points, mm (n, 3), zero for the others.

    None if noise alone may be all of it.
    """
    if not known.any():
        return None
    k = max(1, round(_SMOOTH_SUBSETS * subset_px / spacing_px))
    # a bend over a gap may be a crack's, one of a single side is a border's
    whole = (known & (np.abs(bias.noise / np.median(bias.noise[known]) - 1.0) < _WHOLE))[:, None]
    both = np.concatenate([np.where(whole, bias.off, 0.0), whole], axis=1).reshape(*shape, 4)
    summed = cv2.boxFilter(both, -1, (2 * k + 1,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
    off, count = np.split(np.asarray(summed, np.float64).reshape(-1, 4), [3], axis=1)
    mean = np.where(known[:, None] & (count > 0.5), off / np.maximum(count, 1.0), 0.0)
    windows = known.sum() / (2 * k + 1) ** 2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # images without noise have no variance
        rms = np.sqrt(np.nan_to_num(mean[known] ** 2 / bias.variance[known]).mean(axis=0).max())
    return mean if rms > _BY_NOISE * (1.0 + _CHANCE / np.sqrt(windows)) else None


def without(points: PointFits, bias: LocalBias, mean: Float) -> LocalBias:
    """Return the remaining biases after ``mean`` (n, 3) is subtracted."""
    change, off = bias.change.copy(), bias.off - mean
    change[:, 1:] -= np.where(points.ok, points.w[:, 0], 0.0)[:, None] * mean
    return bias._replace(change=change, off=off, share=_share(off, bias.variance))


def take_off(points: PointFits, mean: Float) -> float:
    """Take biases (n, 3) off the displacements of plane patches, in place; return their rms, mm."""
    index = np.flatnonzero(points.ok & points.plane)
    points.G[index, :, 0] -= points.w[index, :1] * mean[index]
    return float(np.sqrt((mean[index] ** 2).sum(axis=1).mean()))


def _share(off: Float, variance: Float) -> Float:
    """Return (n,) the largest of biases (n, 3) over their standard deviations; images without noise have none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.nan_to_num(off**2 / variance).max(axis=1)))


def _displaced(points: PointFits, rays: Float, change: Float) -> tuple[Float, Float]:
    """Displacements, mm (n, 3), for a ``change`` (n, 4) of w0, G00, G10, G20, and their variances by noise.

    Points without numbers count as the median point.
    """
    ok = points.ok
    w = np.where(ok, points.w[:, 0], np.median(points.w[ok, 0]))[:, None]
    moved = points.G[:, :, 0] - rays
    by_w = -np.where(ok[:, None], moved, np.median(moved[ok], axis=0)) / w**2
    C = points.covariance
    variance = np.stack([C[:, i, i] for i in (1, 2, 3)], axis=1) / w**2 + by_w**2 * C[:, :1, 0]
    return change[:, 1:] / w + by_w * change[:, :1], variance + 2.0 * by_w * C[:, 0, 1:4] / w


def change_of_bend(
    points: PointFits,
    *,
    shape: tuple[int, int],
    rays: Float,
    spacing_px: float,
    subset_px: int,
    widths_px: NDArray[np.intp] | None = None,
) -> LocalBias | None:
    """Return the difference of the bends of curved patches of a motion from those about them, as a plane patch's bias.

    A kink within the subset bends its curved patch, but not those about it: the patch's error is then up to this bias.
    With smooth strain the error is a tenth of it, and less. Parameters are as in :func:`local_bias`, with the points'
    own widths (n,) where some are narrower; None without curved patches.
    """
    k = max(1, round(_ASIDE * subset_px / spacing_px))
    curved = points.ok & ~points.plane
    if points.w.shape[1] < 6 or not curved.any() or min(shape) < 2 * k + 1:
        return None
    bend = np.zeros((len(curved), 4))
    width2 = subset_px**2 if widths_px is None else widths_px**2
    for axis, term in ((0, 3), (1, 5)):
        px = float(np.median(np.diff(rays[:, axis].reshape(shape), axis=1 - axis))) / spacing_px
        for q in range(4):
            bend[:, q] += (width2 - 1) / 12.0 * px**2 * (points.w if q == 0 else points.G[:, q - 1])[:, term]
    known = np.where(points.ok[:, None], bend, np.nan).reshape(*shape, 4)
    change, share = np.zeros((len(curved), 4)), np.zeros(len(curved))
    for axis in (0, 1):
        here = np.moveaxis(known, axis, 0)
        there = np.full((2, *here.shape), np.nan)
        there[0, k:], there[1, :-k] = here[:-k], here[k:]
        count = np.isfinite(there).sum(axis=0)
        mean = np.where(np.isfinite(there), there, 0.0).sum(axis=0) / np.maximum(count, 1)
        other = np.moveaxis(np.where(count > 0, here - mean, 0.0), 0, axis).reshape(-1, 4)
        off, variance = _displaced(points, rays, np.where(curved[:, None], other, 0.0))
        found = np.where(curved, _share(off, variance), 0.0)
        change[found > share] = other[found > share]
        share = np.maximum(share, found)
    return LocalBias(change, share, np.full(len(share), _CURVED_NOISE), *_displaced(points, rays, change))


def worth_curving(
    points: PointFits, bias: LocalBias, *, shape: tuple[int, int], spacing_px: float, subset_px: int
) -> Bool:
    """Return (n,) True for points about places where curved patches have less error in all, a subset's half around."""
    mean = mean_bias(bias, points.ok & points.plane, shape=shape, spacing_px=spacing_px, subset_px=subset_px)
    if mean is not None:  # subtracting it costs less noise
        bias = bias._replace(share=np.minimum(bias.share, without(points, bias, mean).share))
    chosen = _grown(bias, _WORTH, _AS_WELL, shape)
    if not chosen.any():
        return chosen.ravel()
    width = 2 * max(1, round(0.5 * subset_px / spacing_px)) + 1
    return np.asarray(cv2.dilate(chosen.astype(np.uint8), np.ones((width, width), np.uint8))).ravel() > 0


def _grown(bias: LocalBias, share: float, beside: float, shape: tuple[int, int]) -> Bool:
    """(r, c) True in connected places above ``beside`` times the noise that contain a point above ``share``."""
    sure = (bias.share > np.maximum(share, _SURELY * bias.noise)).reshape(shape)
    about = sure | (bias.share > np.maximum(beside, _BESIDE * bias.noise)).reshape(shape)
    label = cv2.connectedComponents(about.astype(np.uint8), connectivity=8)[1]
    size = np.bincount(label[about], minlength=int(label.max()) + 1)
    known = np.zeros(len(size), bool)
    known[label[sure]] = True
    return np.asarray((known & (size >= _AT_LEAST))[label] & about)


def state_bias(points: PointFits, bias: LocalBias, shape: tuple[int, int]) -> None:
    """Add the bias of plane patches to their covariances, in place, if it counts."""
    _add(points, points.plane & _grown(bias, _COUNTS, _COUNTS, shape).ravel(), bias.change)


def state_change(points: PointFits, bend: LocalBias) -> None:
    """Add to curved patches' covariances, in place, the error that a kink may cause."""
    with np.errstate(divide="ignore"):
        beyond = np.sqrt(np.maximum(1.0 - (_BEYOND * bend.noise / bend.share) ** 2, 0.0))
    kept = beyond[:, None] * bend.change
    _add(points, beyond > 0.0, _OF_A_KINK * kept)
    # and the error in the other directions
    across = _ACROSS * np.linalg.norm(kept[:, 1:], axis=1)
    points.covariance[:, range(1, 4), range(1, 4)] += np.where(points.ok, across, 0.0)[:, None] ** 2


def _add(points: PointFits, which: Bool, change: Float) -> None:
    index = np.flatnonzero(which & points.ok)
    points.covariance[index, :4, :4] += change[index, :, None] * change[index, None, :]


def _bend(slope: Float, k: int, axis: int) -> tuple[Float, Float]:
    """(r, c) change of a slope per point along an axis, between the nearest known points up to 3 k to each side.

    The point itself replaces a missing side, as at a border; zero if no two are known. The second result is the
    distance of these points, in points.
    """
    here = np.moveaxis(slope, axis, 0)
    at, value = np.zeros((2, *here.shape)), np.stack([here, here])
    for far in (3 * k, 2 * k, k):
        for side, to, beside in ((0, slice(far, None), slice(None, -far)), (1, slice(None, -far), slice(far, None))):
            known = np.isfinite(here[beside])
            value[side][to] = np.where(known, here[beside], value[side][to])
            at[side][to] = np.where(known, far, at[side][to])
    reach = at.sum(axis=0)
    bend = np.nan_to_num((value[1] - value[0]) / np.maximum(reach, 1.0))
    return np.moveaxis(bend, 0, axis), np.moveaxis(reach, 0, axis)
