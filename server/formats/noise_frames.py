"""Frames for a noise measurement, read one by one: of large ones, only the rows that are evaluated are kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from core.errors import ImageError
from core.noise import rows_looked_at
from server.formats.images import GrayImage, read_image


def read_frames(files: Sequence[Path]) -> list[GrayImage]:
    """Read frames of one camera.

    Raises
    ------
    ImageError
        ``image_size_mismatch``, or the error of a file.
    """
    frames: list[GrayImage] = []
    shape: tuple[int, ...] = ()
    for file in files:
        image = read_image(file)
        shape = shape or image.shape
        if image.shape != shape:
            raise ImageError(
                f"{file} is {image.shape[1]} x {image.shape[0]} px, {files[0]} {shape[1]} x {shape[0]} px.",
                code="image_size_mismatch",
                remedy="Give frames of one camera.",
            )
        frames.append(image[rows_looked_at(shape)].copy())
    return frames
