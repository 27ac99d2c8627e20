"""Points beside the end of the surface whose own position shows nothing: the patch there is the rim, extended.

Beside a hole or behind an outline before a plain background a subset matches by the part that lies on the surface. Its
centre, which the result is for, may lie where there is no surface.
"""

from __future__ import annotations

import cv2
import numpy as np

from core.arrays import Bool, Float
from core.field.points.fitter import PointFits
from core.status import PointStatus

CENTRE = 1.0 / 3.0
"""Width of what counts as a subset's centre, over the subset's."""
_NOISE = 4.0  # variances of the noise: what a plain centre shows at most
_TEXTURE = 0.02  # of the subset's variance


def centre_px(subset_px: int) -> int:
    """Return the width of a subset's centre, odd."""
    return max(int(CENTRE * subset_px) | 1, 5)


def reject_blank_centres(
    points: PointFits,
    *,
    shape: tuple[int, int],
    texture: Float,
    centre_texture: Float,
    subset_px: int,
    spacing_px: float,
) -> int:
    """Reject points, LOW_TEXTURE, within a subset of points without a match whose centre is plain; return their number.

    Parameters
    ----------
    points
        n = rows x columns points of a shape, changed in place.
    shape
        Rows and columns.
    texture, centre_texture
        (n,) grey-level variance of the subset and of its centre, camera 1's reference image.
    subset_px, spacing_px
        Width of the subset, distance of neighbouring points.
    """
    beside = _beside_gaps(points.ok, shape, subset_px / spacing_px)
    noise = np.nan_to_num(points.noise) ** 2 + 1.0 / 12.0  # rounding's, too
    plain = (centre_texture < _NOISE * noise) & (centre_texture < _TEXTURE * texture)
    bad: Bool = points.ok & beside & plain
    points.reject(bad, PointStatus.LOW_TEXTURE)
    return int(bad.sum())


def _beside_gaps(ok: Bool, shape: tuple[int, int], reach: float) -> Bool:
    side = 2 * int(np.ceil(reach)) + 1
    gaps = (~ok.reshape(shape)).astype(np.uint8)
    return np.asarray(cv2.dilate(gaps, np.ones((side, side), np.uint8)).ravel() > 0)
