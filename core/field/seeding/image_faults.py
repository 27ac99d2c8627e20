"""Faults of a picture that keep a match from being sure: blur, saturation, a raw colour mosaic, a pattern that repeats.

Searched for only after a failure; rows that were not exposed together are looked for in every step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import MeasurementError
from stereorig.core.field.points.features import Box
from stereorig.core.field.points.images import MeasureImage
from stereorig.core.field.points.result import Unsure
from stereorig.core.field.seeding.search_region import seen_by_camera2
from stereorig.core.settings import DEFAULT_MAX_SIGMA_PX, MAX_SIGMA_PX, SUBSET_PX

_FINE_PX, _COARSE_PX = 1.0, 16.0  # between noise and shading
_BLUR_PX = 0.7  # from which on it costs a match more than a tenth
_SATURATED = 0.05  # share of an image
_SURE = 0.6  # share of the limit for a subset that is proposed
_TILE_PX = 256  # across which a view changes a lattice's period by less than a bin
_WAVES = 8.0  # waves across a tile, at least, of a repeating period: fewer are no peak
_PEAK = 0.12  # share of a tile's power in one peak: speckle has a third of it, dots on a lattice a fifth and more
_CHECKED = 0.02  # share of the mean: sensors' own pixels differ by a tenth of it
_CHECKED_SE = 8.0
_ROW_PAIRS = 64
_MOST_SHIFT_PX = 24
_ROWS_ALIKE = 0.3  # correlation of rows that show one texture: without one they have no shift
INTERLACED_PX = 0.3
"""Shift from which on an image counts as interlaced: rows of speckle scatter by a tenth of it."""
Pixels = NDArray[Any]


def unsure_error(
    whose: str,
    pair: StereoPair,
    reference: tuple[MeasureImage, MeasureImage],
    current: Sequence[MeasureImage],
    unsure: Unsure,
    *,
    subset_px: int,
    region_px: tuple[float, float, float, float],
) -> MeasurementError:
    """Return the error of a field whose matches are too uncertain, with figures, causes and remedies.

    Parameters
    ----------
    whose
        The field's name in the text, as ``the frame``.
    pair
        The calibrated cameras.
    reference, current
        Both cameras' images; ``current`` is empty for a shape.
    unsure
        Standard deviation found, and the limit.
    subset_px
        Width of the subsets.
    region_px
        (x0, y0, x1, y1) of camera 1's reference image.
    """
    one, two = reference
    x0, y0, x1, y1 = (round(v) for v in region_px)
    box1: Box = max(x0, 0), max(y0, 0), min(x1 + 1, one.shape[1]), min(y1 + 1, one.shape[0])
    boxes = box1, seen_by_camera2(pair, box1, two.shape)
    before, now = (
        [_part(image, box) for image, box in zip(images, boxes, strict=True)]
        for images in (reference, current or reference)
    )
    causes = []
    for k, name in enumerate(("camera 1", "camera 2")):
        share = float((now[k] >= now[k].max()).mean())
        if share > _SATURATED:
            causes.append(f"{100.0 * share:.0f} % of {name}'s image is saturated")
        others = [(before[k], "its reference image")] * bool(current) + [(now[1 - k], f"camera {2 - k}")]
        blurs = [(blur_px(other, now[k]), text) for other, text in others]
        sd, than = max(blurs)
        if sd > _BLUR_PX:
            causes.append(f"{name}'s image is blurred by about {sd:.1f} px against {than}")
    wider = 2 * math.ceil((subset_px * unsure.usual_px / (_SURE * unsure.limit_px) - 1.0) / 2.0) + 1
    more = min(
        max(1.5 * unsure.usual_px, 1.2 * DEFAULT_MAX_SIGMA_PX), MAX_SIGMA_PX
    )  # above the default it holds for all
    there = f"{unsure.usual_px * subset_px / wider:.2g} px"
    better = f"take subsets of {wider} px, which give about {there}, or " if wider <= SUBSET_PX.high else ""
    why = (
        f"the points match with a standard deviation of {unsure.usual_px:.3f} px (median; in depth too), the limit is "
        f"{unsure.limit_px:.3g} px" + (f": {' and '.join(causes)}" if causes else "")
    )
    return MeasurementError(
        f"No point of {whose} could be measured: {why}.",
        code="sigma_too_large",
        remedy=f"Put right focus and exposure, {better}allow more: --max-sigma {more:.2g} (max_sigma_px).",
    )


def _part(image: MeasureImage, box: Box) -> Pixels:
    x0, y0, x1, y1 = box
    return image.pixels[y0:y1, x0:x1]


def blur_px(sharp: Pixels, soft: Pixels) -> float:
    """Return the Gaussian's standard deviation that would make one image as soft as the other; 0: none.

    The texture's width follows from the mean squared gradient over the variance; a Gaussian adds to its square.
    Structure finer than a pixel, as noise, and coarser than a subset, as shading, is left out of both.
    """
    widths = []
    for image in (sharp, soft):
        fine = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _FINE_PX)
        texture = fine - cv2.GaussianBlur(fine, (0, 0), _COARSE_PX)
        down, right = np.gradient(texture)
        widths.append(float(np.mean(texture**2)) / max(float(np.mean(down**2 + right**2)), 1e-12))
    return math.sqrt(max(widths[1] - widths[0], 0.0))


def period_px(pixels: Pixels) -> float | None:
    """Return the period of a texture that repeats itself over the image; None of any other.

    A lattice has its power in peaks, also where the dots are off their places by a tenth of the period.
    """
    rows, cols = pixels.shape
    side = min(_TILE_PX, rows, cols)
    window = np.outer(np.hanning(side), np.hanning(side))
    found = []
    for top in range(0, max(rows - side, 0) + 1, side):
        for left in range(0, max(cols - side, 0) + 1, side):
            tile = pixels[top : top + side, left : left + side].astype(np.float64)
            tile = (tile - cv2.GaussianBlur(tile, (0, 0), _COARSE_PX)) * window
            power = np.abs(np.fft.rfft2(tile)) ** 2
            total = float(power.sum())
            peaks = cv2.boxFilter(power, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
            r, c = np.unravel_index(int(np.argmax(peaks)), peaks.shape)
            wave = math.hypot(min(int(r), side - int(r)), int(c))
            found.append((peaks[r, c] / total if wave >= _WAVES else 0.0, side / max(wave, 1.0)))
    if float(np.median([share for share, _ in found])) < _PEAK:
        return None
    return float(np.median([period for _, period in found]))


def mosaic_share(pixels: Pixels) -> float | None:
    """Return how far pixels of unlike colours differ in a raw Bayer mosaic, over the mean; None of a grey image."""
    rows, cols = (size // 2 * 2 for size in pixels.shape)
    part = pixels[:rows, :cols].astype(np.float64)
    cells = np.stack([part[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    mean = float(part.mean())
    # greens are on one diagonal; red and blue on the other
    checks = 0.25 * (cells[0] + cells[3] - cells[1] - cells[2])
    check, error = float(checks.mean()), float(checks.std()) / math.sqrt(checks.size)
    reds = np.abs([(cells[0] - cells[3]).mean(), (cells[1] - cells[2]).mean()])
    share = max(2.0 * abs(check), float(reds.max())) / max(mean, 1e-9)
    if not (2.0 * abs(check) > _CHECKED * mean and abs(check) > _CHECKED_SE * error):
        return None
    return share


def field_shift_px(pixels: Pixels) -> float:
    """Return the shift of every second row along the rows, px: two fields of an interlaced image.

    From one row to the next a texture does not move on the average; with two fields it moves to the right, and in the
    next row by the same amount to the left.
    """
    rows, cols = pixels.shape
    first = np.arange(0, rows - 3, 2 * max(rows // (2 * _ROW_PAIRS), 1))
    wide = pixels[:, : cols // 2 * 2]
    lines: Float = np.stack([wide[first + k] for k in (0, 1, 2)]).astype(np.float64)
    lines -= lines.mean(axis=-1, keepdims=True)
    lines *= np.hanning(lines.shape[-1])
    spectra = np.fft.rfft(lines, axis=-1)
    peaks, energy = [], float((lines**2).sum()) / 3.0
    for k in (0, 1):
        score = np.fft.irfft((np.conj(spectra[k]) * spectra[k + 1]).sum(axis=0))
        score = np.roll(score, _MOST_SHIFT_PX)[: 2 * _MOST_SHIFT_PX + 1]
        at = int(np.argmax(score))
        if not score[at] > _ROWS_ALIKE * energy:
            return 0.0
        bent = 0.0
        if 0 < at < len(score) - 1:
            below, above = score[at - 1], score[at + 1]
            bent = 0.5 * (below - above) / min(below - 2.0 * score[at] + above, -1e-12)
        peaks.append(at + bent - _MOST_SHIFT_PX)
    return 0.5 * (peaks[0] - peaks[1])
