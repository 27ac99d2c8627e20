"""Unpacking of V4L2's pixel formats against the byte tables of the kernel's documentation, written out here."""

from __future__ import annotations

import numpy as np
import pytest

from stereorig.drivers.cameras.v4l2.formats import BY_CODE, GRAY_FORMATS, GrayFormat, find_format, fourcc_name
from tests.support.v4l2_pixels import BYTES, packed

# "25 pixels are packed into 32 bytes, which leaves the 6 most significant bits of the last byte padded with 0"
_IPU3 = [(pixel, bit) for pixel in range(25) for bit in range(10)]
BYTES["ip3y"] = [
    ["".join(f"{p}[{b}:{b}]," for p, b in reversed(_IPU3[8 * i : 8 * i + 8])) if i < 31 else ""] for i in range(32)
]
BYTES["ip3y"] = [[part for part in byte[0].split(",") if part] for byte in BYTES["ip3y"]]
BYTES["ip3y"][31] = ["000000", "24[9:9]", "24[8:8]"]


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
    code = sum(ord(letter) << 8 * index for index, letter in enumerate(text)) | (name.endswith("-BE") << 31)
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
