"""Scale of camera 1's image where the surface is, before anything is measured: from feature matches of a pair."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.images import MeasureImage, features_of
from stereorig.core.field.seeding.scattered_matches import scattered_shape
from stereorig.core.field.seeding.search_region import scales

_MIN_MATCHES = 12


@dataclass(frozen=True)
class ImageScale:
    """Scale of camera 1's image at the surface.

    Attributes
    ----------
    mm_per_px
        Across the line of sight, at the median depth of the matches: a slanted surface is stretched by 1 / cos(slant).
    distance_mm
        That depth, along camera 1's optical axis.
    matches
        Matches with camera 2 that it comes from.
    """

    mm_per_px: float
    distance_mm: float
    matches: int


def image_scale(pair: StereoPair, image1: MeasureImage, image2: MeasureImage) -> ImageScale | None:
    """Return the scale of camera 1's image at the surface that both cameras see; None with too few matches.

    Raises
    ------
    ImageError
        ``cameras_swapped``.
    """
    (rows, cols), (rows2, cols2) = image1.shape, image2.shape
    boxes = (0, 0, cols, rows), (0, 0, cols2, rows2)
    scale = scales(boxes, (image1.shape, image2.shape))[0]
    shape = scattered_shape(pair, *features_of([(image1, boxes[0]), (image2, boxes[1])], scale))
    if len(shape.xy_px) < _MIN_MATCHES:
        return None
    depth_mm = float(1.0 / np.median(shape.w0))
    x, y = np.median(shape.xy_px, axis=0)
    around = np.array([[x - 0.5, y], [x + 0.5, y], [x, y - 0.5], [x, y + 0.5]])
    at = pair.cam1.back_project_at_depth(around, np.full(4, depth_mm)).xyz_mm
    sides = np.linalg.norm(at[[1, 3]] - at[[0, 2]], axis=1)
    return ImageScale(float(np.sqrt(sides[0] * sides[1])), depth_mm, len(shape.xy_px))
