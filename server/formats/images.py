"""Image files: gray or colour, 8 or 16 bit, in and out; every number of a gray image as the camera gave it.

Read: TIFF, PNG, BMP, JPEG. A colour file whose channels are equal everywhere is a gray image saved as colour and keeps
its numbers; of true colour the luminance is taken, and said so, since the conversion is part of the measurement. Size
and type are checked in the header, before anything is decoded.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from core.errors import ImageError
from server.formats.files import write_bytes

GrayImage = NDArray[np.uint8] | NDArray[np.uint16]

MAX_PIXELS = 160_000_000  # the largest area sensors have 151 million
MAX_SIDE_PX = 32_767
MAX_FILE_BYTES = 2 << 30
_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PIL_FORMATS = ("PNG", "BMP", "JPEG")
_REDUCED_PAGE = 1  # NewSubfileType bit: a thumbnail of another page
_MIN_IS_WHITE = 0
_TIFF_RGB = 2  # PhotometricInterpretation
LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a grey level: those of ITU-R BT.601, as OpenCV and most cameras take them."""
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
        What its grey levels were made from, if they are not the file's own: ``LUMINANCE_TEXT`` of a colour image.
    """

    pixels: GrayImage
    grey_from: str | None = None


def _unreadable(name: str, why: str) -> ImageError:
    return ImageError(
        f"{name} cannot be read as an image: {why}.",
        code="image_unreadable",
        remedy="Copy or save the file again; TIFF, PNG, BMP and JPEG are read.",
    )


def _unsupported(name: str, why: str) -> ImageError:
    return ImageError(
        f"{name} is not a gray or RGB image of 8 or 16 bit: {why}.",
        code="image_unsupported",
        remedy="Save both cameras' images as one-channel 8 or 16 bit TIFF or PNG, or as RGB.",
    )


def _too_large(cause: str) -> ImageError:
    return ImageError(cause, code="image_too_large", remedy="Give the camera's own image, or a part of it.")


def _check_size(name: str, width: int, height: int) -> None:
    if width < 1 or height < 1:
        raise _unreadable(name, f"its header gives a size of {width} x {height} px")
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE_PX:
        raise _too_large(
            f"{name} is {width} x {height} px; at most {MAX_PIXELS} px and {MAX_SIDE_PX} px a side are read."
        )


def _one_channel(name: str, pixels: NDArray[Any], *, space: str = "RGB") -> Decoded:
    """Reduce (rows, cols[, channels]) of one image to grey levels (rows, cols), or raise an error."""
    if pixels.dtype not in (np.uint8, np.uint16):
        raise _unsupported(name, f"its pixels are {pixels.dtype}")
    if pixels.ndim == 3:
        colour = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
        if pixels.shape[2] in (2, 4) and (pixels[..., -1] != np.iinfo(pixels.dtype).max).any():
            raise _unsupported(name, "it has transparent pixels")
        if (colour != colour[..., :1]).any():
            if space != "RGB":
                raise _unsupported(name, f"its colours are {space}, not RGB")
            return Decoded(luminance(colour), LUMINANCE_TEXT)
        pixels = colour[..., 0]
    return Decoded(np.ascontiguousarray(pixels))


def luminance(rgb: NDArray[Any]) -> GrayImage:
    """Return the luminance (rows, cols) of (rows, cols, 3) red, green, blue, uint8 or uint16, rounded to that type."""
    out = np.empty(rgb.shape[:2], rgb.dtype)
    weights = np.array(LUMINANCE)
    for top in range(0, len(out), _ROWS_AT_ONCE):  # in bands: as float64 a large image would take gigabytes
        out[top : top + _ROWS_AT_ONCE] = np.rint(rgb[top : top + _ROWS_AT_ONCE] @ weights)
    return out


def _decode_tiff(name: str, data: bytes) -> Decoded:
    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tif:
            pages = [p for p in tif.pages[:4] if not p.aspage().subfiletype & _REDUCED_PAGE]
            if not pages:
                raise _unreadable(name, "it holds no image")
            if len(pages) > 1:
                raise _unsupported(name, "it holds more than one image")
            page = pages[0].aspage()
            _check_size(name, int(page.imagewidth), int(page.imagelength))
            if page.dtype not in (np.uint8, np.uint16) or page.imagedepth != 1:
                raise _unsupported(name, f"its pixels are {page.dtype or 'of an unknown type'}")
            if page.samplesperpixel > 4:
                raise _unsupported(name, f"it has {page.samplesperpixel} channels")
            # tifffile fills missing data with zeros; a measurement must not
            ends = [o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=False)]
            if not ends or min(page.databytecounts) == 0 or max(ends) > len(data):
                raise _unreadable(name, f"it is truncated ({len(data)} bytes, {max(ends, default=0)} expected)")
            try:
                pixels = page.asarray()
            except ValueError as error:
                if "imagecodecs" not in str(error):
                    raise
                pixels = _decode_pil(name, data, ("TIFF",))  # LZW and the like: libtiff's work
                inverted, space = False, "RGB"  # what libtiff makes of any
            else:
                inverted = int(page.photometric) == _MIN_IS_WHITE
                is_rgb = int(page.photometric) == _TIFF_RGB
                space = "RGB" if is_rgb else getattr(page.photometric, "name", str(page.photometric))
            if page.samplesperpixel > 1 and int(page.planarconfig) == 2 and pixels.ndim == 3:
                pixels = np.moveaxis(pixels, 0, -1)
    except ImageError:
        raise
    except Exception as error:  # a damaged file can fail anywhere inside the reader
        raise _unreadable(name, f"{type(error).__name__}, {error}") from error
    gray = _one_channel(name, pixels, space=space)
    return Decoded(np.iinfo(gray.pixels.dtype).max - gray.pixels) if inverted else gray


def _decode_pil(name: str, data: bytes, formats: tuple[str, ...]) -> NDArray[Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own limit is below
            with Image.open(io.BytesIO(data), formats=formats) as image:
                _check_size(name, *image.size)
                if image.mode == "P":
                    image.load()
                    return np.asarray(image.convert("RGBA" if "transparency" in image.info else "RGB"))
                # Pillow would cut 16 bit colour to 8 bit without a word
                if image.mode in ("RGB", "RGBA", "LA") and any("16" in _raw_mode(tile[3]) for tile in image.tile):
                    return _decode_deep_colour(name, data)
                if image.mode not in ("L", "LA", "I;16", "I;16B", "I;16L", "I;16N", "RGB", "RGBA"):
                    raise _unsupported(name, f"its pixel type is {image.mode!r}")
                image.load()
                pixels = np.asarray(image)
                return pixels.astype(np.uint16) if image.mode.startswith("I;16") else pixels
    except ImageError:
        raise
    except Image.DecompressionBombError as error:  # raised while opening, far above our own limit
        raise _too_large(f"{name} is too large: {error}") from error
    except Exception as error:  # a damaged file can fail anywhere inside the reader
        raise _unreadable(name, f"{type(error).__name__}, {error}") from error


def _raw_mode(arguments: object) -> str:
    """Return the pixel form, as RGB;16B, of a Pillow decoder's arguments: the others may be offsets with any digits."""
    return str(arguments[0] if isinstance(arguments, tuple) and arguments else arguments)


