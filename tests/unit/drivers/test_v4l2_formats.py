"""Unpacking of V4L2's pixel formats against the byte tables of the kernel's documentation, written out here."""

from __future__ import annotations

import re

import numpy as np
import pytest

from drivers.cameras.v4l2.formats import BY_CODE, GRAY_FORMATS, GrayFormat, find_format, fourcc_name

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
# "25 pixels are packed into 32 bytes, which leaves the 6 most significant bits of the last byte padded with 0"
_IPU3 = [(pixel, bit) for pixel in range(25) for bit in range(10)]
BYTES["ip3y"] = [
    ["".join(f"{p}[{b}:{b}]," for p, b in reversed(_IPU3[8 * i : 8 * i + 8])) if i < 31 else ""] for i in range(32)
]
BYTES["ip3y"] = [[part for part in byte[0].split(",") if part] for byte in BYTES["ip3y"]]
BYTES["ip3y"][31] = ["000000", "24[9:9]", "24[8:8]"]


def packed(table: list[list[str]], pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Write lines as the table says; colour is noise."""
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


def _format(name: str) -> GrayFormat:
    found = find_format(name, GRAY_FORMATS)
    assert found is not None
    return found


def test_every_format_has_its_table() -> None:
    assert {one.name for one in GRAY_FORMATS} == set(BYTES)


@pytest.mark.parametrize("width", [100, 97])
@pytest.mark.parametrize("name", sorted(BYTES))
def test_pixels_come_back_from_the_documented_bytes(name: str, width: int) -> None:
    gray = _format(name)
    rng = np.random.default_rng(5)
    pixels = rng.integers(0, 2**gray.bit_depth, (7, width))
    pixels[0, :2] = 0, 2**gray.bit_depth - 1
    lines = packed(BYTES[name], pixels, rng)
    assert lines.shape[1] == gray.row_bytes(width)
    for padding in (0, 13):
        stride = lines.shape[1] + padding
        memory = rng.integers(0, 256, stride * 7, dtype=np.uint8)
        np.lib.stride_tricks.as_strided(memory, lines.shape, (stride, 1))[:] = lines
        got = gray.pixels(memory[: memory.size - padding], width, 7, stride)
        assert got.dtype == (np.uint8 if gray.bit_depth == 8 else np.uint16)
        assert got.flags["C_CONTIGUOUS"]
        np.testing.assert_array_equal(got, pixels)
        assert not np.shares_memory(got, memory), "the device will write into the buffer again"


@pytest.mark.parametrize("name", sorted(BYTES))
def test_format_codes_are_the_headers(name: str) -> None:
    text = name.removesuffix("-BE")
    code = sum(ord(letter) << 8 * place for place, letter in enumerate(text)) | (name.endswith("-BE") << 31)
    assert BY_CODE[code].name == name == fourcc_name(code)


def test_names_are_found_as_people_write_them() -> None:
    for text, name in (
        ("Y12", "Y12 "),
        ("Y12 ", "Y12 "),
        ("Y16", "Y16 "),
        ("Y16_BE", "Y16 -BE"),
        ("Y16 -BE", "Y16 -BE"),
    ):
        assert _format(text).name == name
    assert find_format("Y13", GRAY_FORMATS) is None
    assert find_format("y12", GRAY_FORMATS) is None


def test_colour_behind_the_brightness_counts_for_a_whole_image() -> None:
    assert _format("NV12").image_bytes(640, 480, 640) == 640 * 480 * 3 // 2
    assert _format("NV16").image_bytes(640, 480, 704) == 704 * 959 + 640
    assert _format("Y10P").image_bytes(1280, 2, 1664) == 1664 + 1600
