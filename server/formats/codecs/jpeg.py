"""JPEG: complete scans between its markers, decoded by a library that reports each warning as an error.

libjpeg fills missing data with grey and only warns; Pillow and OpenCV do not pass the warning on. This module counts
the rest: components and, in progressive files, coefficients that no scan holds.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from stereorig.server.formats.codecs.refusals import check_size, unreadable, unsupported

_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_FRAMES = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive: 8 bits, Huffman codes
_PROGRESSIVE = 0xC2
_OTHER_FRAMES = (0xC3, *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0))
_SCAN, _END, _HEIGHT_LATER, _APP1 = 0xDA, 0xD9, 0xDC, 0xE1
_EXIF = b"Exif\0\0"
_BARE = (*range(0xD0, 0xD9), 0x00, 0x01)  # markers without a length
_MAX_SCANS = 100
_PIXELS_A_BYTE = 2048  # at most: each block of 64 pixels has a bit and more, of channels of a quarter of the pixels too


def decode_jpeg(data: bytes, name: str) -> tuple[NDArray[Any], bytes]:
    """Return (rows, cols) or (rows, cols, 3) uint8 of a JPEG as stored, and its EXIF data.

    Raises
    ------
    ImageError
        ``image_unreadable``, ``image_unsupported``, ``image_too_large``.
    """
    components, exif = _checked(data, name)
    try:
        pixels = simplejpeg.decode_jpeg(data, "GRAY" if components == 1 else "RGB", strict=True)
    except ValueError as error:
        raise unreadable(name, f"JPEG, {error}") from error
    return np.asarray(pixels[..., 0] if components == 1 else pixels), exif


def _checked(data: bytes, name: str) -> tuple[int, bytes]:
    """Return the number of components and the EXIF data, once every marker and scan was found to be there."""
    at, frame, scans, exif = 2, None, 0, b""
    missing: dict[int, NDArray[np.int8]] = {}  # by component, of each coefficient the bits that no scan has held so far
    while True:
        if data[at : at + 1] != b"\xff":
            raise unreadable(name, f"JPEG, no marker at byte {at}: it was cut or altered")
        while data[at + 1 : at + 2] == b"\xff":
            at += 1
        if len(data) < at + 2:
            raise unreadable(name, "JPEG, it ends before its end marker")
        kind = data[at + 1]
        if kind == _END:
            break
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if kind in _BARE or length < 2 or at + 2 + length > len(data):
            raise unreadable(name, f"JPEG, a segment at byte {at} is cut or altered")
        body = data[at + 4 : at + 2 + length]
        at += 2 + length
        if kind in _FRAMES:
            if frame is not None or len(body) < 6 or len(body) != 6 + 3 * body[5]:
                raise unreadable(name, "JPEG, its frame is described twice or in part")
            frame = kind
            depth, components = body[0], body[5]
            height, width = (int.from_bytes(body[k : k + 2], "big") for k in (1, 3))
            check_size(name, width, height)
            if width * height > _PIXELS_A_BYTE * len(data):
                raise unreadable(name, f"JPEG, its {len(data)} bytes are too few for {width} x {height} px")
            if depth != 8 or components not in (1, 3):
                raise unsupported(name, f"it is a JPEG of {components} channels of {depth} bit")
            missing = {body[6 + 3 * k]: np.full(64, 127, np.int8) for k in range(components)}
        elif kind == _APP1 and body[:6] == _EXIF:
            exif = exif or body[6:]
        elif kind in _OTHER_FRAMES or kind == _HEIGHT_LATER:
            raise unsupported(name, f"it is a JPEG of the rare kind {kind:02X}")
        elif kind == _SCAN:
            scans += 1
            if frame is None or scans > _MAX_SCANS:
                raise unreadable(name, f"JPEG, {scans} scans, or one before the frame")
            _take_scan(body, missing, name, progressive=frame == _PROGRESSIVE)
            found = _MARKER.search(data, at)
            if found is None:
                raise unreadable(name, "JPEG, it ends inside a scan")
            at = found.start()
    if frame is None or any(bits.any() for bits in missing.values()):
        raise unreadable(name, "JPEG, scans are missing")
    return components, exif


def _take_scan(body: bytes, missing: dict[int, NDArray[np.int8]], name: str, *, progressive: bool) -> None:
    count = body[0] if body else 0
    if not 1 <= count <= 4 or len(body) != 4 + 2 * count:
        raise unreadable(name, "JPEG, a scan's head is altered")
    first, last, bits = body[-3], body[-2], body[-1] & 15
    for k in range(count):
        held = missing.get(body[1 + 2 * k])
        if held is None:
            raise unreadable(name, "JPEG, a scan is of a component that the frame does not have")
        if progressive:
            held[first : last + 1] = bits
        else:
            held[:] = 0
