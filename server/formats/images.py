"""Image files: gray or colour, 8 or 16 bit, in and out; every number of a gray image as the camera gave it.

Read: TIFF, PNG, BMP, JPEG. A colour file whose channels are equal everywhere is a gray image saved as colour and keeps
its numbers; a true colour image is reduced to its luminance, and the result states so, since the conversion is part
of the measurement. Size and type are checked in the header, before anything is decoded.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from stereorig.core.errors import ImageError
from stereorig.server.formats.codecs.flat import PNG_HEAD, decode_bmp, decode_png
from stereorig.server.formats.codecs.jpeg import decode_jpeg
from stereorig.server.formats.codecs.refusals import too_large, unreadable, unsupported
from stereorig.server.formats.codecs.tiff import MAGIC, decode_tiff, orientation_of, upright
from stereorig.server.formats.files import write_bytes
from stereorig.server.formats.manifest import checked_bytes

GrayImage = NDArray[np.uint8] | NDArray[np.uint16]

MAX_FILE_BYTES = 2 << 30
LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey level: ITU-R BT.601, as OpenCV and most cameras use them."""
LUMINANCE_TEXT = "luminance, {} R + {} G + {} B".format(*LUMINANCE)
_ROWS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Decoded:
    """An image file's pixels.

    Attributes
    ----------
    pixels
        (rows, cols) uint8 or uint16.
    grey_from
        Origin of the grey levels if they are not the file's own: ``LUMINANCE_TEXT`` of a colour image.
    bit_depth
        Significant bits of a pixel, as the file states them: 8, 12 (packed) or 16.
    """

    pixels: GrayImage
    grey_from: str | None
    bit_depth: int


def _one_channel(name: str, pixels: NDArray[Any], bits: int, *, space: str = "RGB") -> Decoded:
    """Reduce (rows, cols[, channels]) of one image to grey levels (rows, cols), or raise an error."""
    if pixels.dtype not in (np.uint8, np.uint16):
        raise unsupported(name, f"its pixels are {pixels.dtype}")
    if pixels.ndim == 3:
        colour = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
        if pixels.shape[2] in (2, 4) and (pixels[..., -1] != np.iinfo(pixels.dtype).max).any():
            raise unsupported(name, "it has transparent pixels")
        if (colour != colour[..., :1]).any():
            if space != "RGB":
                raise unsupported(name, f"its colours are {space}, not RGB")
            return Decoded(luminance(colour), LUMINANCE_TEXT, bits)
        pixels = colour[..., 0]
    return Decoded(np.ascontiguousarray(pixels), None, bits)


def luminance(rgb: NDArray[Any]) -> GrayImage:
    """Return the luminance (rows, cols) of (rows, cols, 3) red, green, blue, uint8 or uint16, rounded to that type."""
    out = np.empty(rgb.shape[:2], rgb.dtype)
    weights = np.array(LUMINANCE)
    for top in range(0, len(out), _ROWS_AT_ONCE):  # in bands: as float64 a large image would take gigabytes
        out[top : top + _ROWS_AT_ONCE] = np.rint(rgb[top : top + _ROWS_AT_ONCE] @ weights)
    return out


def decode_image(data: bytes, *, name: str = "the image") -> GrayImage:
    """Decode the bytes of one TIFF, PNG, BMP or JPEG file to grey levels, see :func:`decode`."""
    return decode(data, name=name).pixels


def decode(data: bytes, *, name: str = "the image") -> Decoded:
    """Decode the bytes of one TIFF, PNG, BMP or JPEG file.

    Parameters
    ----------
    data
        The whole file.
    name
        Its name in error messages.

    Returns
    -------
    Decoded
        (rows, cols) uint8 or uint16, C-contiguous, and the origin of its grey levels.

    Raises
    ------
    ImageError
        ``image_unreadable`` (damaged, no image, or any strip, row or segment that is missing), ``image_unsupported``
        (colours that are not RGB, transparent or other pixels, several images), ``image_too_large`` (by the header).
    """
    pixels, space, bits = _samples(data, name)
    if bits == 1:
        raise unsupported(name, "its pixels are of one bit")
    return _one_channel(name, pixels, bits, space=space)


