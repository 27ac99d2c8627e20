"""TIFF in every usual layout: a second reader (Pillow, OpenCV or tifffile) finds the same size and rows."""

from __future__ import annotations

import contextlib
import io
import itertools
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from stereorig.core.errors import ImageError
from stereorig.server.cell.cell import Cell
from stereorig.server.cell.images import images
from stereorig.server.formats.images import decode, decode_image
from stereorig.server.formats.noise_json import stated_full_scale
from tests.support.written_tiffs import HEIGHT, LAYOUTS, PACKINGS, WIDTH, tiff

RNG = np.random.default_rng(5)


def pixels(bits: int, channels: int) -> np.ndarray:
    """A ramp with noise, so that rows differ and compression has something to do."""
    ramp = np.linspace(0, (1 << bits) - 1, HEIGHT * WIDTH * channels).reshape(HEIGHT, WIDTH, channels)
    noise = RNG.integers(0, 1 << bits - 3, ramp.shape)
    return np.minimum(ramp + noise, (1 << bits) - 1).astype(np.uint8 if bits == 8 else np.uint16)


def second_reading(data: bytes, bits: int, channels: int, *, planar: bool) -> np.ndarray | None:
    """The same file by Pillow, OpenCV or tifffile, whichever reads it: (rows, cols[, 3])."""
    if bits in (8, 12) or channels == 1:
        try:
            with Image.open(io.BytesIO(data)) as image:
                return np.asarray(image)
        except (OSError, SyntaxError, UserWarning):  # of big TIFF it knows one byte order
            pass
    with contextlib.suppress(ValueError, NotImplementedError), tifffile.TiffFile(io.BytesIO(data)) as file:
        found = file.pages[0].asarray()  # without its codecs
        return np.moveaxis(found, 0, -1) if found.ndim == 3 and planar else found
    # OpenCV gives 12 bits times 16, and takes planes of 16 bits for channels side by side
    found = None if bits == 12 or planar else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return found if found is None or found.ndim == 2 else found[..., ::-1]


def variants() -> Iterator[tuple[int, int, str, str, str, bool, bool, bool]]:
    kinds = [(bits, channels, planar) for bits in (8, 16) for channels, planar in ((1, False), (3, False), (3, True))]
    for (bits, channels, planar), layout, packing, order, big in itertools.product(
        [*kinds, (12, 1, False)], LAYOUTS, PACKINGS, "<>", (False, True)
    ):
        yield bits, channels, layout, packing, order, planar, big, False
        if packing in ("lzw", "deflate") and bits != 12 and not big:
            yield bits, channels, layout, packing, order, planar, big, True


@pytest.mark.fault(58)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_of_hundreds_of_variants_is_read_as_it_was_written_and_as_a_second_reader_reads_it(layout: str) -> None:
    ours = agreed = 0
    for bits, channels, where, packing, order, planar, big, differences in variants():
        if where != layout:
            continue
        image = pixels(bits, channels)
        name = f"{bits} bit, {channels} channels, {packing}, {order}, planar {planar}, big {big}, {differences}"
        data = tiff(image, bits, layout, packing, order, planar=planar, big=big, differences=differences)
        found = decode(data, name=name)
        grey = image[..., 0] if channels == 1 else np.rint(image @ np.array([0.299, 0.587, 0.114]))
        assert found.pixels.shape == (HEIGHT, WIDTH), name
        np.testing.assert_array_equal(found.pixels, grey, err_msg=name)
        assert found.bit_depth == bits
        ours += 1
        other = second_reading(data, bits, channels, planar=planar)
        if other is not None:
            grey = other if other.ndim == 2 else np.rint(other @ np.array([0.299, 0.587, 0.114]))
            assert grey.shape == found.pixels.shape, name
            for row in (0, HEIGHT // 2, HEIGHT - 1):
                np.testing.assert_array_equal(grey[row], found.pixels[row], err_msg=name)
            agreed += 1
    assert ours >= 120
    assert agreed >= 100  # none of the three unpacks planes of 16 bits in LZW and PackBits, or 12 bits in some


def test_pages_other_than_reduced_copies_are_refused() -> None:
    image = pixels(16, 1)[..., 0]
    for kind, accepted in ((1, True), (0, False), (2, False)):
        out = io.BytesIO()
        with tifffile.TiffWriter(out, bigtiff=kind == 1) as writer:
            writer.write(image, photometric="minisblack", metadata=None)
            writer.write(image[::2, ::2], photometric="minisblack", subfiletype=kind, metadata=None)
        if accepted:
            np.testing.assert_array_equal(decode_image(out.getvalue()), image)
        else:
            with pytest.raises(ImageError, match="more than one image"):
                decode_image(out.getvalue())


@pytest.mark.parametrize("bits", [2, 4, 6, 10, 14, 24, 32])
def test_a_depth_that_is_not_read_is_named(bits: int) -> None:
    rows = RNG.integers(0, 4, (HEIGHT, WIDTH, 1))
    data = tiff(rows, bits, "strips", "none", ">", planar=False, big=False, differences=False)
    with pytest.raises(ImageError, match=f"of {bits} bit") as caught:
        decode_image(data)
    assert caught.value.code == "image_unsupported"


@pytest.mark.fault(58)
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("channels", [1, 3])
def test_an_orientation_is_applied_as_pillow_and_opencv_apply_it(orientation: int, channels: int) -> None:
    image = np.squeeze(pixels(8, channels))
    out = io.BytesIO()
    kind = "rgb" if channels == 3 else "minisblack"
    tifffile.imwrite(out, image, photometric=kind, metadata=None, extratags=[(274, "H", 1, orientation, True)])
    found = decode_image(out.getvalue())
    with Image.open(out) as opened:
        pillow = np.asarray(opened)
    opencv = cv2.imdecode(np.frombuffer(out.getvalue(), np.uint8), cv2.IMREAD_UNCHANGED)
    for other in (pillow, opencv if channels == 1 else opencv[..., ::-1]):
        grey = other if channels == 1 else np.rint(other @ np.array([0.299, 0.587, 0.114]))
        np.testing.assert_array_equal(found, grey)


def test_a_raw_mosaic_of_colours_is_refused() -> None:
    out = io.BytesIO()
    tifffile.imwrite(out, pixels(16, 1)[..., 0], photometric="cfa", metadata=None)
    with pytest.raises(ImageError, match="mosaic"):
        decode_image(out.getvalue())


def test_twelve_packed_bits_state_their_full_scale(tmp_path: object) -> None:
    deep, wide = pixels(12, 1), pixels(16, 1)
    files = {
        bits: tiff(image, bits, "strips", "none", "<", planar=False, big=False, differences=False)
        for bits, image in ((12, deep), (16, wide))
    }
    assert (decode(files[12]).bit_depth, decode(files[16]).bit_depth) == (12, 16)
    cell = Cell()
    try:
        read = images(cell, {str(bits): data for bits, data in files.items()})
    finally:
        cell.close()
    assert [read[name].bit_depth for name in ("12", "16")] == [12, 16]
    np.testing.assert_array_equal(read["12"].pixels, deep[..., 0])
    for bits, expected in ((12, 4095.0), (16, None)):
        path = tmp_path / f"{bits}.tif"  # type: ignore[operator]
        path.write_bytes(files[bits])
        assert stated_full_scale(path) == expected
