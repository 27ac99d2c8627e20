"""Pixel formats that carry brightness, and their conversion to right-aligned gray values.

Byte layouts follow the kernel's documentation (luma-only formats, packed and semi-planar YUV). Colour patterns (Bayer),
RGB and compressed formats are left out on purpose: they do not deliver the measured brightness.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.drivers.cameras.protocol import Pixels

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class GrayFormat:
    """One pixel format with a brightness that can be read.

    Attributes
    ----------
    code
        The kernel's four characters as a number; bit 31: big-endian.
    bit_depth
        Significant bits a pixel.
    group_px, group_bytes
        The smallest whole group of pixels in a line, and its bytes.
    unpack
        Lines of bytes, shape (rows, whole groups), to pixels, at least as many as the line has.
    more_rows
        Lines of colour behind the brightness in the same memory, as a part of its own.
    colour
        True if the sensor's pixels or the device's conversion also carry colour.
    """

    code: int
    bit_depth: int
    group_px: int
    group_bytes: int
    unpack: Callable[[Bytes], Pixels]
    more_rows: float = 0.0
    colour: bool = False

    @property
    def name(self) -> str:
        """The four characters as the kernel's tools write them: ``Y16 `` and, big-endian, ``Y16 -BE``."""
        return fourcc_name(self.code)

    def row_bytes(self, width: int) -> int:
        """Bytes of one line without padding."""
        return -(-width // self.group_px) * self.group_bytes

    def image_bytes(self, width: int, height: int, stride: int) -> int:
        """Fewest bytes that a whole image has, colour included, its last line without padding."""
        rows = height + int(height * self.more_rows)
        return stride * (rows - 1) + self.row_bytes(width)

    def pixels(self, memory: Bytes, width: int, height: int, stride: int) -> Pixels:
        """Copy the brightness out of a buffer."""
        lines = np.lib.stride_tricks.as_strided(
            memory[: stride * (height - 1) + self.row_bytes(width)],
            (height, self.row_bytes(width)),
            (stride, 1),
            writeable=False,
        )
        found: NDArray[Any] = self.unpack(lines)[:, :width]
        return np.ascontiguousarray(found)


def _fourcc(name: str, *, big_endian: bool = False) -> int:
    return int.from_bytes(name.encode("ascii"), "little") | (1 << 31 if big_endian else 0)


def fourcc_name(code: int) -> str:
    """Four characters of a format's number, with ``-BE`` if it is marked big-endian."""
    text = (code & 0x7FFF_FFFF).to_bytes(4, "little").decode("ascii", "replace")
    return text + ("-BE" if code >> 31 else "")


def _bytes(lines: Bytes) -> Pixels:
    return lines.copy()


def _even(lines: Bytes) -> Pixels:
    return lines[:, 0::2].copy()


def _odd(lines: Bytes) -> Pixels:
    return lines[:, 1::2].copy()


def _words(lines: Bytes) -> NDArray[np.uint16]:
    # always a copy: the device writes into the buffer again, and its stride need not be even
    return lines.copy().view("<u2").astype(np.uint16, copy=False)


def _big_words(lines: Bytes) -> Pixels:
    return np.ascontiguousarray(lines).view(">u2").astype(np.uint16)


def _high_words(unused_bits: int) -> Callable[[Bytes], Pixels]:
    return lambda lines: _words(lines) >> np.uint16(unused_bits)


def _groups(lines: Bytes, size: int) -> Bytes:
    return np.ascontiguousarray(lines).reshape(lines.shape[0], -1, size)


def _joined(high: Bytes, shift: int, low: list[NDArray[np.uint8]]) -> NDArray[np.uint16]:
    """Put the high bits of each group's pixels above their low bits."""
    out = np.empty(high.shape, np.uint16)
    out[...] = high
    out <<= np.uint16(shift)
    for index, bits in enumerate(low):
        out[..., index] |= bits
    return out.reshape(high.shape[0], -1)


def _mipi10(lines: Bytes) -> Pixels:
    b = _groups(lines, 5)
    low = b[..., 4].copy()
    return _joined(b[..., :4], 2, [low >> np.uint8(2 * i) & np.uint8(3) for i in range(4)])


def _mipi12(lines: Bytes) -> Pixels:
    b = _groups(lines, 3)
    low = b[..., 2].copy()
    return _joined(b[..., :2], 4, [low & np.uint8(15), low >> np.uint8(4)])


def _mipi14(lines: Bytes) -> Pixels:
    b = _groups(lines, 7)
    p, q, r = (b[..., i].copy() for i in (4, 5, 6))
    low = [
        p & np.uint8(63),
        p >> np.uint8(6) | (q & np.uint8(15)) << np.uint8(2),
        q >> np.uint8(4) | (r & np.uint8(3)) << np.uint8(4),
        r >> np.uint8(2),
    ]
    return _joined(b[..., :4], 6, low)


def _dense10(lines: Bytes) -> Pixels:
    """Bits in the order of the pixels, highest first."""
    b = _groups(lines, 5)
    out = np.empty((*b.shape[:2], 4), np.uint16)
    for i in range(4):
        # the pixel's high bits end its first byte, its low bits begin the next one
        out[..., i] = b[..., i] & np.uint8(255 >> 2 * i)
        out[..., i] <<= np.uint16(2 * i + 2)
        out[..., i] |= b[..., i + 1] >> np.uint8(6 - 2 * i)
    return out.reshape(b.shape[0], -1)


def _ipu3_10(lines: Bytes) -> Pixels:
    """25 pixels in 32 bytes, lowest bits first; the last 6 bits are empty."""
    b = _groups(lines, 32)
    rows, groups = b.shape[:2]
    five = b[..., :30].reshape(rows, groups, 6, 5)
    out = np.empty((rows, groups, 25), np.uint16)
    four = np.empty((rows, groups, 6, 4), np.uint16)
    for i in range(4):
        four[..., i] = five[..., i + 1] & np.uint8((1 << 2 * i + 2) - 1)
        four[..., i] <<= np.uint16(8 - 2 * i)
        four[..., i] |= five[..., i] >> np.uint8(2 * i)
    out[..., :24] = four.reshape(rows, groups, 24)
    out[..., 24] = b[..., 31] & np.uint8(3)
    out[..., 24] <<= np.uint16(8)
    out[..., 24] |= b[..., 30]
    return out.reshape(rows, -1)


#: from the plainest to those that must be unpacked or carry colour: the first that fits is taken
GRAY_FORMATS: tuple[GrayFormat, ...] = (
    GrayFormat(_fourcc("GREY"), 8, 1, 1, _bytes),
    GrayFormat(_fourcc("Y10 "), 10, 1, 2, _words),
    GrayFormat(_fourcc("Y12 "), 12, 1, 2, _words),
    GrayFormat(_fourcc("Y14 "), 14, 1, 2, _words),
    GrayFormat(_fourcc("Y16 "), 16, 1, 2, _words),
    GrayFormat(_fourcc("Y16 ", big_endian=True), 16, 1, 2, _big_words),
    GrayFormat(_fourcc("Y012"), 12, 1, 2, _high_words(4)),
    GrayFormat(_fourcc("Y10P"), 10, 4, 5, _mipi10),
    GrayFormat(_fourcc("Y12P"), 12, 2, 3, _mipi12),
    GrayFormat(_fourcc("Y14P"), 14, 4, 7, _mipi14),
    GrayFormat(_fourcc("Y10B"), 10, 4, 5, _dense10),
    GrayFormat(_fourcc("ip3y"), 10, 25, 32, _ipu3_10),
    GrayFormat(_fourcc("NV16"), 8, 1, 1, _bytes, more_rows=1.0, colour=True),
    GrayFormat(_fourcc("NV61"), 8, 1, 1, _bytes, more_rows=1.0, colour=True),
    GrayFormat(_fourcc("NV12"), 8, 1, 1, _bytes, more_rows=0.5, colour=True),
    GrayFormat(_fourcc("NV21"), 8, 1, 1, _bytes, more_rows=0.5, colour=True),
    GrayFormat(_fourcc("NM16"), 8, 1, 1, _bytes, colour=True),
    GrayFormat(_fourcc("NM61"), 8, 1, 1, _bytes, colour=True),
    GrayFormat(_fourcc("NM12"), 8, 1, 1, _bytes, colour=True),
    GrayFormat(_fourcc("NM21"), 8, 1, 1, _bytes, colour=True),
    GrayFormat(_fourcc("YUYV"), 8, 2, 4, _even, colour=True),
    GrayFormat(_fourcc("YVYU"), 8, 2, 4, _even, colour=True),
    GrayFormat(_fourcc("UYVY"), 8, 2, 4, _odd, colour=True),
    GrayFormat(_fourcc("VYUY"), 8, 2, 4, _odd, colour=True),
    GrayFormat(_fourcc("P010"), 10, 1, 2, _high_words(6), more_rows=0.5, colour=True),
)

BY_CODE = {known.code: known for known in GRAY_FORMATS}


def find_format(text: str, among: Iterable[GrayFormat]) -> GrayFormat | None:
    """Find a format by its name; blanks at the end may be left out, and big-endian may be written ``Y16_BE``."""
    wanted = text.strip().replace("_BE", "-BE").replace(" ", "")
    for known in among:
        if known.name.replace(" ", "") == wanted:
            return known
    return None
