"""Gray values, right-aligned in uint8 or uint16, from the bytes that a GenICam camera sends.

Names and codes follow the Pixel Format Naming Convention (PFNC). Layouts, with ``P`` a pixel and the highest bit
written first:

========================  ==============================================================================================
``Mono8``                 one byte a pixel
``Mono10/12/14/16``       two bytes a pixel, little-endian, significant bits right-aligned
``Mono10p/12p/14p``       one stream of bits, the lowest first: pixel i fills bits ``n i`` to ``n i + n - 1``, bit b
                          lies in byte ``b // 8`` at bit ``b % 8``
``Mono12Packed``          GigE Vision 1.x, two pixels in three bytes: ``P0[11..4]``, ``P1[3..0] P0[3..0]``,
                          ``P1[11..4]``
``Mono10Packed``          GigE Vision 1.x, two pixels in three bytes: ``P0[9..2]``, ``- - P1[1..0] - - P0[1..0]``,
                          ``P1[9..2]``
========================  ==============================================================================================

Packed pixels run on from the end of one line into the next, also within a byte, unless lines are padded: then each line
begins at a byte of its own. It shows in the camera's line padding, or in as many bytes as whole lines need; if both
ways give the same number of bytes, they run on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.protocol import Pixels

# Groups that are unpacked at a time: few enough to stay in the processor's cache, which makes it three times as fast
_BLOCK = 2**16

Layout = Literal["bytes", "words", "lsb", "msb"]


@dataclass(frozen=True)
class PixelFormat:
    """Layout of gray values in a camera's bytes.

    Attributes
    ----------
    name, code
        As PFNC has them.
    bit_depth
        Significant bits of a pixel.
    bits
        Bits that a pixel takes on the wire.
    layout
        ``bytes`` and ``words`` hold one pixel each; ``lsb`` is a stream of bits, the lowest first (``Mono12p``);
        ``msb`` the older pairs of three bytes (``Mono12Packed``).
    """

    name: str
    code: int
    bit_depth: int
    bits: int
    layout: Layout

    def size_bytes(self, pixels: int) -> int:
        """Return the bytes that so many pixels in one run take."""
        return -(-pixels * self.bits // 8)

    def blank(self, width: int, height: int) -> Pixels:
        """Return an image without any light, for a frame that is not whole."""
        size = height, width
        return np.zeros(size, np.uint8) if self.bit_depth <= 8 else np.zeros(size, np.uint16)


#: From plain to packed: where several carry as many bits, the first costs the least to read.
FORMATS = (
    PixelFormat("Mono8", 0x01080001, 8, 8, "bytes"),
    PixelFormat("Mono10", 0x01100003, 10, 16, "words"),
    PixelFormat("Mono10p", 0x010A0046, 10, 10, "lsb"),
    PixelFormat("Mono10Packed", 0x010C0004, 10, 12, "msb"),
    PixelFormat("Mono12", 0x01100005, 12, 16, "words"),
    PixelFormat("Mono12p", 0x010C0047, 12, 12, "lsb"),
    PixelFormat("Mono12Packed", 0x010C0006, 12, 12, "msb"),
    PixelFormat("Mono14", 0x01100025, 14, 16, "words"),
    PixelFormat("Mono14p", 0x010E0104, 14, 14, "lsb"),
    PixelFormat("Mono16", 0x01100007, 16, 16, "words"),
)
BY_NAME = {known.name: known for known in FORMATS}
BY_CODE = {known.code: known for known in FORMATS}


def unpack(
    data: NDArray[np.uint8], pixel_format: PixelFormat, width: int, height: int, *, line_padding_bytes: int = 0
) -> Pixels:
    """Return the image that the bytes hold, in memory of its own.

    Parameters
    ----------
    data
        The image as it came; bytes after its end are ignored.
    pixel_format
        One of `FORMATS`.
    width, height
        Pixels of the image.
    line_padding_bytes
        Bytes that follow each line.

    Raises
    ------
    CameraError
        ``frame_format`` when there are fewer bytes than the image needs.
    """
    line = pixel_format.size_bytes(width)
    stride = line + line_padding_bytes
    run = pixel_format.size_bytes(width * height)
    # the last line's padding may be missing
    whole_lines = stride * (height - 1) + line
    by_line = line_padding_bytes > 0 or (whole_lines > run and len(data) == stride * height)
    need = whole_lines if by_line else run
    if len(data) < need:
        raise CameraError(
            f"An image of {width} x {height} px in {pixel_format.name} takes {need} bytes, only {len(data)} came.",
            code="frame_format",
            remedy="Check the camera's pixel format and region; another program may have changed them.",
        )
    if by_line:
        lines = _lines(data, height, stride, line)
        return _decode(lines, pixel_format, width)
    return _decode(data[np.newaxis, :need], pixel_format, width * height).reshape(height, width)


def _lines(data: NDArray[np.uint8], height: int, stride: int, line: int) -> NDArray[np.uint8]:
    whole = data[: stride * height]
    if len(whole) < stride * height:
        whole = np.concatenate([whole, np.zeros(stride * height - len(whole), np.uint8)])
    return whole.reshape(height, stride)[:, :line]


def _decode(rows: NDArray[np.uint8], pixel_format: PixelFormat, count: int) -> Pixels:
    """Read ``count`` pixels from each row of bytes."""
    if pixel_format.layout == "bytes":
        return rows[:, :count].copy()
    if pixel_format.layout == "words":
        packed = np.ascontiguousarray(rows[:, : 2 * count])
        return packed.view("<u2").astype(np.uint16)  # a copy in any case
    if pixel_format.layout == "lsb":
        return _lsb(rows, pixel_format.bits, count)
    return _msb(rows, pixel_format.bit_depth, count)


def _groups(rows: NDArray[np.uint8], size: int, number: int) -> NDArray[np.uint8]:
    """Bytes as (rows * groups, size), the last group of each row filled up with zeros."""
    short = size * number - rows.shape[1]
    if short > 0:
        rows = np.concatenate([rows, np.zeros((rows.shape[0], short), np.uint8)], axis=1)
    return rows[:, : size * number].reshape(-1, size)


def _lsb(rows: NDArray[np.uint8], bits: int, count: int) -> NDArray[np.uint16]:
    # a group is the fewest pixels that fill whole bytes: 4 of 10 or 14 bits, 2 of 12
    pixels = 8 // np.gcd(bits, 8).item()
    size = pixels * bits // 8
    number = -(-count // pixels)
    groups = _groups(rows, size, number)
    out = np.empty((len(groups), pixels), np.uint16)
    mask = np.uint16(2**bits - 1)
    for begin in range(0, len(groups), _BLOCK):
        column = [groups[begin : begin + _BLOCK, index].astype(np.uint16) for index in range(size)]
        for k in range(pixels):
            first, shift = divmod(k * bits, 8)
            value = column[first] >> np.uint16(shift)
            for more in range(1, -(-(shift + bits) // 8)):
                value |= column[first + more] << np.uint16(8 * more - shift)
            out[begin : begin + _BLOCK, k] = value & mask
    return out.reshape(rows.shape[0], number * pixels)[:, :count]


def _msb(rows: NDArray[np.uint8], bit_depth: int, count: int) -> NDArray[np.uint16]:
    number = -(-count // 2)
    groups = _groups(rows, 3, number)
    low = np.uint16(bit_depth - 8)
    mask = np.uint16(2 ** (bit_depth - 8) - 1)
    out = np.empty((len(groups), 2), np.uint16)
    for begin in range(0, len(groups), _BLOCK):
        one, both, two = (groups[begin : begin + _BLOCK, index].astype(np.uint16) for index in range(3))
        out[begin : begin + _BLOCK, 0] = one << low | both & mask
        out[begin : begin + _BLOCK, 1] = two << low | both >> np.uint16(4) & mask
    return out.reshape(rows.shape[0], number * 2)[:, :count]
