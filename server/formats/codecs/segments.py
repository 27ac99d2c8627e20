"""Strips and tiles of a TIFF, decompressed to exactly the bytes of their rows.

LZW is libtiff's work. It gets each part as a strip of plain bytes, so that it decides nothing but the compression; it
stops when the rows are full, so surplus bytes of the last part are counted here.
"""

from __future__ import annotations

import io
import lzma
import struct
import warnings
import zlib
from collections.abc import Iterable, Iterator
from itertools import groupby

import numpy as np
from PIL import Image

from stereorig.server.formats.codecs.jpeg import decode_jpeg
from stereorig.server.formats.codecs.refusals import too_large, unreadable

NONE, _LZW, JPEG, _DEFLATE, _DEFLATE_OLD, _PACKBITS, _LZMA = 1, 5, 7, 8, 32946, 32773, 34925
COMPRESSIONS = (NONE, _LZW, JPEG, _DEFLATE, _DEFLATE_OLD, _PACKBITS, _LZMA)
WITH_DIFFERENCES = (_LZW, _DEFLATE, _DEFLATE_OLD, _LZMA)
_AT_ONCE = 16 << 20  # bytes that libtiff unpacks in one call
_MOST_IN_A_PART = 160 << 20  # more would take Pillow's guard against bombs, which is of the whole program
_CLEAR, _END = 256, 257
_LZW_WIDTHS = np.repeat(np.arange(9, 13), (254, 512, 1024, 2304))  # of the codes after the table was cleared
_LZW_BEGINS = np.cumsum(_LZW_WIDTHS) - _LZW_WIDTHS
_MAX_LZMA_BYTES = 128 << 20  # memory of a decoder; xz's highest preset needs half of it
_NOT_YCBCR = b"\xff\xee\0\x0eAdobe\0\x64\0\0\0\0\0"  # a mark that the channels are no luminance and chroma


def unpacked(
    parts: Iterable[memoryview],
    packing: int,
    rows: list[int],
    row_bytes: int,
    name: str,
    tables: bytes,
    *,
    of_rgb: bool,
) -> Iterator[bytes | memoryview]:
    """Yield the rows of each part as bytes.

    Parameters
    ----------
    parts
        The parts as stored.
    rows
        Number of rows of each part.
    tables
        JPEG tables, which the parts share.
    of_rgb
        True if JPEG holds red, green and blue as they are.

    Raises
    ------
    ImageError
        ``image_unreadable`` if a part is damaged, or holds other than its rows.
    """
    if packing == _LZW:
        yield from _by_libtiff(list(parts), rows, row_bytes, name)
        return
    for part, count in zip(parts, rows, strict=True):
        if packing == NONE:
            yield part
        elif packing == JPEG:
            yield _by_jpeg(part, count, row_bytes, name, tables, of_rgb=of_rgb)
        elif packing == _PACKBITS:
            yield _runs(part, count * row_bytes, name)
        else:
            yield _inflated(part, packing, count * row_bytes, name)


def _inflated(part: memoryview, packing: int, expected: int, name: str) -> bytes:
    ended = False
    try:
        if packing == _LZMA:
            alone = lzma.LZMADecompressor(memlimit=_MAX_LZMA_BYTES)
            found = alone.decompress(part, expected + 1)
            if len(found) == expected and not alone.eof:  # its end and checksum may be left to read
                found += alone.decompress(b"", 1)
            ended = alone.eof
        else:
            made = zlib.decompressobj()
            found = made.decompress(part, expected + 1)
            if len(found) == expected and not made.eof:
                found += made.decompress(made.unconsumed_tail, 1)
            ended = made.eof
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise unreadable(name, f"TIFF, a part is damaged ({error})") from error
    if len(found) != expected or not ended:
        raise unreadable(name, f"TIFF, a part does not hold the {expected} bytes of its rows")
    return found


def _by_jpeg(part: memoryview, rows: int, row_bytes: int, name: str, tables: bytes, *, of_rgb: bool) -> bytes:
    whole = bytes(part)
    if tables:  # a JPEG file of its own without a scan
        whole = tables.removesuffix(b"\xff\xd9") + whole[2:]
    if of_rgb:
        whole = whole[:2] + _NOT_YCBCR + whole[2:]
    pixels, _ = decode_jpeg(whole, name)  # the tags of the TIFF turn it
    if pixels.shape[0] != rows or pixels.size != rows * row_bytes:
        raise unreadable(name, "TIFF, a part is a JPEG of another size")
    return pixels.tobytes()


