"""Keypoints of stretched copies of an image, for matches over strains and tilts too large for SIFT.

SIFT finds a point again at any scale and angle, but not under a stretch of one direction by more than a third or so. A
few stretched copies of the reference (after Morel and Yu 2009, ASIFT, doi:10.1137/080732730) bring one of them near
enough.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.points.features import Box, Features, detect, reduced, with_rim

_RATIO = 1.75  # ratio of the axes: half of it or twice it is still matched
_DIRECTIONS = 4


def stretches() -> list[Float]:
    """Return stretches (2, 2) in four directions, each keeping areas."""
    long = np.sqrt(_RATIO)
    out = []
    for k in range(_DIRECTIONS):
        angle = np.pi * k / _DIRECTIONS
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        out.append(turn @ np.diag([long, 1.0 / long]) @ turn.T)
    return out


def stretched_features(image: NDArray[Any], box: Box, stretch: Float, *, scale: int = 1) -> Features:
    """Return the keypoints (at their positions in ``image``) that its stretched copy has in ``box``.

    Parameters
    ----------
    image
        (rows, cols) grey levels of any depth.
    box
        (x0, y0, x1, y1), half open.
    stretch
        (2, 2) from the image's to the copy's coordinates.
    scale
        Work at a ``scale``-th of the size.
    """
    x0, y0, x1, y1 = with_rim((image.shape[0], image.shape[1]), box, scale)
    small = reduced(image[y0:y1, x0:x1], scale).astype(np.float32)
    corners = np.array([(0, 0), (small.shape[1], 0), (0, small.shape[0]), small.shape[::-1]], float) @ stretch.T
    low = corners.min(axis=0)
    width, height = (int(n) for n in np.ceil(corners.max(axis=0) - low))
    copy = cv2.warpAffine(
        small,
        np.column_stack([stretch, -low]),
        (width, height),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float(small.mean()),
    )
    found = detect(np.asarray(copy))
    inner = (found.xy_px + low) @ np.linalg.inv(stretch).T
    xy = (inner + 0.5) * scale - 0.5 + np.array([x0, y0])
    inside = (xy >= box[:2]).all(axis=1) & (xy <= np.array(box[2:]) - 1).all(axis=1)
    return Features(xy[inside], np.ascontiguousarray(found.descriptors[inside]), scale)
