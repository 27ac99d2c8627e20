"""Speckle quality of a region, rated by SSSIG: the random error to expect of its subsets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.settings import MAX_CORNERS, MAX_CUTS
from stereorig.server.results.images.quality import gradients

if TYPE_CHECKING:
    from stereorig.core.field.seeding.specimen import Specimen


#: noise for which errors are reported if it is not known, as a share of full scale: 2.55 grey levels of 255
NOISE_SHARE = 0.01
#: expected errors in px up to which texture is called good, and usable
GOOD_PX, USABLE_PX = 0.01, 0.05
#: subsets that are tried for a proposal, px
SIZES = (11, 15, 19, 23, 27, 31, 35, 41, 47, 55, 65, 77, 91)
#: share of a region's subsets that the proposed size has below GOOD_PX, or below USABLE_PX if no size has it
MIN_SHARE = 0.95


def errors_at(
    pixels: NDArray[Any], xy_px: NDArray[np.float64], noise_grey: float, sizes: tuple[int, ...]
) -> dict[int, NDArray[np.float64]]:
    """Return the expected random error in px at points, for each subset width.

    The error follows from the noise of two images and the smaller eigenvalue of the summed squared gradients over the
    subset; the gradients of the noise itself are subtracted.

    Parameters
    ----------
    pixels
        Image (rows, cols).
    xy_px
        (n, 2) centres of subsets.
    noise_grey
        Standard deviation of the noise of one image, grey levels.
    sizes
        Widths of the subset, odd.

    Returns
    -------
    dict
        (n,) for each width; infinite without texture.
    """
    gx, gy = gradients(pixels)  # of all pixels but the outermost: one less on each side
    rows, cols = gx.shape
    # sums over any square come from four corners of these
    xx, xy, yy = (cv2.integral(product, sdepth=cv2.CV_64F) for product in (gx * gx, gx * gy, gy * gy))
    x, y = np.rint(xy_px).astype(np.int64).T - 1
    out = {}
    for size in sizes:
        half = size // 2
        left, right = np.clip(x - half, 0, cols), np.clip(x + half + 1, 0, cols)
        top, bottom = np.clip(y - half, 0, rows), np.clip(y + half + 1, 0, rows)
        a, b, c = (s[bottom, right] - s[top, right] - s[bottom, left] + s[top, left] for s in (xx, xy, yy))
        count = (right - left) * (bottom - top)
        weakest = 0.5 * (a + c) - np.sqrt((0.5 * (a - c)) ** 2 + b * b) - 0.5 * count * noise_grey**2
        with np.errstate(divide="ignore"):
            out[size] = np.sqrt(2.0) * noise_grey / np.sqrt(np.maximum(weakest, 0.0))
    return out


@dataclass(frozen=True)
class SubsetShare:
    """Shares of a region's subsets of one width whose error stays below the limits."""

    subset_px: int
    good_share: float
    usable_share: float


@dataclass(frozen=True)
class SpeckleQuality:
    """Speckle quality of a region for subsets of a width, and the width to choose.

    Attributes
    ----------
    subset_px, subsets
        Width that is rated, and the number of subsets.
    noise_grey
        Standard deviation of the noise that was assumed.
    level
        ``good``, ``usable`` or ``poor``.
    median_error_px
        Median of the predicted standard deviations of the match; None without texture.
    good_share, usable_share, good_px, usable_px
        Shares of the subsets whose error stays below the limits, and these.
    proposed_subset_px
        Minimum width that suffices; None: none does.
    sizes
        The shares of other widths.
    """

    subset_px: int
    subsets: int
    noise_grey: float
    level: Literal["good", "usable", "poor"]
    median_error_px: float | None
    good_share: float
    usable_share: float
    good_px: float
    usable_px: float
    proposed_subset_px: int | None
    sizes: list[SubsetShare]


def speckle_quality(
    pixels: NDArray[Any], full_scale: float, xy_px: NDArray[np.float64], subset_px: int, noise_grey: float | None = None
) -> SpeckleQuality:
    """Rate a region's texture for subsets of this width, and propose a width.

    Parameters
    ----------
    pixels, full_scale
        Image and its maximum grey level.
    xy_px
        (n, 2) centres of the subsets.
    subset_px
        Width to rate.
    noise_grey
        Standard deviation of the noise; `NOISE_SHARE` of full scale where not known.
    """
    noise = NOISE_SHARE * full_scale if noise_grey is None else noise_grey
    errors = errors_at(pixels, xy_px, noise, tuple(sorted({*SIZES, subset_px})))
    shares = {
        size: SubsetShare(size, float(np.mean(error <= GOOD_PX)), float(np.mean(error <= USABLE_PX)))
        for size, error in errors.items()
    }
    proposed = next((s for s in SIZES if shares[s].good_share >= MIN_SHARE), None)
    if proposed is None:
        proposed = next((s for s in SIZES if shares[s].usable_share >= MIN_SHARE), None)
    own = shares[subset_px]
    level: Literal["good", "usable", "poor"] = "good"
    if own.good_share < MIN_SHARE:
        level = "usable" if own.usable_share >= MIN_SHARE else "poor"
    median = float(np.median(errors[subset_px]))
    return SpeckleQuality(
        subset_px=subset_px,
        subsets=len(xy_px),
        noise_grey=noise,
        level=level,
        median_error_px=median if np.isfinite(median) else None,
        good_share=own.good_share,
        usable_share=own.usable_share,
        good_px=GOOD_PX,
        usable_px=USABLE_PX,
        proposed_subset_px=proposed,
        sizes=[shares[size] for size in SIZES],
    )


# A specimen that was found, as a region that an analysis takes and a user can correct.

_TOLERANCE_OF_SUBSET = 0.125  # of an outline for the hand: a subset that reaches over by so much shows nothing of it
_MIN_HOLE_OF_SUBSET = 1.0


def region_to_edit(specimen: Specimen, subset_px: int) -> dict[str, Any]:
    """Return the largest part's outline, simplified, and the holes in it, as the API's region has them.

    Parameters
    ----------
    specimen
        The specimen.
    subset_px
        Width of the subsets; holes that are small against it are left out.
    """
    outline = specimen.outlines_px[0]
    inside = [
        hole
        for hole in specimen.holes_px
        if cv2.pointPolygonTest(outline.astype(np.float32), (float(hole[0, 0]), float(hole[0, 1])), False) >= 0
        and cv2.contourArea(hole.astype(np.float32)) >= _MIN_HOLE_OF_SUBSET * subset_px**2
    ]
    inside.sort(key=lambda hole: -cv2.contourArea(hole.astype(np.float32)))
    return {
        "polygon": _simplified(outline, subset_px).tolist(),
        "holes": [_simplified(hole, subset_px).tolist() for hole in inside[:MAX_CUTS]],
    }


def _simplified(corners: Float, subset_px: int) -> Float:
    tolerance = _TOLERANCE_OF_SUBSET * subset_px
    while True:
        found = cv2.approxPolyDP(corners.astype(np.float32), tolerance, True).reshape(-1, 2)
        if len(found) < 3:
            return corners
        if len(found) <= MAX_CORNERS:
            return np.asarray(found, dtype=np.float64)
        tolerance *= 2.0
