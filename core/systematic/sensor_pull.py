"""Effect of a sensor's fixed columns and rows on a motion: they stay while the specimen moves, and pull matches back.

The reference's gradients hold the slopes of its own fixed pattern, and camera 1's current image shows that pattern
again, at the same pixels. A match is therefore drawn towards no motion, all points of a field alike: it is no noise,
averages do not reduce it, and the residuals of points do not show it. Pixels that are far apart along a column share no
texture, but the same column: their covariance, from the reference to the current image, is the fixed pattern's alone,
for any motion of the specimen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.derivatives import Estimator
from stereorig.core.field.points.result import Field
from stereorig.core.matching.defects import MIN_LINES, SURE, box_about, line_covariance, strips_along
from stereorig.core.matching.filters import prefilter
from stereorig.core.matching.image import ImageData
from stereorig.core.matching.odd_filters import REACH

_MIN_SHARE = 0.02  # share of the pixels' noise variance: lines below it move a field by less than its mean's noise
_STILL = 0.6  # share of a pixel in the value interpolated half a pixel from it
# share of the lines' variance: sensors with fixed lines have it (EMVA 1288 states both) in about this size
_ASSUMED = 0.5
_REACH_PX = 6.0  # limit on a displacement: beyond it neither spline nor gradients see the pattern at the old place


@dataclass(frozen=True, eq=False)
class FixedLines:
    """Fixed columns and rows of a camera, and their effect on a motion.

    Attributes
    ----------
    columns_grey2, rows_grey2
        Their variances, grey levels squared; 0 if they are not significant.
    pixels_grey2
        Variance of a fixed pattern from pixel to pixel in addition, from the excess noise of camera 2's view at the
        reference over camera 1's own later one, in which the pattern cancels; half the lines' if all points moved too
        far for that.
    pull_mm
        (r, c, 3) shift of U, V, W by them, system frame; NaN at points without a motion.
    """

    columns_grey2: float
    rows_grey2: float
    pixels_grey2: float
    pull_mm: Float

    def document(self) -> dict[str, float]:
        """Return standard deviations, grey levels, and the field's mean pull, um, as plain values."""
        mean = 1e3 * np.nanmean(self.pull_mm, axis=(0, 1))
        return {
            "columns_grey": float(np.sqrt(self.columns_grey2)),
            "rows_grey": float(np.sqrt(self.rows_grey2)),
            "pixels_grey": float(np.sqrt(self.pixels_grey2)),
            **{f"pull_{name}_um": float(mean[k]) for k, name in enumerate("uvw")},
        }


def fixed_lines(
    field: Field, pair: StereoPair, reference: ImageData, current: ImageData, *, subset_px: int
) -> FixedLines | None:
    """Find the fixed columns and rows that camera 1 shows in both images, and their pull; None without any.

    Parameters
    ----------
    field
        A motion, matched against ``reference``.
    pair
        The cameras.
    reference, current
        Camera 1's images, as they were matched.
    subset_px
        Width of the subset.
    """
    slopes, valid = reference.slopes, field.valid
    if field.uvw_mm is None or field.references is not None or slopes is None or not valid.any():
        return None
    at = np.stack([field.x_px[valid], field.y_px[valid]], axis=-1)
    points = field.xyz_mm[valid]
    now = points + field.uvw_mm[valid]
    moved = pair.cam1.project(now).xy - at
    near = np.abs(moved) < _REACH_PX
    box = box_about(at, subset_px, reference.shape)
    least = _MIN_SHARE * float(np.nanmedian(field.noise_grey)) ** 2
    shift = np.median(moved, axis=0)
    variances = [0.0, 0.0]
    for axis in range(2):  # columns, whose place moves along x, then rows
        if near[:, axis].any():
            one, two = (strips_along(image.raw[box], axis) for image in (reference, current))
            found, sd = line_covariance(one, two, float(shift[1 - axis]))
            variances[axis] = found if found > max(SURE * sd, least) else 0.0
    if not any(variances):
        return None
    seen = [_interpolated(moved[:, axis], reference.order) for axis in range(2)]  # (n, 7) of the pixels about
    noise2 = field.noise_grey[valid] ** 2
    pixels = _pixels(field.zncc[valid], noise2, variances, seen)
    slope = np.empty((len(at), 2))
    for axis, taps in enumerate((slopes.along_x, slopes.along_y)):
        slope[:, axis] = variances[axis] * seen[axis] @ taps.sum(axis=axis)
        slope[:, axis] += pixels * np.einsum("ni,ij,nj->n", seen[1], taps, seen[0])
    px = -np.linalg.solve(_sensitivity(reference, at, subset_px), slope[..., None])[..., 0]
    by_match = Estimator.at(pair, points, now).by_match
    assert by_match is not None
    pull = np.full((*field.shape, 3), np.nan)
    pull[valid] = (by_match[:, :, 2:4] @ px[..., None])[..., 0]
    return FixedLines(variances[0], variances[1], pixels, pull)


def _sensitivity(reference: ImageData, at: Float, subset_px: int) -> Float:
    """(n, 2, 2) mean products of the gradients over the points' subsets."""
    gx, gy = reference.gradients
    y, x = (np.clip(np.rint(at[:, k]).astype(int), 0, reference.shape[1 - k] - 1) for k in (1, 0))
    out = np.empty((len(at), 2, 2))
    for (i, j), product in (((0, 0), gx * gx), ((0, 1), gx * gy), ((1, 1), gy * gy)):
        mean = cv2.boxFilter(product, cv2.CV_32F, (subset_px, subset_px))
        out[:, i, j] = out[:, j, i] = np.asarray(mean)[y, x]
    return out


@cache
def _cardinal(order: int) -> tuple[Float, Float]:
    """Places and values of the spline through a single 1."""
    place = np.linspace(-_REACH_PX - 4.0, _REACH_PX + 4.0, 1281)
    taps = prefilter(order)
    reach = len(taps) // 2
    value = np.zeros_like(place)
    for k, weight in enumerate(taps):
        value += weight * _b_spline(place - (k - reach), order)
    return place, value


def _b_spline(x: Float, order: int) -> Float:
    if order == 0:
        return np.where((x >= -0.5) & (x < 0.5), 1.0, 0.0)
    half = 0.5 * (order + 1)
    return np.asarray(((half + x) * _b_spline(x + 0.5, order - 1) + (half - x) * _b_spline(x - 0.5, order - 1)) / order)


def _interpolated(moved_px: Float, order: int) -> Float:
    """(n, 7) share of each pixel about the old place in a spline's value at this distance from it, along one axis."""
    place, value = _cardinal(order)
    return np.interp(moved_px[:, None] - np.arange(-REACH, REACH + 1), place, value)


def _pixels(zncc: Float, noise2: Float, lines: list[float], seen: list[Float]) -> float:
    """Variance of a fixed pattern from pixel to pixel."""
    x, y = (one[:, REACH] for one in seen)
    still = (x > _STILL) & (y > _STILL) & (zncc[:, 1] < 1.0)
    if still.sum() < MIN_LINES:
        return _ASSUMED * sum(lines)
    more = noise2 * ((1.0 - zncc[:, 0]) / np.where(still, 1.0 - zncc[:, 1], 1.0) - 1.0)
    found = (more - lines[0] * x - lines[1] * y) / (x * y)
    return max(float(np.median(found[still])), 0.0)
