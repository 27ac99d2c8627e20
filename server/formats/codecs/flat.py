"""PNG and BMP: the rows are counted first, then Pillow decodes them."""

from __future__ import annotations

import io
import warnings
import zlib
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stereorig.core.errors import ImageError
from stereorig.server.formats.codecs.refusals import MAX_PIXELS, check_size, too_large, unreadable, unsupported
from stereorig.server.formats.codecs.tiff import orientation_of, upright

PNG_HEAD = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by PNG's colour type
_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
#: first row and column, then steps, of the seven parts of an interlaced PNG
_ADAM7 = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
MAX_PNG_BYTES = 4 * MAX_PIXELS  # colours of 16 bit in the largest image take its reader gigabytes
_KEPT = (b"PLTE", b"tRNS")  # these chunks change pixels; texts, profiles and times do not reach the decoder
_EXIF = b"eXIf"
_AT_ONCE = 1 << 20
_BMP_PLAIN, _BMP_MASKS = 0, 3
_BMP_DEPTHS = (1, 4, 8, 16, 24, 32)


def decode_png(data: bytes, name: str) -> NDArray[Any]:
    """Return (rows, cols[, channels]) uint8 or uint16 of a PNG; bool for one bit a pixel.

    Raises
    ------
    ImageError
        ``image_unreadable`` if a chunk, its checksum, its end or a row is missing; ``image_unsupported``,
        ``image_too_large``.
    """
    head = data[16:29]
    if len(data) < 33 or data[8:16] != b"\0\0\0\rIHDR":
        raise unreadable(name, "PNG, it does not begin with its header")
    width, height = int.from_bytes(head[:4], "big"), int.from_bytes(head[4:8], "big")
    depth, colour, interlaced = head[8], head[9], head[12]
    check_size(name, width, height)
    if depth not in _DEPTHS.get(colour, ()) or head[10] or head[11] or interlaced > 1:
        raise unreadable(name, "PNG, its header is altered")
    bits = depth * _CHANNELS[colour]
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = [(-(-(height - top) // down), -(-(width - left) // right)) for top, left, down, right in passes]
    expected = sum(rows * (1 + (cols * bits + 7) // 8) for rows, cols in sizes if rows > 0 and cols > 0)
    if expected > MAX_PNG_BYTES:
        raise too_large(f"The pixels of {name} have {expected} bytes; at most {MAX_PNG_BYTES} of a PNG are read.")
    parts, packed = _chunks(data, name)
    if colour == 3 and b"PLTE" not in parts:
        raise unreadable(name, "PNG, its palette is missing")
    kept = [(kind, parts[kind]) for kind in _KEPT if kind in parts]
    whole = bytearray(b"".join([PNG_HEAD, *(_chunk(*one) for one in [(b"IHDR", head), *kept])]))
    _store(packed, expected, name, whole)
    whole += _chunk(b"IEND", b"")
    # Pillow would cut colours of 16 bit to 8 without a word
    pixels = _deep_colour(whole, name) if depth == 16 and colour != 0 else _by_pillow(whole, name, "PNG")
    return upright(pixels, orientation_of(parts.get(_EXIF, b"")))


def _chunks(data: bytes, name: str) -> tuple[dict[bytes, bytes], list[memoryview]]:
    """Return the small chunks that matter and the compressed rows of a PNG whose checksums are right."""
    last = b""
    parts: dict[bytes, bytes] = {}
    packed: list[memoryview] = []
    at, view = len(PNG_HEAD), memoryview(data)
    while last != b"IEND":
        length = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 12 + length
        if len(data) < end or len(kind) < 4:
            raise unreadable(name, f"PNG, it ends inside a chunk at byte {at}, before its end mark")
        if zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise unreadable(name, f"PNG, the checksum of a chunk at byte {at} is wrong")
        if kind == b"IDAT":
            if packed and last != b"IDAT":
                raise unreadable(name, "PNG, its rows are parted by another chunk")
            packed.append(view[at + 8 : end - 4])
        elif kind in (b"IHDR", *_KEPT, _EXIF):
            if kind in parts or (length > 1024 and kind != _EXIF):
                raise unreadable(name, f"PNG, {kind.decode()} occurs twice or is too long")
            parts[kind] = data[at + 8 : end - 4]
        elif kind[0] & 32 == 0 and kind != b"IEND":
            raise unreadable(name, "PNG, it has a critical chunk that is not known")
        last, at = kind, end
    return parts, packed


def _store(packed: list[memoryview], expected: int, name: str, out: bytearray) -> None:
    """Append a PNG's rows as chunks without compression; exactly ``expected`` bytes of rows must be there."""
    inflate, store = zlib.decompressobj(), zlib.compressobj(0)
    found = 0
    try:
        # in pieces: what is not decompressed yet is copied each time
        for part in (one[k : k + _AT_ONCE] for one in packed for k in range(0, len(one), _AT_ONCE)):
            left: bytes | memoryview = part
            piece = bytes(_AT_ONCE)
            while (left or len(piece) == _AT_ONCE) and not inflate.eof:
                piece = inflate.decompress(left, _AT_ONCE)
                left = inflate.unconsumed_tail
                found += len(piece)
                if found > expected:
                    raise unreadable(name, f"PNG, it holds more than the {expected} bytes of its rows")
                if piece:
                    out += _chunk(b"IDAT", store.compress(piece))
    except zlib.error as error:
        raise unreadable(name, f"PNG, its rows are damaged ({error})") from error
    if not inflate.eof or found != expected:
        raise unreadable(name, f"PNG, it holds {found} of the {expected} bytes of its rows")
    out += _chunk(b"IDAT", store.flush())


def _chunk(kind: bytes, content: bytes) -> bytes:
    return b"".join(
        [len(content).to_bytes(4, "big"), kind, content, zlib.crc32(content, zlib.crc32(kind)).to_bytes(4, "big")]
    )


def decode_bmp(data: bytes, name: str) -> NDArray[Any]:
    """Return (rows, cols[, channels]) uint8 of a BMP; bool for one bit a pixel.

    Raises
    ------
    ImageError
        ``image_unreadable`` if rows are missing, or more bytes are there than its header gives; ``image_unsupported``,
        ``image_too_large``.
    """
    begin, head = (int.from_bytes(data[k : k + 4], "little") for k in (10, 14))
    if len(data) < 26 or (head != 12 and (head < 40 or len(data) < 54)) or begin < 14 + head:
        raise unreadable(name, "BMP, its header is cut or altered")
    if head == 12:
        width, height, bits = (int.from_bytes(data[k : k + 2], "little") for k in (18, 20, 24))
        packing = _BMP_PLAIN
    else:
        width, height = (int.from_bytes(data[k : k + 4], "little", signed=True) for k in (18, 22))
        bits, packing = int.from_bytes(data[28:30], "little"), int.from_bytes(data[30:34], "little")
        height = abs(height)  # negative where the first row is the top one
    check_size(name, width, height)
    if packing not in (_BMP_PLAIN, _BMP_MASKS) or bits not in _BMP_DEPTHS:
        raise unsupported(name, f"it is a BMP of {bits} bit, packed by the method {packing}")
    row = (width * bits + 31) // 32 * 4
    surplus = len(data) - begin - row * height
    colours = 0 if bits > 8 else (head > 12 and int.from_bytes(data[46:50], "little")) or 1 << bits
    first = 14 + head + colours * (3 if head == 12 else 4)
    if begin < first or surplus < 0 or (surplus > 3 and head < 124):  # from 124 bytes on a colour profile may follow
        raise unreadable(
            name, f"BMP, it has {len(data) - begin} bytes of pixels, and {height} rows have {row * height}"
        )
    return _by_pillow(data, name, "BMP")


def _by_pillow(data: bytes | bytearray, name: str, kind: str) -> NDArray[Any]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own limit was checked before
            with Image.open(io.BytesIO(data), formats=(kind,)) as image:
                if image.mode == "P":
                    image.load()
                    held = image.palette
                    if held is None or np.asarray(image).max() >= len(held.palette) // len(held.mode):
                        raise unreadable(name, f"{kind}, its palette has fewer colours than its pixels name")
                    return np.asarray(image.convert("RGBA" if "transparency" in image.info else "RGB"))
                if image.mode not in ("1", "L", "LA", "I;16", "I;16B", "I;16L", "I;16N", "RGB", "RGBA"):
                    raise unsupported(name, f"its pixel type is {image.mode!r}")
                pixels = np.asarray(image)
                return pixels.astype(np.uint16) if image.mode.startswith("I;16") else pixels
    except ImageError:
        raise
    except Exception as error:  # a damaged file can fail anywhere inside the reader
        raise unreadable(name, f"{type(error).__name__}, {error}") from error


def _deep_colour(data: bytearray, name: str) -> NDArray[Any]:
    """Return (rows, cols, 3 or 4) red, green, blue of a PNG in colour of 16 bit."""
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise unreadable(name, "PNG, it cannot be decoded") from error
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise unsupported(name, "it is a colour image of 16 bit that cannot be read")
    for row in pixels:  # in place, since an image may have a gigabyte
        row[:, :3] = row[:, 2::-1].copy()
    return np.asarray(pixels)
