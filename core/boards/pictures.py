"""An image's eight-bit pictures at the scales at which targets are looked for."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float, Float32

COARSE_SIDE_PX = 1000  # searches are slow on large pictures, and most boards are found at this side
FINE_SIDE_PX = 2200


class Pictures:
    """Eight-bit pictures of one image.

    Attributes
    ----------
    grey
        (rows, columns) the image.
    size_px
        Columns, rows.
    """

    def __init__(self, grey: Float32) -> None:
        self.grey = grey
        self.size_px = (grey.shape[1], grey.shape[0])
        few = grey[::4, ::4] if grey.size > 1_000_000 else grey
        low, high = np.percentile(few, [0.5, 99.5])
        self._low, self._scale = float(low), 255.0 / max(float(high - low), 1e-9)
        self._kept: dict[int, tuple[NDArray[np.uint8], float]] = {}

    def reduced(self, side_px: int) -> tuple[NDArray[np.uint8], float]:
        """Return the picture with a longer side of about ``side_px``, and the image's pixels per pixel of it."""
        if side_px not in self._kept:
            # whole blocks of pixels, so that the picture's own pixels are at the factor's positions
            factor = max(round(max(self.size_px) / side_px), 1)
            size = (self.size_px[0] // factor, self.size_px[1] // factor)
            picture = self.grey[: size[1] * factor, : size[0] * factor]
            if factor > 1:
                picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
            eight = np.clip((picture - self._low) * self._scale, 0.0, 255.0).astype(np.uint8)
            self._kept[side_px] = eight, float(factor)
        return self._kept[side_px]

    def scales(self, most: int = 3) -> Iterator[tuple[NDArray[np.uint8], float]]:
        """Yield ``most`` pictures to search in turn, the smallest first, each with the image's pixels per pixel.

        Each is made when it is asked for: the full one costs as much as a search in the smallest.
        """
        for side in (COARSE_SIDE_PX, FINE_SIDE_PX, max(self.size_px))[:most]:
            picture, factor = self.reduced(side)
            yield picture, factor
            if factor == 1.0:
                return


def full_scale(xy: NDArray[np.floating], factor: float) -> Float:
    """Return positions in the image from those in a picture reduced by ``factor``."""
    return (np.asarray(xy, dtype=np.float64) + 0.5) * factor - 0.5
