"""Whether a texture carries a measurement: the random error that subsets of a region may be expected to have."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from server.results.quality import gradients

#: noise for which errors are told where it is not known, as a share of full scale: 2.55 grey levels of 255
NOISE_SHARE = 0.01
#: expected errors in px up to which texture is called good, and usable
GOOD_PX, USABLE_PX = 0.01, 0.05
#: subsets that are tried for a proposal, px
SIZES = (11, 15, 19, 23, 27, 31, 35, 41, 47, 55, 65, 77, 91)
#: share of a region's subsets that the proposed size has below GOOD_PX, or below USABLE_PX where none has
ENOUGH = 0.95


def errors_at(
    pixels: NDArray[Any], xy_px: NDArray[np.float64], noise_grey: float, sizes: tuple[int, ...]
) -> dict[int, NDArray[np.float64]]:
    """Return the expected random error in px at points, for each subset width.

    From the noise of two images and the smaller eigenvalue of the summed squared gradients over the subset; gradients
    of the noise itself are taken off.

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
        (n,) for each width; infinite where there is no texture.
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


def texture_verdict(
    pixels: NDArray[Any], full_scale: float, xy_px: NDArray[np.float64], subset_px: int, noise_grey: float | None = None
) -> dict[str, Any]:
    """Say how a region's texture carries subsets of this width, and which width would do.

    Parameters
    ----------
    pixels, full_scale
        Image and its largest grey level.
    xy_px
        (n, 2) centres of the subsets.
    subset_px
        Width that is asked about.
    noise_grey
        Standard deviation of the noise; `NOISE_SHARE` of full scale where not known.
    """
    noise = NOISE_SHARE * full_scale if noise_grey is None else noise_grey
    told = errors_at(pixels, xy_px, noise, tuple(sorted({*SIZES, subset_px})))
    shares = {
        size: {"good": float(np.mean(error <= GOOD_PX)), "usable": float(np.mean(error <= USABLE_PX))}
        for size, error in told.items()
    }
    proposed = next((s for s in SIZES if shares[s]["good"] >= ENOUGH), None)
    level = "good"
    if proposed is None:
        proposed = next((s for s in SIZES if shares[s]["usable"] >= ENOUGH), None)
    own = shares[subset_px]
    if own["good"] < ENOUGH:
        level = "usable" if own["usable"] >= ENOUGH else "poor"
    median = float(np.median(told[subset_px]))
    return {
        "subset_px": subset_px,
        "subsets": len(xy_px),
        "noise_grey": noise,
        "level": level,
        "median_error_px": median if np.isfinite(median) else None,
        "good_share": own["good"],
        "usable_share": own["usable"],
        "good_px": GOOD_PX,
        "usable_px": USABLE_PX,
        "proposed_subset_px": proposed,
        "sizes": [
            {"subset_px": size, "good_share": shares[size]["good"], "usable_share": shares[size]["usable"]}
            for size in SIZES
        ],
    }
