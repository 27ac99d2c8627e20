"""Pixel formats of V4L2 as the kernel's documentation draws them."""

from __future__ import annotations

import re

import numpy as np

# One entry a byte, highest bits first: "1[9:2]" are bits 9 to 2 of pixel 1, "0000" are four empty bits, "c" is colour.
# From "Luma-Only Formats", "Packed YUV formats" and "Planar YUV formats" of the kernel's userspace API documentation.
BYTES: dict[str, list[list[str]]] = {
    "GREY": [["0[7:0]"]],
    "Y10 ": [["0[7:0]"], ["000000", "0[9:8]"]],
    "Y12 ": [["0[7:0]"], ["0000", "0[11:8]"]],
    "Y14 ": [["0[7:0]"], ["00", "0[13:8]"]],
    "Y16 ": [["0[7:0]"], ["0[15:8]"]],
    "Y16 -BE": [["0[15:8]"], ["0[7:0]"]],
    "Y012": [["0[3:0]", "0000"], ["0[11:4]"]],
    "Y10P": [["0[9:2]"], ["1[9:2]"], ["2[9:2]"], ["3[9:2]"], ["3[1:0]", "2[1:0]", "1[1:0]", "0[1:0]"]],
    "Y12P": [["0[11:4]"], ["1[11:4]"], ["1[3:0]", "0[3:0]"]],
    "Y14P": [
        ["0[13:6]"],
        ["1[13:6]"],
        ["2[13:6]"],
        ["3[13:6]"],
        ["1[1:0]", "0[5:0]"],
        ["2[3:0]", "1[5:2]"],
        ["3[5:0]", "2[5:4]"],
    ],
    "Y10B": [["0[9:2]"], ["0[1:0]", "1[9:4]"], ["1[3:0]", "2[9:6]"], ["2[5:0]", "3[9:8]"], ["3[7:0]"]],
    "YUYV": [["0[7:0]"], ["c"], ["1[7:0]"], ["c"]],
    "YVYU": [["0[7:0]"], ["c"], ["1[7:0]"], ["c"]],
    "UYVY": [["c"], ["0[7:0]"], ["c"], ["1[7:0]"]],
    "VYUY": [["c"], ["0[7:0]"], ["c"], ["1[7:0]"]],
    "P010": [["0[1:0]", "000000"], ["0[9:2]"]],
} | {name: [["0[7:0]"]] for name in ("NV12", "NV21", "NV16", "NV61", "NM12", "NM21", "NM16", "NM61")}


def packed(table: list[list[str]], pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Write lines by the table; colour is noise."""
    group = 1 + max(int(m) for byte in table for part in byte for m in re.findall(r"^(\d+)\[", part))
    rows, width = pixels.shape
    groups = -(-width // group)
    padded = np.zeros((rows, groups * group), np.int64)
    padded[:, :width] = pixels
    padded = padded.reshape(rows, groups, group)
    out = np.zeros((rows, groups, len(table)), np.int64)
    for position, byte in enumerate(table):
        if byte == ["c"]:
            out[..., position] = rng.integers(0, 256, (rows, groups))
            continue
        room = 8
        for part in byte:
            if set(part) == {"0"}:
                room -= len(part)
                continue
            pixel, high, low = (int(n) for n in re.fullmatch(r"(\d+)\[(\d+):(\d+)\]", part).groups())
            bits = high - low + 1
            room -= bits
            out[..., position] |= (padded[..., pixel] >> low & (1 << bits) - 1) << room
        assert room == 0, (byte, "is no whole byte")
    return out.reshape(rows, -1).astype(np.uint8)
