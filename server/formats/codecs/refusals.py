"""Limits of image files, and the errors for files outside them."""

from __future__ import annotations

from stereorig.core.errors import ImageError

MAX_PIXELS = 160_000_000  # the largest area sensors have 151 million
MAX_SIDE_PX = 32_767


def unreadable(name: str, why: str) -> ImageError:
    """Return the error for a file that is damaged, incomplete or no image."""
    return ImageError(
        f"{name} cannot be read as an image: {why}.",
        code="image_unreadable",
        remedy="Copy or save the file again; TIFF, PNG, BMP and JPEG are read.",
    )


def unsupported(name: str, why: str) -> ImageError:
    """Return the error for a whole image of a kind that is not read."""
    return ImageError(
        f"{name} is not a gray or RGB image of 8 or 16 bit: {why}.",
        code="image_unsupported",
        remedy="Save both cameras' images as one-channel 8 or 16 bit TIFF or PNG, or as RGB.",
    )


def too_large(cause: str) -> ImageError:
    """Return the error for more pixels or bytes than are read."""
    return ImageError(cause, code="image_too_large", remedy="Give the camera's own image, or a part of it.")


def check_size(name: str, width: int, height: int) -> None:
    """Raise an error for a header's size that is none, or larger than any camera's.

    Raises
    ------
    ImageError
        ``image_unreadable`` or ``image_too_large``.
    """
    if width < 1 or height < 1:
        raise unreadable(name, f"its header gives a size of {width} x {height} px")
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE_PX:
        raise too_large(
            f"{name} is {width} x {height} px; at most {MAX_PIXELS} px and {MAX_SIDE_PX} px a side are read."
        )
