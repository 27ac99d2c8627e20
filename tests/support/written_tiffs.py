"""TIFF files in every usual layout, written by TIFF 6.0's own description."""

from __future__ import annotations

import io
import itertools
import struct
import zlib

import numpy as np
import tifffile
from PIL import Image

HEIGHT, WIDTH = 37, 45  # no multiple of a strip or tile, and an odd number of pixels a row
LAYOUTS = {"one strip": (HEIGHT, WIDTH), "strips": (7, WIDTH), "a row a strip": (1, WIDTH), "tiles": (16, 32)}
PACKINGS = {"none": 1, "packbits": 32773, "lzw": 5, "deflate": 8}


def packed(rows: np.ndarray, bits: int, order: str) -> bytes:
    """Rows (h, n) of samples; each begins at a whole byte."""
    if bits in (8, 16):
        return rows.astype(f"{order}u{bits // 8}").tobytes()
    digits = (rows[..., None].astype(int) >> np.arange(bits - 1, -1, -1) & 1).reshape(len(rows), -1)
    return np.packbits(digits.astype(np.uint8), axis=1).tobytes()


def compressed(data: bytes, packing: str) -> bytes:
    if packing == "deflate":
        return zlib.compress(data)
    if packing == "none":
        return data
    out = io.BytesIO()  # as one row of Pillow's
    Image.frombytes("L", (len(data), 1), data).save(out, "TIFF", compression={"lzw": "tiff_lzw"}.get(packing, packing))
    with tifffile.TiffFile(io.BytesIO(out.getvalue())) as file:
        page = file.pages[0]
        return b"".join(out.getvalue()[a : a + n] for a, n in zip(page.dataoffsets, page.databytecounts, strict=True))


def tiff(
    image: np.ndarray, bits: int, layout: str, packing: str, order: str, *, planar: bool, big: bool, differences: bool
) -> bytes:
    """Write (rows, cols, channels) by TIFF 6.0's own description."""
    high, wide = LAYOUTS[layout]
    tiled, channels, parts = layout == "tiles", image.shape[2], []
    for plane, top, left in itertools.product(
        range(channels if planar else 1), range(0, HEIGHT, high), range(0, WIDTH, wide)
    ):
        part = image[top : top + high, left : left + wide, plane : plane + 1 if planar else None]
        if tiled:
            part = np.pad(part, [(0, high - part.shape[0]), (0, wide - part.shape[1]), (0, 0)])
        if differences:
            part = np.concatenate([part[:, :1], part[:, 1:] - part[:, :-1]], axis=1)
        parts.append(compressed(packed(part.reshape(len(part), -1), bits, order), packing))
    begin = 16 if big else 8
    offsets = [begin + sum(len(p) + len(p) % 2 for p in parts[:k]) for k in range(len(parts))]
    tags: dict[int, list[int]] = {
        256: [WIDTH], 257: [HEIGHT], 258: [bits] * channels, 259: [PACKINGS[packing]], 262: [1 if channels == 1 else 2],
        277: [channels], 284: [2 if planar else 1], 317: [2 if differences else 1],
        324 if tiled else 273: offsets, 325 if tiled else 279: [len(p) for p in parts],
    }  # fmt: skip
    tags |= {322: [wide], 323: [high]} if tiled else {278: [high]}
    body = b"".join(p + bytes(len(p) % 2) for p in parts)
    at, long, inside = begin + len(body), "Q" if big else "I", 8 if big else 4
    entry = order + ("HHQ" if big else "HHI")
    after = at + (8 if big else 2) + len(tags) * (struct.calcsize(entry) + inside) + inside
    table, lists = struct.pack(order + ("Q" if big else "H"), len(tags)), b""
    for tag in sorted(tags):
        letter, kind = ("H", 3) if tag in (258, 259, 262, 277, 284, 317) else ("I", 4)
        values = struct.pack(f"{order}{len(tags[tag])}{letter}", *tags[tag])
        if len(values) > inside:
            values, lists = struct.pack(order + long, after + len(lists)), lists + values + bytes(len(values) % 2)
        table += struct.pack(entry, tag, kind, len(tags[tag])) + values.ljust(inside, b"\0")
    head = (b"II" if order == "<" else b"MM") + struct.pack(
        order + ("HHHQ" if big else "HI"), *([43, 8, 0] if big else [42]), at
    )
    return head + body + table + bytes(inside) + lists
