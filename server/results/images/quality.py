"""Quality of a captured image, before anyone relies on it.

Figures are cheap and plain: mean grey level, share of saturated pixels, gradient (texture) and how much of it
survives at the pixel scale (focus). A code names the fault of an image that cannot be measured on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: share of pixels at full scale above which grey levels are clipped over whole speckles
SATURATED_SHARE = 0.02
#: mean below this share of full scale: shutter closed, lamp off
DARK_SHARE = 0.02
#: standard deviation over the image, as a share of full scale, of an image that shows nothing but noise
BLANK_SHARE = 0.012
#: median over tiles of the rms gradient, as a share of full scale per px, below which matching will fail
LOW_TEXTURE_SHARE = 0.004
#: rms second difference over rms first difference, noise taken out of both; speckles in focus have twice this and more
BLURRED_RATIO = 0.12
#: share of the squared gradient that must be more than noise for a figure of focus
_SEEN_SHARE = 0.2
#: differences over 1 ... 4 px extrapolated to 0 px, by an even polynomial through them
_TO_ZERO = (1.6, -0.8, 8.0 / 35.0, -1.0 / 35.0)
_NOISE_PIXELS = 1_000_000  # that suffice for the noise
_TILE_PX = 32


@dataclass(frozen=True)
class ImageQuality:
    """Figures of one image; grey levels in counts, ``mean_share`` of full scale.

    ``focus`` is the rms second difference over the rms first one, both without the noise of the pixels; None where
    little but noise is seen.
    """

    code: str
    mean_grey: float
    mean_share: float
    saturated_share: float
    contrast_grey: float
    texture_grey_per_px: float
    focus: float | None

    def as_dict(self) -> dict[str, str | float | None]:
        """Names and rounded numbers."""
        return {
            "code": self.code,
            "mean_grey": round(self.mean_grey, 2),
            "mean_share": round(self.mean_share, 4),
            "saturated_share": round(self.saturated_share, 5),
            "contrast_grey": round(self.contrast_grey, 2),
            "texture_grey_per_px": round(self.texture_grey_per_px, 3),
            "focus": None if self.focus is None else round(self.focus, 4),
        }


def gradients(pixels: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return central differences along x and y, in grey levels per px, of all pixels but the outermost."""
    a = pixels.astype(np.float32)
    # neighbouring pixels' independent noise does not cancel in them, but is halved
    return 0.5 * (a[1:-1, 2:] - a[1:-1, :-2]), 0.5 * (a[2:, 1:-1] - a[:-2, 1:-1])


def _noise_variance(a: NDArray[np.float32]) -> float:
    """Return the variance of the pixels' own noise, grey levels squared.

    Half the mean squared difference of pixels at a distance h is the sum of the picture's part, which vanishes with h,
    and the noise's variance, which is the same at any h.
    """
    every = max(a.size // _NOISE_PIXELS, 1)
    along, down = a[::every], a[:, ::every]
    total = 0.0
    for h, weight in enumerate(_TO_ZERO, 1):
        across = float(np.mean((along[:, h:] - along[:, :-h]) ** 2)) + float(np.mean((down[h:] - down[:-h]) ** 2))
        total += weight * 0.25 * across
    return max(total, 0.0)


def _focus(first2: float, second2: float, noise2: float) -> float | None:
    """Return the figure of focus from mean squares of first and second differences, which hold 1 and 5/4 of noise."""
    seen = first2 - noise2
    if seen <= _SEEN_SHARE * first2:
        return None
    return float(np.sqrt(max(second2 - 1.25 * noise2, 0.0) / seen))


def clipping_level(pixels: NDArray[Any], bit_depth: int) -> int:
    """Return the grey level at which an image is clipped, by the end of its own histogram.

    A camera may put 12 bits to the left or to the right of 16, and video has its white at 235 of 255. Such an end is
    taken for the converter's only if the image reaches it exactly, and often.
    """
    # bits that are zero in every pixel: the levels' distance
    levels = int(np.bitwise_or.reduce(pixels, axis=None)) | 1 << max(bit_depth - 8, 0)
    full = 2**bit_depth - (levels & -levels)
    top = int(pixels.max())
    ends = [2**bits - 1 for bits in (10, 12, 14) if bits < bit_depth] + [235 << max(bit_depth - 8, 0)]
    return top if top in ends and np.mean(pixels == top) > SATURATED_SHARE else full


def saturated_share(pixels: NDArray[Any], bit_depth: int) -> float:
    """Return the share of an image's pixels at the level at which it is clipped."""
    return float(np.mean(pixels >= clipping_level(pixels, bit_depth)))


def image_quality(pixels: NDArray[Any], bit_depth: int) -> ImageQuality:
    """Rate one image (rows, cols)."""
    full = float(clipping_level(pixels, bit_depth))
    a = pixels.astype(np.float32)
    mean, contrast = float(a.mean()), float(a.std())
    saturated = float(np.mean(pixels >= full))
    gx, gy = gradients(a)
    g2 = gx * gx + gy * gy
    rows, cols = (max(n // _TILE_PX, 1) for n in g2.shape)
    tiles = g2[: g2.shape[0] // rows * rows, : g2.shape[1] // cols * cols]
    tiles = tiles.reshape(rows, tiles.shape[0] // rows, cols, tiles.shape[1] // cols)
    texture = float(np.sqrt(np.median(tiles.mean(axis=(1, 3)))))
    second = 0.25 * (a[1:-1, 2:] + a[1:-1, :-2] + a[2:, 1:-1] + a[:-2, 1:-1]) - a[1:-1, 1:-1]
    focus = _focus(float(g2.mean()), float(np.mean(second * second)), _noise_variance(a))
    if saturated > SATURATED_SHARE:
        code = "saturated"
    elif mean < DARK_SHARE * full:
        code = "dark"
    elif contrast < BLANK_SHARE * full:
        code = "blank"
    elif texture < LOW_TEXTURE_SHARE * full or focus is None:
        code = "low_texture"
    elif focus < BLURRED_RATIO:
        code = "blurred"
    else:
        code = "ok"
    return ImageQuality(code, mean, mean / full, saturated, contrast, texture, focus)


def saturation_text(share: float) -> str:
    """Return the warning of an image that is saturated over whole speckles."""
    return f"{share:.1%} of its pixels are at full scale. Lower exposure, gain or light"


def quality_warning(name: str, quality: ImageQuality) -> str | None:
    """Return a warning about an image, with advice; None if it is good.

    Parameters
    ----------
    name
        Name of its camera.
    quality
        Its figures.
    """
    said = {
        "saturated": saturation_text(quality.saturated_share),
        "dark": f"it is too dark, {quality.mean_share:.1%} of full scale in the mean. Check lens cap, light, exposure",
        "blank": "it shows noise alone. Check lens cap, light, exposure and that the specimen carries a pattern",
        "low_texture": "it has too little texture. Check focus, light and that the specimen carries a pattern",
        "blurred": f"it is blurred: a focus figure of {quality.focus or 0.0:.2f}, below {BLURRED_RATIO}. Focus",
    }.get(quality.code)
    return None if said is None else f"{name}: {said}."


def pair_quality(cam1: ImageQuality, cam2: ImageQuality) -> dict[str, Any]:
    """Quality of a pair: the first thing that is wrong, and both cameras' figures."""
    code = cam1.code if cam1.code != "ok" else cam2.code
    return {"code": code, "cam1": cam1.as_dict(), "cam2": cam2.as_dict()}