def _samples(data: bytes, name: str) -> tuple[NDArray[Any], str, int]:
    """Return (rows, cols[, channels]), the name of their colours, and the bits a channel."""
    try:
        if data[:4] in MAGIC:
            return decode_tiff(data, name)
        if data[:8] == PNG_HEAD:
            pixels = decode_png(data, name)
        elif data[:2] == b"BM":
            pixels = decode_bmp(data, name)
        elif data[:2] == b"\xff\xd8":
            pixels, exif = decode_jpeg(data, name)
            pixels = upright(pixels, orientation_of(exif))
        else:
            raise unreadable(name, "it is none of TIFF, PNG, BMP, JPEG" if data else "it is empty")
    except OSError as error:  # of Pillow
        raise unreadable(name, str(error)) from error
    return pixels, "RGB", 1 if pixels.dtype == np.bool_ else 8 * pixels.itemsize


def read_file(path: Path, *, kind: str = "image") -> bytes:
    """Read a whole input file, at most ``MAX_FILE_BYTES``.

    Raises
    ------
    ImageError
        ``file_missing``, ``image_unreadable`` (a folder, no permission) or ``image_too_large``.
    """
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise too_large(f"The {kind} {path} has {size} bytes; at most {MAX_FILE_BYTES} are read.")
        return checked_bytes(path)
    except FileNotFoundError as error:
        raise ImageError(f"The {kind} {path} does not exist.", code="file_missing", remedy="Check the path.") from error
    except OSError as error:
        raise unreadable(str(path), error.strerror or str(error)) from error


def read_image(path: str | Path) -> GrayImage:
    """Read one gray image file.

    Returns
    -------
    NDArray
        (rows, cols) uint8 or uint16, C-contiguous, values as stored.

    Raises
    ------
    ImageError
        ``file_missing``, and the codes of :func:`decode_image`.
    """
    return decode_image(read_file(Path(path)), name=str(path))


def read_mask(path: str | Path) -> NDArray[np.bool_]:
    """Read a mask image: True (points allowed) at pixels brighter than half of full scale.

    Raises
    ------
    ImageError
        As :func:`read_image`; a mask may also be of one bit.
    """
    data = read_file(Path(path), kind="mask")
    return decode_mask(data, name=str(path))


def decode_mask(data: bytes, *, name: str = "the mask") -> NDArray[np.bool_]:
    """Decode a mask image's bytes, see :func:`read_mask`."""
    pixels, space, bits = _samples(data, name)
    if bits == 1:  # a proper mask, though no measurement image
        return pixels
    gray = _one_channel(name, pixels, bits, space=space).pixels
    return np.asarray(gray > ((1 << bits) - 1) // 2)


def encode_png(mask: NDArray[np.bool_]) -> bytes:
    """Encode a mask (rows, cols) as a PNG, white at True."""
    buffer = io.BytesIO()
    Image.fromarray(mask.astype(np.uint8) * np.uint8(255)).save(buffer, "PNG")
    return buffer.getvalue()


def encode_tiff(image: GrayImage) -> bytes:
    """Encode (rows, cols) uint8 or uint16 as an uncompressed TIFF."""
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"an image file takes (rows, cols) of uint8 or uint16, got {image.shape} {image.dtype}")
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, image, photometric="minisblack", metadata=None)
    return buffer.getvalue()


def write_image(path: str | Path, image: GrayImage) -> None:
    """Write (rows, cols) uint8 or uint16 as an uncompressed TIFF, under a temporary name, then renamed.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``; an older file of that name is then untouched.
    """
    write_bytes(Path(path), encode_tiff(image))
