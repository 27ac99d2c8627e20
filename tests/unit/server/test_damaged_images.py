"""Images that lost a part are refused, whatever their codec makes of them; truth is another library's reading."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from stereorig.core.errors import ImageError
from stereorig.server.formats.images import decode, decode_image, decode_mask, encode_tiff
from tests.support.damaged_images import GREY8, GREY16, KINDS, PIXELS, SHAPE, damages, png_of_rows, tiff_tag


def _pillow(image: np.ndarray, form: str, **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image).save(out, form, **options)
    return out.getvalue()


def _tiff(image: np.ndarray, **options: object) -> bytes:
    out = io.BytesIO()
    tifffile.imwrite(out, image, **options)
    return out.getvalue()


def code_of(data: bytes) -> str:
    with pytest.raises(ImageError) as caught:
        decode_image(data)
    return caught.value.code


@pytest.mark.fault(58)
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_file_is_read_as_another_library_reads_it(kind: str) -> None:
    np.testing.assert_array_equal(decode_image(KINDS[kind]), PIXELS[kind])


@pytest.mark.fault(47)
@pytest.mark.fault(58)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("each", [40, pytest.param(1120, marks=pytest.mark.deep)])
def test_no_damaged_file_is_accepted_with_other_pixels(kind: str, each: int) -> None:
    rng = np.random.default_rng([each, list(KINDS).index(kind)])
    ways = damages(kind)
    refused = 0
    for k in range(each):
        data = ways[k % len(ways)](KINDS[kind], rng)
        try:
            pixels = decode_image(data)
        except ImageError:
            refused += 1
            continue
        assert pixels.shape == PIXELS[kind].shape, (ways[k % len(ways)], k)
        np.testing.assert_array_equal(pixels, PIXELS[kind], err_msg=f"{ways[k % len(ways)]} {k}")
    assert refused > each // 2


@pytest.mark.fault(58)
def test_a_png_of_fewer_or_more_rows_is_refused() -> None:
    row = bytes(1 + SHAPE[1])
    for rows in (70, 143, 145, 1440):
        assert code_of(png_of_rows(KINDS["png"], row * rows)) == "image_unreadable"
    assert decode_image(png_of_rows(KINDS["png"], row * 144)).shape == SHAPE


@pytest.mark.fault(58)
def test_a_jpeg_that_was_cut_and_ended_is_refused() -> None:
    for kind in ("jpeg", "jpeg_progressive"):
        assert code_of(KINDS[kind][: len(KINDS[kind]) // 2] + b"\xff\xd9") == "image_unreadable"


@pytest.mark.fault(58)
@pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_adobe_deflate", "lzma", "jpeg", None])
def test_a_tiff_whose_last_strip_holds_more_rows_than_its_image_is_refused(compression: str | None) -> None:
    data = _pillow(GREY8, "TIFF", **({"compression": compression} if compression else {}))
    assert code_of(_with_tag(data, 257, SHAPE[0] - 1)) == "image_unreadable"


def _with_tag(data: bytes, tag: int, value: int) -> bytes:
    _, letter, _, place = tiff_tag(data, tag)
    changed = bytearray(data)
    struct.pack_into("<" + letter, changed, place, value)
    return bytes(changed)


@pytest.mark.fault(47)
def test_a_tag_without_numbers_and_a_jpeg_of_too_few_bytes_are_refused_by_a_code() -> None:
    data = _pillow(GREY8, "TIFF")
    begin = struct.unpack_from("<I", data, 4)[0]
    for k in range(struct.unpack_from("<H", data, begin)[0]):
        changed = bytearray(data)
        struct.pack_into("<I", changed, begin + 2 + 12 * k + 4, 0)
        try:
            np.testing.assert_array_equal(decode_image(bytes(changed)), GREY8)  # of a tag that is not needed
        except ImageError as error:
            assert error.code in ("image_unreadable", "image_unsupported")  # noqa: PT017
    small = bytearray(_pillow(GREY8, "JPEG"))
    at = small.index(b"\xff\xc0")
    struct.pack_into(">HH", small, at + 5, 12_000, 12_000)
    assert code_of(bytes(small)) == "image_unreadable"


@pytest.mark.parametrize("pixels", [GREY8, np.random.default_rng(0).integers(0, 256, (700, 900)).astype(np.uint8)])
def test_lzw_in_one_long_strip_is_read(pixels: np.ndarray) -> None:
    data = _pillow(pixels, "TIFF", compression="tiff_lzw", strip_size=1 << 30)
    np.testing.assert_array_equal(decode_image(data), pixels)
    assert code_of(_with_tag(data, 256, 100)) == "image_unreadable"


def _packed12(pixels: np.ndarray) -> bytes:
    a, b = pixels[:, 0::2].astype(int), pixels[:, 1::2].astype(int)
    return np.stack([a >> 4, (a & 15) << 4 | b >> 8, b & 255], axis=2).astype(np.uint8).tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("packed", [False, True])
def test_twelve_bits_a_pixel_are_read_as_they_are(order: str, packed: bool) -> None:
    pixels = (GREY16 >> 4).astype(np.uint16)
    content = _packed12(pixels)
    content = zlib.compress(content) if packed else content
    tags = {256: SHAPE[1], 257: SHAPE[0], 258: 12, 259: 8 if packed else 1, 262: 1, 273: 200, 277: 1}
    tags |= {278: SHAPE[0], 279: len(content)}
    head = {"<": b"II", ">": b"MM"}[order] + struct.pack(order + "HI", 42, 8) + struct.pack(order + "H", len(tags))
    head += b"".join(struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in tags.items()) + bytes(4)
    np.testing.assert_array_equal(decode_image(head.ljust(200, b"\0") + content), pixels)
    deeper = head.replace(struct.pack(order + "HHII", 258, 4, 1, 12), struct.pack(order + "HHII", 258, 4, 1, 10))
    with pytest.raises(ImageError, match="10 bit"):
        decode_image(deeper.ljust(200, b"\0") + content)


@pytest.mark.parametrize("packing", [{}, {"compression": "zlib"}, {"compression": "zlib", "predictor": True}])
@pytest.mark.parametrize("deep", [False, True])
@pytest.mark.parametrize("shape", [{}, {"rowsperstrip": 7}, {"tile": (32, 48)}])
def test_planes_one_after_the_other_are_read_as_channels_side_by_side(
    packing: dict[str, object], deep: bool, shape: dict[str, object]
) -> None:
    grey = GREY16 if deep else GREY8
    rgb = np.stack([grey, np.roll(grey, 9, 0), np.roll(grey, 5, 1)], axis=2)
    side = decode(_tiff(rgb, photometric="rgb", **packing, **shape))
    planes = decode(_tiff(np.moveaxis(rgb, -1, 0), photometric="rgb", planarconfig="separate", **packing, **shape))
    np.testing.assert_array_equal(side.pixels, planes.pixels)
    assert side.grey_from == planes.grey_from is not None


def test_a_palette_is_read_by_its_table_unless_it_paints_false_colours() -> None:
    indices = np.random.default_rng(2).permutation(256).astype(np.uint8)
    table = np.repeat(indices[None].astype(np.uint16), 3, axis=0) * 257
    np.testing.assert_array_equal(decode_image(_tiff(GREY8, photometric="palette", colormap=table)), indices[GREY8])
    ramp = np.arange(256, dtype=np.uint16)
    fire = np.stack([ramp, ramp**2 // 255, 255 - ramp]) * np.uint16(257)
    assert code_of(_tiff(GREY8, photometric="palette", colormap=fire)) == "image_unsupported"
    colours = np.random.default_rng(4).integers(0, 256, (3, 256)).astype(np.uint16) * 257
    assert decode(_tiff(GREY8, photometric="palette", colormap=colours)).grey_from is not None


@pytest.mark.fault(58)
@pytest.mark.parametrize("form", ["PNG", "BMP"])
def test_a_palette_that_lacks_colours_of_its_pixels_is_refused(form: str) -> None:
    indices = Image.fromarray(GREY8 % 100).convert("P")
    indices.putpalette(bytes(range(150)))
    out = io.BytesIO()
    indices.save(out, form)
    data = out.getvalue()
    if form == "BMP":  # Pillow writes 256 colours: 50 by its head
        data = data[:46] + struct.pack("<I", 50) + data[50:]
        data = data[:10] + struct.pack("<I", 54 + 200) + data[14 : 54 + 200] + data[54 + 1024 :]
    assert code_of(data) == "image_unreadable"


def test_masks_of_one_bit_are_read_whole_or_not_at_all() -> None:
    mask = GREY8 > 120
    for form in ("PNG", "BMP", "TIFF"):
        data = _pillow(mask, form)
        np.testing.assert_array_equal(decode_mask(data), mask)
        assert code_of(data) == "image_unsupported"
        with pytest.raises(ImageError):
            decode_mask(data[:-200])


_MEASURED = """
import resource, sys
from stereorig.core.errors import ImageError
from stereorig.server.formats.images import decode_mask, decode_image
data = open(sys.argv[1], "rb").read()
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    (decode_mask if sys.argv[2] == "mask" else decode_image)(data)
    said = "read"
