"""Images and masks that a client sent, decoded behind walls."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Mapping
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stereorig.server.cell.cell import Cell, require
from stereorig.server.cell.sandbox import ReadingLimits, declare
from stereorig.server.formats.images import Decoded, decode, decode_mask, encode_png, encode_tiff

_PIXEL_BYTES = 8  # four channels of 16 bit
#: of the largest images that are read; the head of each declares less
_LIMITS = ReadingLimits(memory_bytes=5 << 30, reply_bytes=640 << 20)


def images(cell: Cell, contents: Mapping[str, bytes]) -> dict[str, Decoded]:
    """Decode image files by their names in error messages; see :func:`stereorig.server.formats.images.decode`.

    Raises
    ------
    ImageError
        As there.
    FileFormatError, TooLargeError, QueueFullError
        As `Cell.read`.
    """
    names = list(contents)
    found = cell.read(_decode, list(contents.values()), names, of=" and ".join(names[:2]), limits=_LIMITS)
    for pixels, grey_from, bits in found:
        require(pixels.ndim == 2 and pixels.dtype in (np.uint8, np.uint16), "the image")
        require(grey_from is None or isinstance(grey_from, str), "the image")
        require(type(bits) is int and 8 <= bits <= 8 * pixels.dtype.itemsize, "the image")
    return {name: Decoded(*one) for name, one in zip(names, found, strict=True)}


def mask(cell: Cell, content: bytes) -> NDArray[np.bool_]:
    """Decode a mask's file, see :func:`stereorig.server.formats.images.decode_mask`; raises as :func:`images`."""
    found: NDArray[np.bool_] = cell.read(_decode_mask, [content], of="the mask", limits=_LIMITS)
    require(found.ndim == 2 and found.dtype == np.bool_, "the mask")
    return found


def warm_up() -> None:
    """Load the parts of the libraries that they load with their first image only."""
    Image.init()
    gray = np.zeros((2, 2), np.uint8)
    colour = io.BytesIO()
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(colour, "JPEG")
    for content in (encode_tiff(gray), encode_png(gray > 0), colour.getvalue()):
        decode(content)


def _decode(files: list[BinaryIO], names: list[str]) -> list[tuple[object, str | None, int]]:
    found: list[tuple[object, str | None, int]] = []
    for file, name in zip(files, names, strict=True):
        content = file.read()
        _declare(content)
        decoded = decode(content, name=name)
        found.append((decoded.pixels, decoded.grey_from, decoded.bit_depth))
    return found


def _decode_mask(files: list[BinaryIO]) -> NDArray[np.bool_]:
    content = files[0].read()
    _declare(content)
    return decode_mask(content)


def _declare(content: bytes) -> None:
    """Bound the memory by the size that the file's head declares, if it can be read alone."""
    with contextlib.suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with Image.open(io.BytesIO(content)) as image:
            width, height = image.size
        declare(len(content) + _PIXEL_BYTES * width * height)
