"""TIFF: the tags of one image, and its strips or tiles put together; each must be there whole, with no byte more.

Read: 8, 12 (packed) and 16 bits a channel, one bit for masks; channels side by side or one plane after the other;
palettes; uncompressed, PackBits, LZW, Deflate, LZMA and JPEG; horizontal differences.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats.codecs.refusals import MAX_SIDE_PX, check_size, unreadable, unsupported
from stereorig.server.formats.codecs.segments import COMPRESSIONS, JPEG, WITH_DIFFERENCES, unpacked

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_FIXED = {1: "B", 3: "H", 4: "I", 6: "b", 7: "B", 13: "I", 16: "Q", 18: "Q"}  # types of the tags that are needed
_SUBFILE, _WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC, _ORDER = 254, 256, 257, 258, 259, 262, 266
_STRIPS, _SAMPLES, _ROWS, _STRIP_BYTES, _PLANAR, _PREDICTOR, _COLOURS = 273, 277, 278, 279, 284, 317, 320
_TILE_WIDTH, _TILE_LENGTH, _TILES, _TILE_BYTES, _FORMAT, _TABLES, _DEPTH = 322, 323, 324, 325, 339, 347, 32997
_ORIENTATION, _UPRIGHT = 274, 1
_DEFAULTS = {_SUBFILE: 0, _BITS: 1, _COMPRESSION: 1, _ORDER: 1, _SAMPLES: 1, _PLANAR: 1, _PREDICTOR: 1, _FORMAT: 1}
_DEFAULTS |= {_ORIENTATION: _UPRIGHT}
_KNOWN = {*_DEFAULTS, _WIDTH, _LENGTH, _PHOTOMETRIC, _STRIPS, _ROWS, _STRIP_BYTES, _COLOURS, _TILE_WIDTH, _TILE_LENGTH}
_KNOWN |= {_TILES, _TILE_BYTES, _TABLES, _DEPTH}
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE, YCBCR = 0, 1, 2, 3, 6
_MOSAICS = (32803, 34892)  # of colour filters, and what was made of them
_SPACES = {1: "MINISBLACK", 4: "MASK", 5: "SEPARATED", 8: "CIELAB", 9: "ICCLAB", 10: "ITULAB"}
_READ_BITS = (1, 8, 12, 16)
_MAX_PAGES = 4
_MAX_TAGS = 4096
_TILE_SLACK = 1 << 20  # pixels that the tiles of a small image may have beyond twice its own
_ROWS_AT_ONCE = 256
_MAX_PADDING = 3  # bytes that a writer may add so that the next strip begins at a whole word
_SMOOTH = 16.0  # largest mean step between neighbours of a table of false colours, of 255

Tags = dict[int, tuple[int, ...]]


@dataclass(frozen=True)
class _Layout:
    """Place and form of an image's parts.

    Attributes
    ----------
    width, height
        Size of the image, pixels.
    bits, channels, planes
        Bits a channel, channels side by side, and planes one after the other.
    part_width, part_height
        Size of a strip or tile, pixels; the last strip has the rows that are left.
    tiled
        True for tiles, which are whole at the edges too.
    """

    width: int
    height: int
    bits: int
    channels: int
    planes: int
    part_width: int
    part_height: int
    tiled: bool

    @property
    def row_bytes(self) -> int:
        """Bytes of a row of one part."""
        return (self.part_width * self.channels * self.bits + 7) // 8

    def parts(self) -> Iterator[tuple[int, int, int, int]]:
        """Yield plane, first row, first column and stored rows of each part, in the file's order."""
        tops, lefts = range(0, self.height, self.part_height), range(0, self.width, self.part_width)
        for plane, top, left in itertools.product(range(self.planes), tops, lefts):
            yield plane, top, left, self.part_height if self.tiled else min(self.part_height, self.height - top)

    def __len__(self) -> int:
        return self.planes * -(-self.height // self.part_height) * -(-self.width // self.part_width)


def decode_tiff(data: bytes, name: str) -> tuple[NDArray[Any], str, int]:
    """Decode a TIFF of one image.

    Returns
    -------
    tuple
        (rows, cols[, channels]) uint8 or uint16, bool for one bit a pixel; the name of its colours, ``RGB`` or another;
        and the bits a channel.

    Raises
    ------
    ImageError
        ``image_unreadable`` if a part is missing, shorter or longer than its place; ``image_unsupported``,
        ``image_too_large``.
    """
    try:
        pages = [tags for tags in _pages(data) if not _one(tags, _SUBFILE) & 1]  # without reduced copies
    except (struct.error, IndexError, OverflowError) as error:
        raise unreadable(name, "TIFF, its tags are cut or altered") from error
    if not pages:
        raise unreadable(name, "it holds no image")
    if len(pages) > 1:
        raise unsupported(name, "it holds more than one image")
    tags = pages[0]
    layout = _layout(tags, name)
    kind = _one(tags, _PHOTOMETRIC)
    pixels = _assembled(data, tags, layout, name)
    if kind == PALETTE:
        pixels = _by_table(pixels, tags, layout, name)
        return _turned(pixels, tags, name), "RGB", 8 * pixels.itemsize
    if kind == WHITE_IS_ZERO:
        pixels = ~pixels if layout.bits == 1 else (1 << layout.bits) - 1 - pixels
    space = (
        "RGB" if kind == RGB or (kind == YCBCR and _one(tags, _COMPRESSION) == JPEG) else str(_SPACES.get(kind, kind))
    )
    return _turned(pixels, tags, name), space, layout.bits


def _turned(pixels: NDArray[Any], tags: Tags, name: str) -> NDArray[Any]:
    orientation = _one(tags, _ORIENTATION)
    if not 1 <= orientation <= 8:
        raise unreadable(name, f"TIFF, its orientation is {orientation}")
    return upright(pixels, orientation)


def upright(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Return pixels whose first row is the top one and first column the left one, as other readers give them."""
    if orientation == _UPRIGHT:
        return pixels
    if orientation > 4:
        pixels = np.swapaxes(pixels, 0, 1)
    rows, cols = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return np.ascontiguousarray(pixels[:: -1 if rows else 1, :: -1 if cols else 1])


def orientation_of(exif: bytes) -> int:
    """Return the orientation, 1 to 8, that the EXIF data of a JPEG or PNG state; 1 if they state none of these."""
    try:
        pages = _pages(exif) if exif[:4] in MAGIC else []
    except (struct.error, IndexError, OverflowError):  # no more is needed of them, and the pixels are whole
        pages = []
    orientation = _one(pages[0], _ORIENTATION) if pages else _UPRIGHT
    return orientation if 1 <= orientation <= 8 else _UPRIGHT


def _pages(data: bytes) -> list[Tags]:
    """Return the tags of the first images of a file, without their copies of smaller size."""
    order = "<" if data[:2] == b"II" else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    at = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)[0]
    found: list[Tags] = []
    while at and len(found) < _MAX_PAGES:
        count = struct.unpack_from(order + ("Q" if big else "H"), data, at)[0]
        if count > _MAX_TAGS:
            raise OverflowError
        size, inside, form = (20, 8, "HHQ") if big else (12, 4, "HHI")
        begin = at + (8 if big else 2)
        tags: Tags = {0: (at, begin + count * size)}
        for k in range(begin, begin + count * size, size):
            tag, kind, number = struct.unpack_from(order + form, data, k)
            if tag in tags:
                raise IndexError
            if tag not in _KNOWN or kind not in _FIXED or not number:
                continue
            letter = _FIXED[kind]
            long = struct.calcsize("=" + letter) * number
            place = k + size - inside
            if long > inside:
                place = struct.unpack_from(order + ("Q" if big else "I"), data, place)[0]
            if place + long > len(data):
                raise IndexError
            tags[tag] = struct.unpack_from(f"{order}{number}{letter}", data, place)
        found.append(tags)
        at = struct.unpack_from(order + ("Q" if big else "I"), data, begin + count * size)[0]
    return found


def _one(tags: Tags, tag: int) -> int:
    values = tags.get(tag) or (_DEFAULTS.get(tag, -1),)
    return values[0]


def _layout(tags: Tags, name: str) -> _Layout:
    """Return the layout, once all that the tags state was found to be read here."""
    width, height, channels = _one(tags, _WIDTH), _one(tags, _LENGTH), _one(tags, _SAMPLES)
    check_size(name, width, height)
    bits, forms = set(tags.get(_BITS, (1,))), set(tags.get(_FORMAT, (1,)))
    if forms != {1} or len(bits) != 1 or not bits <= set(_READ_BITS):
        kinds = {1: "whole numbers", 2: "signed numbers", 3: "floating-point numbers"}
        held = " and ".join(kinds.get(one, "of an unknown type") for one in sorted(forms))
        raise unsupported(name, f"its pixels are {held} of {', '.join(map(str, sorted(bits)))} bit")
    if not 1 <= channels <= 4 or len(tags.get(_BITS, (1,))) not in (1, channels):
        raise unsupported(name, f"it has {channels} channels")
    packing, kind, predictor = _one(tags, _COMPRESSION), _one(tags, _PHOTOMETRIC), _one(tags, _PREDICTOR)
    depth, depths = bits.pop(), (8, 16)
    if packing not in COMPRESSIONS:
        raise unsupported(name, f"it is compressed by the method {packing}")
    if packing == JPEG and depth != 8:
        raise unsupported(name, f"it is compressed by JPEG with {depth} bit")
    if predictor != 1 and not (predictor == 2 and packing in WITH_DIFFERENCES and depth in depths):
        raise unsupported(name, f"it holds differences of the kind {predictor} in {depth} bit, compression {packing}")
    if _one(tags, _ORDER) != 1 or tags.get(_DEPTH, (1,))[0] != 1:
        raise unsupported(name, "its bits are in reverse order, or it is a volume")
    if kind in _MOSAICS:
        raise unsupported(name, "it is a camera's raw mosaic of colours")
    if kind == YCBCR and packing != JPEG:
        raise unsupported(name, "its colours are YCBCR, not RGB")
    if kind == PALETTE and (channels != 1 or depth != 8):
        raise unsupported(name, f"its palette is of {channels} channels and {depth} bit")
    if depth in (1, 12) and channels != 1:
        raise unsupported(name, f"it has {channels} channels of {depth} bit")
    planes = channels if _one(tags, _PLANAR) == 2 else 1
    if _one(tags, _PLANAR) not in (1, 2):
        raise unreadable(name, "TIFF, the order of its channels is altered")
    tiled = _TILE_WIDTH in tags or _TILES in tags
    if tiled:
        across, down = _one(tags, _TILE_WIDTH), _one(tags, _TILE_LENGTH)
        if min(across, down) < 16 or across % 16 or down % 16 or across * down > 2 * width * height + _TILE_SLACK:
            raise unreadable(name, f"TIFF, its tiles are {across} x {down} px")
    else:
        across, down = width, min(tags.get(_ROWS, (height,))[0], height)
        if down < 1:
            raise unreadable(name, "TIFF, its strips have no rows")
    return _Layout(width, height, depth, channels // planes, planes, min(across, 2 * MAX_SIDE_PX), down, tiled)


def _places(data: bytes, tags: Tags, layout: _Layout, name: str) -> list[tuple[int, int]]:
    """Return the offset and length of each part, after checking that all are in the file and do not overlap."""
    offsets = tags.get(_TILES if layout.tiled else _STRIPS, ())
    counts = tags.get(_TILE_BYTES if layout.tiled else _STRIP_BYTES, ())
    if not len(offsets) == len(counts) == len(layout):
        raise unreadable(
            name,
            f"TIFF, it has {len(offsets)} places and {len(counts)} lengths of the {len(layout)} parts of its image",
        )
    if min(counts) <= 0 or min(offsets) < 8:
        raise unreadable(name, "TIFF, a part of it is missing")
    taken = np.array(sorted([*zip(offsets, counts, strict=True), (tags[0][0], tags[0][1] - tags[0][0])]), dtype=object)
    if (taken[:-1].sum(axis=1) > taken[1:, 0]).any():
        raise unreadable(name, "TIFF, two parts of it overlap")
    ends = max(offset + count for offset, count in zip(offsets, counts, strict=True))
    if ends > len(data):
        raise unreadable(name, f"it is truncated ({len(data)} bytes, {ends} expected)")
    return list(zip(offsets, counts, strict=True))


def _assembled(data: bytes, tags: Tags, layout: _Layout, name: str) -> NDArray[Any]:
    """Return (rows, cols) or (rows, cols, channels) of the parts."""
    places = _places(data, tags, layout, name)
    packing, differences = _one(tags, _COMPRESSION), _one(tags, _PREDICTOR) == 2
    rows = [stored for _, _, _, stored in layout.parts()]
    view = memoryview(data)
    row_bytes, padding = layout.row_bytes, _MAX_PADDING if packing == 1 else 0
    for stored, (_, count) in zip(rows, places, strict=True):
        if packing == 1 and not 0 <= count - stored * row_bytes <= min(padding, row_bytes - 1):
            raise unreadable(name, f"TIFF, a part has {count} bytes, its {stored} rows have {stored * row_bytes}")
    dtype: np.dtype[Any] = np.dtype({1: np.bool_, 8: np.uint8}.get(layout.bits, np.uint16))
    out = np.empty((layout.height, layout.width, layout.channels * layout.planes), dtype)
    raw = (view[offset : offset + count] for offset, count in places)
    tables = bytes(tags.get(_TABLES, ()))
    parts = unpacked(raw, packing, rows, row_bytes, name, tables=tables, of_rgb=_one(tags, _PHOTOMETRIC) == RGB)
    stored_type = np.dtype(">u2" if data[:2] == b"MM" else "<u2")
    for (plane, top, left, _), part in zip(layout.parts(), parts, strict=True):
        high, wide = min(layout.part_height, layout.height - top), min(layout.part_width, layout.width - left)
        grid = np.frombuffer(part, np.uint8, high * row_bytes).reshape(high, row_bytes)
        first = plane if layout.planes > 1 else 0
        into = out[top : top + high, left : left + wide, first : first + layout.channels]
        for k in range(0, high, _ROWS_AT_ONCE):
            band = _numbers(grid[k : k + _ROWS_AT_ONCE], layout, stored_type)
            if differences:
                band = np.add.accumulate(band, axis=1, dtype=dtype)
            into[k : k + _ROWS_AT_ONCE] = band[:, :wide]
    return out[..., 0] if out.shape[2] == 1 else out


def _numbers(rows: NDArray[np.uint8], layout: _Layout, stored: np.dtype[Any]) -> NDArray[Any]:
    """Return (rows, cols, channels) of packed rows."""
    shape = (len(rows), layout.part_width, layout.channels)
    if layout.bits == 1:
        return np.unpackbits(rows, axis=1)[:, : layout.part_width].reshape(shape).astype(np.bool_)
    if layout.bits == 12:
        whole = np.zeros((len(rows), -(-rows.shape[1] // 3) * 3), np.uint16)
        whole[:, : rows.shape[1]] = rows
        a, b, c = whole[:, 0::3], whole[:, 1::3], whole[:, 2::3]
        pairs = np.stack([a << 4 | b >> 4, (b & 15) << 8 | c], axis=2).reshape(len(rows), -1)
        return pairs[:, : layout.part_width].reshape(shape)
    return (rows if layout.bits == 8 else rows.view(stored)).reshape(shape)


def _by_table(indices: NDArray[Any], tags: Tags, layout: _Layout, name: str) -> NDArray[Any]:
    """Return grey levels, or colours (rows, cols, 3), by a palette's table."""
    table = np.array(tags.get(_COLOURS, ()), dtype=np.int64)
    if table.size != 3 << layout.bits or table.min() < 0 or table.max() > 65535:
        raise unreadable(name, f"TIFF, its palette has {table.size} numbers, not {3 << layout.bits}")
    table = table.reshape(3, -1).T * (257 if table.max() < 256 else 1)  # some writers state 8 bits
    used = table[np.unique(indices)]
    grey = bool((used == used[:, :1]).all())
    if not grey and np.abs(np.diff(table, axis=0)).mean() < _SMOOTH * 257:
        raise unsupported(name, "its palette paints false colours: its numbers may be meant, or the colours")
    short = next((step for step in (257, 256) if not (used % step).any()), None)
    levels = table.astype(np.uint16) if short is None else (table // short).astype(np.uint8)
    return np.asarray(levels[indices, 0] if grey else levels[indices])