def _runs(part: memoryview, expected: int, name: str) -> bytes:
    out, at = bytearray(), 0
    while at < len(part) and len(out) <= expected:
        count, at = part[at], at + 1
        if count < 128:
            out += part[at : at + count + 1]
            at += count + 1
        elif count > 128:
            out += bytes(part[at : at + 1]) * (257 - count)
            at += 1
    if len(out) != expected or at > len(part):
        raise unreadable(name, f"TIFF, a part does not hold the {expected} bytes of its rows")
    return bytes(out)


def _by_libtiff(parts: list[memoryview], rows: list[int], row_bytes: int, name: str) -> Iterator[memoryview]:
    if row_bytes * max(rows) > _MOST_IN_A_PART:
        raise too_large(f"{name} has strips or tiles of {row_bytes * max(rows)} bytes, compressed by LZW.")
    if _lzw_bytes(parts[-1], rows[-1] * row_bytes) != rows[-1] * row_bytes:
        raise unreadable(name, f"TIFF, its last part does not hold the {rows[-1] * row_bytes} bytes of its rows")
    per_call = max(1, _AT_ONCE // (row_bytes * max(rows)))
    for count, numbers in groupby(range(len(parts)), key=rows.__getitem__):
        alike = list(numbers)
        for k in range(0, len(alike), per_call):
            some = [parts[n] for n in alike[k : k + per_call]]
            try:
                found = memoryview(_libtiff_rows(some, count, row_bytes))
            except OSError as error:
                raise unreadable(name, "TIFF, a part is damaged, or does not hold its rows") from error
            for n in range(len(some)):
                yield found[n * count * row_bytes : (n + 1) * count * row_bytes]


def _lzw_bytes(part: memoryview, most: int) -> int:
    """Return the bytes that LZW data make, or more than ``most`` of them; -1 for data that no encoder writes.

    Between two codes that clear the table, the width of a code follows from its number. A code beyond the bytes is a
    byte more than the code that it was made from, which came before it.
    """
    data = np.concatenate([np.frombuffer(part, np.uint8), np.zeros(3, np.uint8)]).astype(np.uint32)
    at, found = 0, 0
    while found <= most:
        begin = at + _LZW_BEGINS[: np.searchsorted(at + _LZW_BEGINS + _LZW_WIDTHS, 8 * len(part), side="right")]
        widths, byte = _LZW_WIDTHS[: len(begin)], begin >> 3
        three = data[byte] << 16 | data[byte + 1] << 8 | data[byte + 2]
        codes = (three >> (24 - widths - (begin & 7))) & ((1 << widths) - 1)
        marks = np.flatnonzero((codes == _CLEAR) | (codes == _END))
        count = int(marks[0]) if marks.size else len(codes)
        made_from = codes[:count] - 258
        if (made_from >= np.arange(count)).any():
            return -1
        longer = (made_from >= 0).astype(np.int64)
        while (more := np.flatnonzero(made_from >= 0)).size:
            longer[more] += longer[made_from[more]]
            made_from[more] = made_from[made_from[more]]
        found += count + int(longer.sum())
        if not marks.size or codes[count] == _END:
            return found if len(codes) < len(_LZW_BEGINS) or marks.size else -1
        at = int(begin[count] + widths[count])
    return found


def _libtiff_rows(parts: list[memoryview], rows: int, row_bytes: int) -> bytes:
    """Return the bytes of parts of as many rows each, decompressed as one image of 8 bit."""
    n, at = len(parts), 8
    offsets = []
    for part in parts:
        offsets.append(at)
        at += len(part)
    at += at % 2
    tags = [(256, 1, row_bytes), (257, 1, rows * n), (258, 1, 8), (259, 1, _LZW), (262, 1, 1)]
    tags += [(273, n, offsets[0]), (277, 1, 1), (278, 1, rows), (279, n, len(parts[0]))]
    lists, after = b"", at + 2 + 12 * len(tags) + 4
    packed = []
    for tag, count, value in tags:
        if count > 1:
            long = offsets if tag == 273 else [len(part) for part in parts]
            value = after + len(lists)
            lists += struct.pack(f"<{n}I", *long)
        packed.append(struct.pack("<HHII", tag, 4, count, value))
    pad = b"\0" * (at - offsets[-1] - len(parts[-1]))
    head = struct.pack("<2sHI", b"II", 42, at)
    file = b"".join([head, *parts, pad, struct.pack("<H", len(tags)), *packed, bytes(4), lists])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Pillow: a large image, or tags that it finds odd
        with Image.open(io.BytesIO(file), formats=("TIFF",)) as image:
            return image.tobytes()
