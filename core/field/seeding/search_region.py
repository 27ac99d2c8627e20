"""Boxes of the images in which features are searched for, and the scales at which the images are reduced."""

from __future__ import annotations

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.features import Box
from stereorig.core.field.seeding.epipolar_search import DEPTH_SPAN, nominal_depth

# pixels of an image: a few thousand keypoints on a fine texture, in a quarter of a second
_COMFORTABLE_PIXELS = 800_000
_MIN_PIXELS = 100_000  # pixels of the region: some hundred keypoints
_MAX_PIXELS = 8_000_000  # pixels of an image at the first scale
_HALF_FROM_PIXELS = 60_000  # pixels of the region
_ALONG_A_SIDE = 9
_DEPTHS = 400
_MARGIN_PX = 32


def box_around(xy_px: Float, reach_px: float, shape: tuple[int, int]) -> Box:
    """Return the box about points (n, 2) and ``reach_px`` around them, within an image of (rows, cols)."""
    rows, cols = shape
    x0, y0 = np.maximum(np.floor(xy_px.min(axis=0) - reach_px), 0)
    x1, y1 = np.ceil(xy_px.max(axis=0) + reach_px) + 1
    return int(x0), int(y0), min(int(x1), cols), min(int(y1), rows)


def seen_by_camera2(pair: StereoPair, box: Box, shape2: tuple[int, int]) -> Box:
    """Return the box of camera 2's image (rows, cols) that can show camera 1's box, at any depth that is searched."""
    rows, cols = shape2
    whole = (0, 0, cols, rows)
    x0, y0, x1, y1 = box
    s = np.linspace(0.0, 1.0, _ALONG_A_SIDE)
    corners = np.array([(x0, y0), (x1 - 1, y0), (x1 - 1, y1 - 1), (x0, y1 - 1)], dtype=np.float64)
    rim = np.concatenate([a + s[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    depth = nominal_depth(pair) * np.geomspace(1.0 / DEPTH_SPAN, DEPTH_SPAN, _DEPTHS)
    xy = pair.image2_at_depth(rim[:, None], depth[None])
    with np.errstate(invalid="ignore"):
        seen = (xy[..., 0] >= 0) & (xy[..., 1] >= 0) & (xy[..., 0] <= cols - 1) & (xy[..., 1] <= rows - 1)
    both = seen[:, 1:] & seen[:, :-1]
    if not both.any():
        return whole
    # between two depths, and from the last one inside to the border, there is a step at most
    gap = np.linalg.norm(np.diff(xy, axis=1), axis=-1)[both].max() + (x1 - x0 + y1 - y0) / (8 * _ALONG_A_SIDE)
    return box_around(xy[seen], float(gap) + _MARGIN_PX, shape2)


def scales(boxes: tuple[Box, Box], shapes: tuple[tuple[int, int], tuple[int, int]]) -> list[int]:
    """Return the factors by which the images are reduced, to be tried one after the other; the last is 1.

    Parameters
    ----------
    boxes
        Boxes in which features are searched for, of camera 1's and camera 2's reference images.
    shapes
        Rows and columns of both cameras' images.
    """
    area = [(x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in boxes]
    comfortable = int(np.ceil(np.sqrt(sum(area) / 2.0 / _COMFORTABLE_PIXELS)))
    first = min(comfortable, int(np.sqrt(area[0] / _MIN_PIXELS)))
    first = max(first, 1, int(np.ceil(np.sqrt(max(r * c for r, c in shapes) / _MAX_PIXELS))))
    out = [first]
    while out[-1] > 1:
        out.append(out[-1] // 2)
    return out


def half_serves(boxes: tuple[Box, Box], shapes: tuple[tuple[int, int], tuple[int, int]]) -> bool:
    """Return True if images that :func:`scales` would not reduce may be tried at half their size first.

    SIFT doubles an image before it looks for features, and speckles of 3 px and more show at half their size, in a
    quarter of the time.
    """
    x0, y0, x1, y1 = boxes[0]
    return scales(boxes, shapes) == [1] and (x1 - x0) * (y1 - y0) >= _HALF_FROM_PIXELS
