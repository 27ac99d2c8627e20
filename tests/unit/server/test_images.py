"""Image files: what is read is what was written, by others too, and what cannot be measured on is refused."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageOps

from stereorig.core.errors import ImageError, StorageError
from stereorig.server.formats.images import decode, decode_image, encode_tiff, read_image, read_mask, write_image

RNG = np.random.default_rng(7)
GRAY8 = RNG.integers(0, 256, (23, 31), dtype=np.uint8)
GRAY16 = RNG.integers(0, 65536, (23, 31), dtype=np.uint16)


def code_of(path: Path) -> str:
    with pytest.raises(ImageError) as caught:
        read_image(path)
    assert str(path) in caught.value.cause
    assert caught.value.remedy
    return caught.value.code


@pytest.mark.parametrize("image", [GRAY8, GRAY16], ids=["8bit", "16bit"])
@pytest.mark.parametrize("ending", ["tif", "png"])
def test_what_opencv_wrote_is_read_to_the_bit(tmp_path: Path, image: np.ndarray, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    assert cv2.imwrite(str(path), image)  # OpenCV's TIFF is LZW-compressed
    got = read_image(path)
    assert got.dtype == image.dtype
    assert got.flags.c_contiguous
    np.testing.assert_array_equal(got, image)


@pytest.mark.parametrize("image", [GRAY8, GRAY16], ids=["8bit", "16bit"])
@pytest.mark.parametrize(
    "options",
    [{}, {"compression": "zlib"}, {"byteorder": ">"}, {"rowsperstrip": 5}, {"tile": (16, 16)}, {"bigtiff": True}],
    ids=str,
)
def test_every_usual_tiff_is_read(tmp_path: Path, image: np.ndarray, options: dict[str, object]) -> None:
    tifffile.imwrite(tmp_path / "a.tif", image, photometric="minisblack", **options)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), image)


def test_bmp_and_jpeg_are_read(tmp_path: Path) -> None:
    Image.fromarray(GRAY8).save(tmp_path / "a.bmp")
    np.testing.assert_array_equal(read_image(tmp_path / "a.bmp"), GRAY8)
    flat = np.full((16, 16), 90, np.uint8)
    Image.fromarray(flat).save(tmp_path / "a.jpg")
    np.testing.assert_allclose(read_image(tmp_path / "a.jpg"), 90, atol=1)


def test_white_is_zero_is_turned_round(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GRAY8, photometric="miniswhite")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), 255 - GRAY8)


@pytest.mark.parametrize("ending", ["tif", "png", "bmp"])
def test_gray_saved_as_colour_keeps_its_numbers(tmp_path: Path, ending: str) -> None:
    cv2.imwrite(str(tmp_path / f"same.{ending}"), np.repeat(GRAY8[..., None], 3, axis=2))
    found = decode((tmp_path / f"same.{ending}").read_bytes())
    np.testing.assert_array_equal(found.pixels, GRAY8)
    assert found.grey_from is None


COLOUR = np.random.default_rng(3).integers(0, 256, (40, 50, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    ("ending", "alpha", "depth"),
    [("bmp", False, 8), *((end, alpha, n) for end in ("tif", "png") for alpha in (False, True) for n in (8, 16))],
)
def test_the_luminance_of_a_colour_image_is_taken_and_said(
    tmp_path: Path, ending: str, alpha: bool, depth: int
) -> None:
    rgb = COLOUR if depth == 8 else COLOUR.astype(np.uint16) * 257 - COLOUR
    full = np.full((*rgb.shape[:2], 1), np.iinfo(rgb.dtype).max, rgb.dtype)
    bgr = np.concatenate([rgb[..., ::-1], *([full] if alpha else [])], axis=2)
    cv2.imwrite(str(tmp_path / f"a.{ending}"), bgr)
    found = decode((tmp_path / f"a.{ending}").read_bytes())
    assert found.pixels.dtype == rgb.dtype
    # OpenCV's own conversion works in fixed point: a grey level of difference by rounding
    expected = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(found.pixels.astype(int) - expected).max() <= 1
    assert found.grey_from == "luminance, 0.299 R + 0.587 G + 0.114 B"


def test_the_luminance_of_a_jpeg_and_of_a_palette_is_taken(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(COLOUR, (0, 0), 4.0)
    Image.fromarray(smooth).save(tmp_path / "a.jpg", quality=98)
    expected = cv2.cvtColor(smooth, cv2.COLOR_RGB2GRAY).astype(int)
    # a JPEG stores luminance by these very weights: rounding of its blocks remains
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - expected).max() <= 4
    image = Image.fromarray(smooth).quantize(32)
    image.save(tmp_path / "a.png")
    expected = cv2.cvtColor(np.asarray(image.convert("RGB")), cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(read_image(tmp_path / "a.png").astype(int) - expected).max() <= 1


@pytest.mark.parametrize("orientation", range(10))
@pytest.mark.parametrize("mark", [b"II", b"MM"])
def test_jpeg_and_png_are_turned_as_their_exif_data_say(tmp_path: Path, orientation: int, mark: bytes) -> None:
    """A second reader, Pillow, turns the same file; 0 and 9 are no orientations."""
    exif = Image.Exif()
    exif.endian = "<" if mark == b"II" else ">"
    exif[0x0112] = orientation
    deep = np.stack([GRAY16] * 3, axis=-1)
    Image.fromarray(GRAY8).save(tmp_path / "a.png", exif=exif)
    Image.fromarray(GRAY8).save(tmp_path / "a.jpg", exif=exif, quality=97)
    Image.fromarray(COLOUR).save(tmp_path / "colour.jpg", exif=exif, quality=97)
    for name in ("a.png", "a.jpg"):
        with Image.open(tmp_path / name) as image:
            assert image.getexif().endian == exif.endian
            expected = np.asarray(ImageOps.exif_transpose(image))
        np.testing.assert_array_equal(read_image(tmp_path / name), expected)
    with Image.open(tmp_path / "colour.jpg") as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_allclose(read_image(tmp_path / "colour.jpg"), expected @ (0.299, 0.587, 0.114), atol=0.51)
    chunk = b"eXIf" + exif.tobytes().removeprefix(b"Exif\0\0")
    told = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    plain = cv2.imencode(".png", deep)[1].tobytes()
    turned = Image.fromarray(GRAY16)
    turned.getexif()[0x0112] = orientation
    np.testing.assert_array_equal(
        decode_image(plain[:33] + told + plain[33:]), np.asarray(ImageOps.exif_transpose(turned))
    )


@pytest.mark.parametrize("exif", [b"", b"II*", b"II*\0\xff\xff\xff\xff", b"MM\0*\0\0\0\x08\xff\xff", bytes(2000)])
def test_exif_data_without_an_orientation_turn_nothing(exif: bytes) -> None:
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 8) + b"Exif\0\0" + exif
    plain = cv2.imencode(".jpg", GRAY8)[1].tobytes()
    np.testing.assert_array_equal(decode_image(plain[:2] + segment + plain[2:]), decode_image(plain))


def test_the_rows_of_a_png_in_one_chunk_are_unpacked_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is given to zlib and not unpacked at once is copied: 1.3 GB in one chunk took minutes."""
    noise = RNG.integers(0, 256, (2000, 2500), dtype=np.uint8)
    plain = cv2.imencode(".png", noise, [cv2.IMWRITE_PNG_COMPRESSION, 0])[1].tobytes()
    rows = zlib.compress(b"".join(b"\0" + row.tobytes() for row in noise), 0)
    chunk = b"IDAT" + rows
    one = plain[:33] + struct.pack(">I", len(rows)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + plain[-12:]
    inflate, given = zlib.decompressobj, []

    class Counting:
        def __init__(self) -> None:
            self.inner = inflate()

        def __getattr__(self, name: str) -> object:
            return getattr(self.inner, name)

        def decompress(self, data: bytes, most: int) -> bytes:
            given.append(len(data))
            return self.inner.decompress(data, most)

    monkeypatch.setattr(zlib, "decompressobj", Counting)
    np.testing.assert_array_equal(decode_image(one), noise)
    assert sum(given) < 2 * len(rows)


def test_planar_colour_and_other_colour_spaces(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.moveaxis(COLOUR, -1, 0), photometric="rgb", planarconfig="separate")
    expected = cv2.cvtColor(COLOUR, cv2.COLOR_RGB2GRAY).astype(int)
    assert np.abs(read_image(tmp_path / "a.tif").astype(int) - expected).max() <= 1
    tifffile.imwrite(tmp_path / "lab.tif", COLOUR, photometric="cielab")
    assert code_of(tmp_path / "lab.tif") == "image_unsupported"


def test_planar_colour_of_equal_channels_is_taken(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", np.stack([GRAY16] * 3), photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), GRAY16)


def test_other_pixel_types_and_stacks_are_refused(tmp_path: Path) -> None:
    for i, pixels in enumerate((GRAY8.astype(np.float32), GRAY16.astype(np.uint32), GRAY8.astype(np.int16))):
        tifffile.imwrite(tmp_path / f"{i}.tif", pixels, photometric="minisblack")
        assert code_of(tmp_path / f"{i}.tif") == "image_unsupported"
    tifffile.imwrite(tmp_path / "stack.tif", np.stack([GRAY8, GRAY8]), photometric="minisblack")
    assert code_of(tmp_path / "stack.tif") == "image_unsupported"


def test_missing_folder_empty_and_foreign_files(tmp_path: Path) -> None:
    assert code_of(tmp_path / "none.tif") == "file_missing"
    assert code_of(tmp_path) == "image_unreadable"
    (tmp_path / "empty.tif").touch()
    assert code_of(tmp_path / "empty.tif") == "image_unreadable"
    (tmp_path / "text.tif").write_text("not an image")
    assert code_of(tmp_path / "text.tif") == "image_unreadable"


@pytest.mark.fault(47)
@pytest.mark.parametrize("ending", ["tif", "png", "bmp", "jpg"])
@pytest.mark.parametrize("part", [0.02, 0.5, 0.97])
def test_truncated_at_any_place_is_unreadable(tmp_path: Path, ending: str, part: float) -> None:
    path = tmp_path / f"a.{ending}"
    Image.fromarray(np.kron(GRAY8, np.ones((8, 8), np.uint8))).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    assert code_of(path) == "image_unreadable"


@pytest.mark.fault(47)
def test_a_truncated_strip_is_not_filled_up(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.kron(GRAY16, np.ones((8, 8), np.uint16)), rowsperstrip=8, compression="zlib")
    data = path.read_bytes()
    path.write_bytes(data[:-50])
    assert code_of(path) == "image_unreadable"


@pytest.mark.fault(47)
def test_huge_headers_are_refused_before_decoding(tmp_path: Path) -> None:
    ihdr = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + ihdr + struct.pack(">I", zlib.crc32(ihdr))
    idat = b"IDAT" + zlib.compress(bytes(1000))
    png += struct.pack(">I", len(idat) - 4) + idat + struct.pack(">I", zlib.crc32(idat))
    (tmp_path / "bomb.png").write_bytes(png)
    assert code_of(tmp_path / "bomb.png") == "image_too_large"
    for depth, colour, refused in ((16, 6, True), (8, 6, False), (16, 0, False)):  # 12,600 px a side, of 8, 4, 2 bytes
        header = struct.pack(">IIBBBBB", 12_600, 12_600, depth, colour, 0, 0, 0)
        chunk = b"IHDR" + header
        whole = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
        (tmp_path / "deep.png").write_bytes(whole)
        assert code_of(tmp_path / "deep.png") == ("image_too_large" if refused else "image_unreadable")
    small = bytearray(encode_tiff(GRAY8))
    for tag in (256, 257):  # ImageWidth, ImageLength
        at = (
            small.index(struct.pack("<H", tag) + b"\x04\0")
            if struct.pack("<H", tag) + b"\x04\0" in small
            else (small.index(struct.pack("<H", tag) + b"\x03\0"))
        )
        small[at + 2 : at + 12] = struct.pack("<HII", 4, 1, 100_000)
    (tmp_path / "bomb.tif").write_bytes(bytes(small))
    assert code_of(tmp_path / "bomb.tif") == "image_too_large"


@pytest.mark.fault(47)
def test_random_damage_never_escapes_as_another_error() -> None:
    rng = np.random.default_rng(3)
    whole = encode_tiff(GRAY8)
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(0, 300, 3):
            data[int(at)] = int(rng.integers(0, 256))
        try:
            image = decode_image(bytes(data), name="x")
        except ImageError:
            continue
        assert image.ndim == 2


def test_written_images_are_read_by_others_and_left_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.tif"
    write_image(path, GRAY16)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), GRAY16)

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(StorageError) as caught:
        write_image(path, GRAY16 // 2)
    assert caught.value.code == "storage_full"
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]
    np.testing.assert_array_equal(read_image(path), GRAY16)
    with pytest.raises(ValueError, match="uint8 or uint16"):
        write_image(path, GRAY16.astype(np.float64))  # type: ignore[arg-type]


def test_masks_are_white_where_points_may_lie(tmp_path: Path) -> None:
    mask = GRAY8 > 127
    for name, image in (
        ("8.png", mask.astype(np.uint8) * 255),
        ("16.png", mask.astype(np.uint16) * 65535),
        ("1.png", mask),
    ):
        Image.fromarray(image).save(tmp_path / name)
        np.testing.assert_array_equal(read_mask(tmp_path / name), mask)