def _decode_deep_colour(name: str, data: bytes) -> NDArray[Any]:
    """Return (rows, cols, 3 or 4) red, green, blue of a colour image of 16 bit; its size was checked before."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise _unsupported(name, "it is a colour image of 16 bit that cannot be read")
    order = [2, 1, 0] if pixels.shape[2] == 3 else [2, 1, 0, 3]
    return np.asarray(pixels[..., order])


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
        (rows, cols) uint8 or uint16, C-contiguous, and what they were made from.

    Raises
    ------
    ImageError
        ``image_unreadable`` (damaged, truncated, no image), ``image_unsupported`` (colours that are not RGB,
        transparent or other pixels, several images), ``image_too_large`` (checked in the header).
    """
    if data[:4] in _TIFF_MAGIC:
        return _decode_tiff(name, data)
    if data[:8] == b"\x89PNG\r\n\x1a\n" or data[:2] in (b"BM", b"\xff\xd8"):
        return _one_channel(name, _decode_pil(name, data, _PIL_FORMATS))
    raise _unreadable(name, "it is none of TIFF, PNG, BMP, JPEG" if data else "it is empty")


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
            raise _too_large(f"The {kind} {path} has {size} bytes; at most {MAX_FILE_BYTES} are read.")
        return path.read_bytes()
    except FileNotFoundError as error:
        raise ImageError(f"The {kind} {path} does not exist.", code="file_missing", remedy="Check the path.") from error
    except OSError as error:
        raise _unreadable(str(path), error.strerror or str(error)) from error


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
    """Read a mask image: True (points may lie) where it is brighter than half of full scale.

    Raises
    ------
    ImageError
        As :func:`read_image`; a mask may also be of one bit.
    """
    data = read_file(Path(path), kind="mask")
    return decode_mask(data, name=str(path))


def decode_mask(data: bytes, *, name: str = "the mask") -> NDArray[np.bool_]:
    """Decode a mask image's bytes, see :func:`read_mask`."""
    try:
        gray = decode_image(data, name=name)
    except ImageError as error:
        if error.code != "image_unsupported":
            raise
        try:  # one bit a pixel is a proper mask, though no measurement image; its size was checked above
            with Image.open(io.BytesIO(data), formats=("PNG", "BMP", "TIFF")) as image:
                if image.mode != "1":
                    raise error
                return np.asarray(image).astype(np.bool_)
        except OSError as damaged:
            raise _unreadable(name, str(damaged)) from damaged
    return np.asarray(gray > np.iinfo(gray.dtype).max // 2)


def encode_png(mask: NDArray[np.bool_]) -> bytes:
    """Encode a mask (rows, cols) as a PNG, white where it is True."""
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
