"""Images of nine kinds, and ways to lose a part of each; truth is OpenCV's reading of the undamaged file."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable

import cv2
import numpy as np
import tifffile
from PIL import Image

SHAPE = (144, 176)
Damage = Callable[[bytes, np.random.Generator], bytes]


def _texture() -> np.ndarray:
    noise = np.random.default_rng(11).integers(0, 256, SHAPE).astype(np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)


def _tiff(image: np.ndarray, **options: object) -> bytes:
    out = io.BytesIO()
    tifffile.imwrite(out, image, photometric="minisblack", **options)
    return out.getvalue()


def _pillow(image: np.ndarray, form: str, **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image).save(out, form, **options)
    return out.getvalue()


GREY8 = _texture()
GREY16 = (GREY8.astype(np.uint16) << 8) + np.roll(GREY8, 7, 1)
KINDS: dict[str, bytes] = {
    "tiff": _tiff(GREY16, rowsperstrip=16),
    "tiff_tiles": _tiff(GREY8, tile=(48, 64), compression="zlib"),
    "tiff_lzw": _pillow(GREY8, "TIFF", compression="tiff_lzw", strip_size=16 * SHAPE[1]),
    "tiff_packbits": _pillow(GREY16, "TIFF", compression="packbits", strip_size=32 * SHAPE[1]),
    "png": cv2.imencode(".png", GREY8)[1].tobytes(),
    "png_16": _pillow(GREY16, "PNG"),
    "bmp": _pillow(GREY8, "BMP"),
    "jpeg": cv2.imencode(".jpg", GREY8, [cv2.IMWRITE_JPEG_RST_INTERVAL, 11])[1].tobytes(),
    "jpeg_progressive": _pillow(GREY8, "JPEG", progressive=True, quality=90),
}
PIXELS = {kind: cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) for kind, data in KINDS.items()}
_ENDS = {"png": b"\0\0\0\0IEND\xaeB`\x82", "jpe": b"\xff\xd9"}


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(1, len(data) - 1)]


def _cut_and_ended(end: bytes) -> Damage:
    return lambda data, rng: _cut(data, rng) + end


def _without_a_piece(data: bytes, rng: np.random.Generator) -> bytes:
    # some bytes less within a scan of JPEG may decode into as many blocks as before: it has no checksum
    least = 200 if data[:2] == b"\xff\xd8" else 1
    begin = int(rng.integers(2, len(data) - least - 2))
    return data[:begin] + data[begin + int(rng.integers(least, min(4000, len(data) - begin))) :]


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    changed[rng.integers(0, len(data))] ^= 1 << int(rng.integers(0, 8))
    return bytes(changed)


def png_of_rows(data: bytes, rows: bytes) -> bytes:
    """Return a PNG with other compressed rows, its checksums right."""
    parts = [(b"IHDR", data[16:29]), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    chunks = (struct.pack(">I", len(c)) + k + c + struct.pack(">I", zlib.crc32(k + c)) for k, c in parts)
    return data[:8] + b"".join(chunks)


def _png_with_other_rows(data: bytes, rng: np.random.Generator) -> bytes:
    width, depth = struct.unpack(">I", data[16:20])[0], data[24]
    row = 1 + width * depth // 8
    rows = bytes(row * SHAPE[0])
    count = int(rng.integers(0, 2 * SHAPE[0]))
    return png_of_rows(data, (rows * 2)[: row * (count + (count == SHAPE[0])) - int(rng.integers(0, 2))])


def tiff_tag(data: bytes, tag: int) -> tuple[int, str, int, int]:
    """Return byte order, type letter, count and place of the values of a tag in a small TIFF of little-endian order."""
    at = struct.unpack_from("<I", data, 4)[0]
    for k in range(struct.unpack_from("<H", data, at)[0]):
        found, kind, count = struct.unpack_from("<HHI", data, at + 2 + 12 * k)
        if found == tag:
            letter, place = {3: "H", 4: "I"}[kind], at + 10 + 12 * k
            if struct.calcsize(letter) * count > 4:
                place = struct.unpack_from("<I", data, place)[0]
            return at, letter, count, place
    raise KeyError(tag)


def _tiff_with_other_tag(data: bytes, rng: np.random.Generator) -> bytes:
    """One place, length or size of the image is another one."""
    size = () if _has(data, 324) else (256, 257)  # a tile may be wider than its image by any number
    tags = [tag for tag in (*size, 273, 279, 324, 325, 278) if _has(data, tag)]
    _, letter, count, place = tiff_tag(data, int(rng.choice(tags)))
    changed, long = bytearray(data), struct.calcsize(letter)
    k = place + long * int(rng.integers(0, count))
    old = struct.unpack_from("<" + letter, data, k)[0]
    new = [0, old // 2, old + 1, max(0, old - 1), old + 64, 2 * old, int(rng.integers(0, 65536))]
    new = [n for n in new if n != old]
    struct.pack_into("<" + letter, changed, k, min(int(rng.choice(new)), (1 << 8 * long) - 1))
    return bytes(changed)


def _tiff_with_fewer_parts(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for tag in (273, 279, 324, 325):
        if _has(data, tag):
            at = tiff_tag(data, tag)[0]
            k = next(at + 2 + 12 * k for k in range(50) if struct.unpack_from("<H", data, at + 2 + 12 * k)[0] == tag)
            count = struct.unpack_from("<I", data, k + 4)[0]
            struct.pack_into("<I", changed, k + 4, count - int(rng.integers(1, count)))
    return bytes(changed)


def _has(data: bytes, tag: int) -> bool:
    try:
        tiff_tag(data, tag)
    except KeyError:
        return False
    return True


def _bmp_with_other_head(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    place = int(rng.choice([10, 18, 22]))
    old = struct.unpack_from("<i", data, place)[0]
    # the last two bits of a width are open: a row has whole words
    struct.pack_into("<i", changed, place, int(rng.choice([old - 64, old + 7, old + 500, old // 2])))
    return bytes(changed)


def _jpeg_without_intervals(data: bytes, rng: np.random.Generator) -> bytes:
    marks = [k for k in range(len(data) - 1) if data[k] == 0xFF and 0xD0 <= data[k + 1] <= 0xD7]
    first, last = sorted(rng.choice(len(marks), 2, replace=False))
    return data[: marks[first]] + data[marks[last] :]


def _jpeg_without_scan(data: bytes, rng: np.random.Generator) -> bytes:
    scans = [k for k in range(len(data) - 1) if data[k : k + 2] == b"\xff\xda"]
    k = int(rng.integers(0, len(scans)))
    end = scans[k + 1] if k + 1 < len(scans) else len(data) - 2
    return data[: scans[k]] + data[end:]


def damages(kind: str) -> list[Damage]:
    """Return the ways in which a file of this kind may lose a part.

    A changed byte is among them only for kinds with checksums: the others hold nothing by which it could be known.
    """
    form = kind[:3]
    found: list[Damage] = [_cut, _without_a_piece]
    if form in _ENDS:
        found.append(_cut_and_ended(_ENDS[form]))
    if form == "png":
        found += [_flipped, _png_with_other_rows]
    if form == "tif":
        found += [_tiff_with_other_tag, _tiff_with_fewer_parts]
    if form == "bmp":
        found.append(_bmp_with_other_head)
    if kind == "jpeg":
        found.append(_jpeg_without_intervals)
    if kind == "jpeg_progressive":
        found.append(_jpeg_without_scan)
    return found
