"""Unpacking of pixels, against the bit layouts of the standards and a bit-by-bit reader that knows nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from stereorig.core.errors import CameraError
from stereorig.drivers.cameras.pixels import BY_CODE, BY_NAME, FORMATS, PixelFormat, unpack


def test_codes_are_those_of_the_naming_convention() -> None:
    # PFNC: bits 31..24 say mono (01), bits 23..16 the bits that a pixel takes
    for known in FORMATS:
        assert known.code >> 24 == 0x01
        assert known.code >> 16 & 0xFF == known.bits, known.name
    assert {known.name: f"{known.code:08X}" for known in FORMATS} == {
        "Mono8": "01080001",
        "Mono10": "01100003",
        "Mono10p": "010A0046",
        "Mono10Packed": "010C0004",
        "Mono12": "01100005",
        "Mono12p": "010C0047",
        "Mono12Packed": "010C0006",
        "Mono14": "01100025",
        "Mono14p": "010E0104",
        "Mono16": "01100007",
    }
    assert len(BY_CODE) == len(BY_NAME) == len(FORMATS)


@pytest.mark.parametrize(
    ("name", "data", "pixels"),
    [
        ("Mono8", "00 7f ff", [0x00, 0x7F, 0xFF]),
        ("Mono10", "ff 03 01 02", [0x3FF, 0x201]),
        ("Mono12", "bc 0a 23 01", [0xABC, 0x123]),
        ("Mono14", "34 12 ff 3f", [0x1234, 0x3FFF]),
        ("Mono16", "34 12 ff ff", [0x1234, 0xFFFF]),
        # lowest bit first: 0xABC lies as BC, then A in the low half of the next byte, whose high half is 3 of 0x123
        ("Mono12p", "bc 3a 12", [0xABC, 0x123]),
        # 0x001, 0x002, 0x003, 0x3FF: bits 0, 11, 20 and 21, 30 to 39
        ("Mono10p", "01 08 30 c0 ff", [0x001, 0x002, 0x003, 0x3FF]),
        # 0x0001, 0x2000, 0x0003, 0x3FFF: bits 0, 27, 28 and 29, 42 to 55
        ("Mono14p", "01 00 00 38 00 fc ff", [0x0001, 0x2000, 0x0003, 0x3FFF]),
        # GigE Vision: high byte, both low halves (second pixel's above), high byte
        ("Mono12Packed", "ab 3c 12", [0xABC, 0x123]),
        ("Mono12Packed", "ab 0c", [0xABC]),  # an odd last pixel takes two bytes
        # GigE Vision: high byte, low two bits in bits 1..0 and 5..4, high byte
        ("Mono10Packed", "ff 12 40", [0x3FE, 0x101]),
        ("Mono10Packed", "80 01", [0x201]),
    ],
)
def test_vectors(name: str, data: str, pixels: list[int]) -> None:
    image = unpack(_bytes(data), BY_NAME[name], len(pixels), 1)
    assert image.dtype == (np.uint8 if name == "Mono8" else np.uint16)
    assert image.tolist() == [pixels]


def _bytes(text: str) -> np.ndarray:
    return np.frombuffer(bytes.fromhex(text), np.uint8)


def _pack(values: list[int], known: PixelFormat) -> bytes:
    """Writes bit by bit, by the words of the standards."""
    if known.layout in ("bytes", "words"):
        return b"".join(value.to_bytes(known.bits // 8, "little") for value in values)
    if known.layout == "lsb":
        stream = sum(value << index * known.bits for index, value in enumerate(values))
        return stream.to_bytes(-(-len(values) * known.bits // 8), "little")
    data = b""
    low = known.bit_depth - 8
    for first in range(0, len(values), 2):
        one = values[first]
        data += bytes([one >> low])
        two = values[first + 1] if first + 1 < len(values) else 0
        data += bytes([one & 2**low - 1 | (two & 2**low - 1) << 4])
        if first + 1 < len(values):
            data += bytes([two >> low])
    return data


@given(
    known=st.sampled_from(FORMATS),
    width=st.integers(1, 9),
    height=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
    layout=st.sampled_from(["run", "lines", "padded", "padded but the last"]),
    behind=st.integers(0, 3),
)
def test_whatever_was_packed_comes_back(
    known: PixelFormat, width: int, height: int, seed: int, layout: str, behind: int
) -> None:
    image = np.random.default_rng(seed).integers(0, 2**known.bit_depth, (height, width))
    padding = 0
    if layout == "run":
        data = _pack(image.ravel().tolist(), known)
        if len(data) + behind != height * known.size_bytes(width):  # as many bytes as whole lines have means lines
            data += b"\xaa" * behind
    else:
        padding = 0 if layout == "lines" else 3
        # small images may take as many bytes either way, and then run on
        assume(padding or height * known.size_bytes(width) != known.size_bytes(width * height))
        data = b"".join(_pack(row, known) + b"\xee" * padding for row in image.tolist())
        if layout == "padded but the last":
            data = data[:-padding]
    got = unpack(np.frombuffer(data, np.uint8), known, width, height, line_padding_bytes=padding)
    np.testing.assert_array_equal(got, image)
    assert got.flags.writeable


@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.name)
def test_too_few_bytes_are_refused(known: PixelFormat) -> None:
    data = np.zeros(known.size_bytes(15) - 1, np.uint8)
    with pytest.raises(CameraError) as caught:
        unpack(data, known, 5, 3)
    assert caught.value.code == "frame_format"
    with pytest.raises(CameraError):
        unpack(np.zeros(3 * known.size_bytes(5) + 2 * 4 - 1, np.uint8), known, 5, 3, line_padding_bytes=4)


@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.name)
def test_the_image_does_not_share_the_buffer(known: PixelFormat) -> None:
    data = np.full(known.size_bytes(16), 0x55, np.uint8)
    image = unpack(data, known, 4, 4)
    before = image.copy()
    data[:] = 0
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("known", FORMATS, ids=lambda known: known.name)
def test_what_is_unpacked_in_blocks_joins(known: PixelFormat, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stereorig.drivers.cameras.pixels._BLOCK", 8)
    image = np.random.default_rng(5).integers(0, 2**known.bit_depth, (13, 21))
    data = np.frombuffer(_pack(image.ravel().tolist(), known), np.uint8)
    np.testing.assert_array_equal(unpack(data, known, 21, 13), image)
