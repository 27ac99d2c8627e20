"""Numbers of VTK's XML files: text, base64 or raw bytes, compressed or not."""

from __future__ import annotations

import base64
import binascii
import lzma
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereorig.server.formats.models.mesh_file import require_count, unreadable, whole_number

_TYPES = {
    "Int8": "i1",
    "UInt8": "u1",
    "Int16": "i2",
    "UInt16": "u2",
    "Int32": "i4",
    "UInt32": "u4",
    "Int64": "i8",
    "UInt64": "u8",
    "Float32": "f4",
    "Float64": "f8",
}
_MAX_LZMA_BYTES = 128 << 20  # memory of a decoder; the highest preset needs half of it
_COMPRESSORS = ("", "vtkZLibDataCompressor", "vtkLZMADataCompressor")


@dataclass(frozen=True)
class Decoder:
    """Encoding of a file's numbers.

    Attributes
    ----------
    order
        ``<`` or ``>``.
    header
        Type of the counts before each block.
    compressor
        Name of the compressor; empty for none.
    appended
        The bytes after the underscore of the appended data.
    appended_base64
        True if that is text.
    """

    order: str
    header: str
    compressor: str
    appended: bytes = b""
    appended_base64: bool = False

    @staticmethod
    def of(attributes: Any, appended: bytes, *, appended_base64: bool) -> Decoder:
        """Return the decoder that a file's head asks for.

        Raises
        ------
        FileFormatError
            ``model_unreadable`` for a compressor or header that is not known.
        """
        compressor = attributes.get("compressor", "")
        if compressor not in _COMPRESSORS:
            raise unreadable(f"its data are compressed by {compressor}", remedy="Write it with ZLib, or uncompressed.")
        header = attributes.get("header_type", "UInt32")
        if header not in ("UInt32", "UInt64"):
            raise unreadable(f"its header type is {header}")
        order = ">" if attributes.get("byte_order") == "BigEndian" else "<"
        return Decoder(order, _TYPES[header], compressor, appended, appended_base64)

    def array(self, element: Any, *, most: int) -> NDArray[Any]:
        """Return the flat numbers of a ``DataArray``, ``most`` of them at the most.

        Raises
        ------
        FileFormatError
            ``model_unreadable``.
        """
        name = element.get("Name") or "Points"
        kind = _TYPES.get(element.get("type", ""))
        if kind is None:
            raise unreadable(f"its array {name} has the type {element.get('type')!r}")
        require_count(most, f"the array {name}")
        form = element.get("format", "ascii")
        dtype = np.dtype(self.order + kind)
        if form == "ascii":
            text = (element.text or "").split(None, most)[:most]
            try:
                return np.array(text, dtype=dtype.newbyteorder("="))
            except (ValueError, OverflowError) as error:
                raise unreadable(f"its array {name} holds text that is no number ({error})") from error
        if form == "binary":
            content, text = b"".join((element.text or "").encode().split()), True
        elif form == "appended":
            offset = whole_number(element.get("offset"), f"the offset of the array {name}")
            if not 0 <= offset < len(self.appended):
                raise unreadable(f"its array {name} begins at byte {offset} of {len(self.appended)} that are appended")
            content, text = self.appended[offset:], self.appended_base64
        else:
            raise unreadable(f"its array {name} has the format {form!r}")
        try:
            raw = self._bytes(content, text=text, most=most * dtype.itemsize)
        except (binascii.Error, zlib.error, lzma.LZMAError, ValueError, IndexError) as error:
            raise unreadable(f"its array {name} is damaged ({error})") from error
        return np.frombuffer(raw[: len(raw) - len(raw) % dtype.itemsize], dtype=dtype)

    def _bytes(self, content: bytes, *, text: bool, most: int) -> bytes:
        size = np.dtype(self.header).itemsize
        if not self.compressor:
            head = _decoded(content, size) if text else content[:size]
            count = self._counts(head, 1)[0]
            if count > most:
                raise ValueError(f"{count} bytes where {most} at the most belong")
            body = _decoded(content, size + count)[size:] if text else content[size : size + count]
            if len(body) < count:
                raise ValueError(f"{len(body)} of {count} bytes are there")
            return body[:count]
        blocks = self._counts(_decoded(content, size) if text else content[:size], 1)[0]
        if not 0 <= blocks <= 1_000_000:
            raise ValueError(f"{blocks} blocks")
        long = (3 + blocks) * size
        heads = self._counts(_decoded(content, long) if text else content[:long], 3 + blocks)
        whole, last, packed = heads[1], heads[2], heads[3:]
        total = whole * blocks if last == 0 else whole * (blocks - 1) + last
        if blocks and total > most:
            raise ValueError(f"{total} bytes where {most} at the most belong")
        body = _decoded(content[4 * ((long + 2) // 3) :], sum(packed)) if text else content[long:]
        out, at = [], 0
        for k, length in enumerate(packed):
            expected = last if last and k == blocks - 1 else whole
            out.append(self._unpacked(body[at : at + length], expected))
            at += length
        return b"".join(out)

    def _unpacked(self, content: bytes, expected: int) -> bytes:
        if not expected:
            raise ValueError("a block has no bytes")
        zipped = "ZLib" in self.compressor
        made: Any = zlib.decompressobj() if zipped else lzma.LZMADecompressor(memlimit=_MAX_LZMA_BYTES)
        found: bytes = made.decompress(content, expected + 1)  # a limit of none would be no limit
        if len(found) != expected:
            raise ValueError(f"a block has {len(found)} of {expected} bytes")
        return found

    def _counts(self, head: bytes, count: int) -> list[int]:
        return [int(v) for v in np.frombuffer(head, dtype=self.order + self.header, count=count)]


def _decoded(text: bytes, count: int) -> bytes:
    """Decode the first bytes of base64 text."""
    return base64.b64decode(text[: 4 * ((count + 2) // 3)])[:count]
