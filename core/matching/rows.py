"""Images prepared for matching in some of their rows alone: what a part of a field's points needs.

The rows are filtered as those of the whole image are, so that a match inside them is the same to the last bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.arrays import Float32
from core.matching.image import PAD, ImageData, coefficients_in, mirror_padding
from core.matching.odd_filters import REACH
from core.matching.slopes import SlopeFilter

_EDGE = 24
"""Rows of NaN about the coefficients: a fit's step moves no pixel that far, so none gets past them."""


def prepare_rows(pixels: NDArray[Any], order: int, first: int, last: int) -> ImageData:
    """Return an image with its coefficients in rows ``first`` to ``last`` alone: no subset that leaves them matches.

    Parameters
    ----------
    pixels
        (rows, cols) grey levels, checked; they are not copied.
    order
        3 or 5.
    first, last
        First row, and one past the last one, inside the image.
    """
    rows, cols = pixels.shape
    padded = np.zeros((rows + 2 * PAD, cols + 2 * PAD), np.float32)  # rows that nobody reads take no memory
    inner = padded[PAD:-PAD, PAD:-PAD]
    inner[max(first - _EDGE, 0) : last + _EDGE] = np.nan
    inner[first:last] = coefficients_in(pixels, order, (0, first, cols, last))
    mirror_padding(padded, max(first - _EDGE, 0), min(last + _EDGE, rows))
    return ImageData(padded, pixels, order)


def reference_rows(pixels: NDArray[Any], order: int, slopes: SlopeFilter, first: int, last: int) -> ImageData:
    """Return a reference image with grey levels and gradients in rows ``first`` to ``last`` alone.

    ``slopes`` is the whole image's own filter. The other rows are zero: a reference's subsets stay where they are.
    """
    top = max(first - REACH, 0)
    here = slice(first - top, last - top)
    found = slopes.apply(pixels[top : last + REACH])
    kept = {"pixels": pixels[first:last].astype(np.float32), "x": found[0][here], "y": found[1][here]}
    whole: dict[str, Float32] = {name: np.zeros(pixels.shape, np.float32) for name in kept}
    for name, values in kept.items():
        whole[name][first:last] = values
    image = ImageData(np.zeros((1, 1), np.float32), pixels, order)
    # what would be computed from the whole image on first use
    image.__dict__.update(pixels=whole["pixels"], gradients=(whole["x"], whole["y"]), slopes=slopes)
    return image