except ImageError as error:
    said = error.code
print(said, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def _taken(tmp_path: Path, data: bytes, kind: str = "image") -> tuple[str, float]:
    """Return the code of a reading in a process of its own, and the MiB that it took beyond the file itself."""
    path = tmp_path / "file"
    path.write_bytes(data)
    run = subprocess.run([sys.executable, "-c", _MEASURED, path, kind], capture_output=True, text=True, check=True)
    said, kib = run.stdout.split()
    return said, int(kib) / 1024


def _bomb(compression: str, grown: int, *, width: int = 64, bits: int = 8) -> bytes:
    """Return a TIFF of 64 rows whose only strip grows to a size that the image does not have."""
    import lzma

    pack = {"zlib": lambda b: zlib.compress(b, 9), "lzma": lambda b: lzma.compress(b, preset=0)}[compression]
    content = pack(bytes(grown))
    number = {"zlib": 8, "lzma": 34925}[compression]
    tags = {256: width, 257: 64, 258: bits, 259: number, 262: 1, 273: 200, 277: 1, 278: 64, 279: len(content)}
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    head += b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items()) + bytes(4)
    return head.ljust(200, b"\0") + content


@pytest.mark.fault(47)
@pytest.mark.fault(56)
@pytest.mark.parametrize("kind", ["image", "mask"])
@pytest.mark.parametrize("compression", ["zlib", "lzma"])
def test_a_strip_that_grows_beyond_its_image_takes_no_memory(tmp_path: Path, compression: str, kind: str) -> None:
    said, taken = _taken(tmp_path, _bomb(compression, 200 << 20), kind)
    assert said == "image_unreadable"
    assert taken < 100  # a decoder of LZMA has its dictionary; 200 MiB were taken before


@pytest.mark.fault(56)
@pytest.mark.parametrize("form", ["PNG", "TIFF", "BMP", "JPEG", "deflate", "PNG16", "lzw"])
def test_memory_is_at_most_four_times_the_pixels(tmp_path: Path, form: str) -> None:
    grey = np.tile(GREY8, (28, 28)) if form != "PNG16" else np.tile(GREY16, (28, 28))
    data = {
        "PNG": lambda: _pillow(grey, "PNG", compress_level=1),
        "PNG16": lambda: _pillow(grey, "PNG", compress_level=1),
        "TIFF": lambda: encode_tiff(grey),
        "BMP": lambda: _pillow(grey, "BMP"),
        "JPEG": lambda: _pillow(grey, "JPEG"),
        "deflate": lambda: _tiff(grey, photometric="minisblack", compression="zlib"),
        "lzw": lambda: _pillow(grey, "TIFF", compression="tiff_lzw", strip_size=1 << 30),
    }[form]()
    said, taken = _taken(tmp_path, data)
    assert said == "read"
    assert taken < 4 * grey.nbytes / 2**20 + 5, taken  # some MiB are the decoders' own
