"""8-bit previews of images, and maps that are drawn over an image.

A preview is not the measurement's image: grey levels are brought to 8 bit and it may be smaller. Maps are transparent
at pixels without a value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.server.results.images.texture import GOOD_PX, NOISE_SHARE, USABLE_PX, errors_at

MapKind = Literal["saturation", "texture"]
_TILES_ACROSS = 64
# red, green, blue, opacity
_GOOD, _USABLE, _POOR = (40, 170, 90, 90), (240, 170, 20, 110), (220, 40, 40, 130)


@dataclass(frozen=True)
class Overlay:
    """A map as PNG, and the meaning of its colours.

    Parameters
    ----------
    png
        RGBA image; the page stretches it over the camera's image.
    legend
        One line of text.
    """

    png: bytes
    legend: str


def eight_bit(pixels: NDArray[Any], full_scale: float) -> NDArray[np.uint8]:
    """Bring grey levels of 0 to ``full_scale`` to 8 bit."""
    if pixels.dtype == np.uint8 and full_scale == 255:
        return pixels
    return np.asarray(np.clip(pixels * (255.0 / full_scale) + 0.5, 0, 255), dtype=np.uint8)


def preview(pixels: NDArray[Any], full_scale: float, width_px: int | None = None) -> bytes:
    """Return a JPEG of an image, at most ``width_px`` wide."""
    picture = eight_bit(pixels, full_scale)
    if width_px is not None and width_px < picture.shape[1]:
        height = max(round(picture.shape[0] * width_px / picture.shape[1]), 1)
        picture = np.asarray(cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return _encoded(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])


def saturation_map(pixels: NDArray[Any], full_scale: float) -> Overlay:
    """Mark pixels at full scale in red, each a little widened so that single ones are visible."""
    clipped = pixels >= full_scale
    share = float(np.mean(clipped))
    marked = cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rgba = np.zeros((*pixels.shape, 4), np.uint8)
    rgba[marked] = (255, 0, 40, 230)
    return Overlay(_rgba_png(rgba), f"red: at full scale, {100 * share:.3g} % of the image")


def predicted_error_px(pixels: NDArray[Any], full_scale: float, subset_px: int) -> NDArray[np.float64]:
    """Return the random error that matching may be expected to have, over a grid of subsets; see `errors_at`.

    Parameters
    ----------
    pixels
        Image (rows, cols).
    full_scale
        Maximum grey level.
    subset_px
        Width of the subset.

    Returns
    -------
    ndarray
        Error in px for noise of `NOISE_SHARE`, at subsets about ``max(rows, cols) / 64`` from each other; infinite
        without texture.
    """
    pitch = max(max(pixels.shape) // _TILES_ACROSS, 1)
    y, x = np.mgrid[tuple(slice(1 + pitch // 2, size - 1, pitch) for size in pixels.shape)]
    positions = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    return errors_at(pixels, positions, NOISE_SHARE * full_scale, (subset_px,))[subset_px].reshape(x.shape)


def texture_map(pixels: NDArray[Any], full_scale: float, subset_px: int) -> Overlay:
    """Colour an image by its speckle quality."""
    error = predicted_error_px(pixels, full_scale, subset_px)
    rgba = np.empty((*error.shape, 4), np.uint8)
    rgba[...] = _POOR
    rgba[error <= USABLE_PX] = _USABLE
    rgba[error <= GOOD_PX] = _GOOD
    legend = (
        f"green: error below {GOOD_PX:g} px expected at 1 % noise and a subset of {subset_px} px, "
        f"amber: below {USABLE_PX:g} px, red: above"
    )
    return Overlay(_rgba_png(rgba), legend)


def overlay(kind: MapKind, pixels: NDArray[Any], full_scale: float, subset_px: int) -> Overlay:
    """Make the map of this kind."""
    if kind == "saturation":
        return saturation_map(pixels, full_scale)
    return texture_map(pixels, full_scale, subset_px)


def _rgba_png(rgba: NDArray[np.uint8]) -> bytes:
    return _encoded(".png", np.asarray(cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), dtype=np.uint8), [])


def _encoded(extension: str, picture: NDArray[np.uint8], options: list[int]) -> bytes:
    _, data = cv2.imencode(extension, picture, options)
    return bytes(data.tobytes())
