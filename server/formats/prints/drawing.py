"""A page of black shapes in millimetres, written as PDF and as SVG.

Both forms have the same numbers: the page's own millimetres, X to the right and Y down from its upper left corner. All
rectangles are one path, so that neighbours leave no seam. A disc is a stroke of a micrometre with round ends: it takes
a tenth of the bytes of four curves, and a stroke of no length some programs draw longer by a pixel.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from html import escape

import numpy as np

from stereorig.core.arrays import Float

_POINTS_PER_MM = 72.0 / 25.4
_HALF_STROKE_MM = 0.0005
_DISCS_A_PATH = 500  # printers limit the length of a path
DRAWING_FORMS = ("pdf", "svg")


@dataclass(frozen=True, eq=False)
class Discs:
    """Discs of one diameter: centres (n, 2) in mm; ``white`` ones are drawn over the black ones before them."""

    centres: Float
    diameter_mm: float
    white: bool = False

    def strokes(self) -> Float:
        """Return (n, 3) of the strokes: left end, Y, right end."""
        x, y = self.centres.T
        return np.stack([x - _HALF_STROKE_MM, y, x + _HALF_STROKE_MM], axis=-1)


@dataclass(frozen=True)
class Text:
    """A line of text: its left end on the base line, and the height of its type in mm."""

    x_mm: float
    y_mm: float
    height_mm: float
    text: str


@dataclass(eq=False)
class PrintedPage:
    """A page.

    Attributes
    ----------
    width_mm, height_mm
        Its size.
    title
        Title of the file.
    rectangles
        Black rectangles (n, 4): left, top, right, bottom in mm.
    discs, texts
        See there.
    """

    width_mm: float
    height_mm: float
    title: str
    rectangles: list[Float] = field(default_factory=list)
    discs: list[Discs] = field(default_factory=list)
    texts: list[Text] = field(default_factory=list)

    def data(self, form: str) -> bytes:
        """Return the file, ``pdf`` or ``svg``."""
        return self.pdf() if form == "pdf" else self.svg()

    def svg(self) -> bytes:
        """Return the page as an SVG file."""
        w, h = _number(self.width_mm), _number(self.height_mm)
        lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{w}mm" height="{h}mm" viewBox="0 0 {w} {h}">',
            f"<title>{escape(self.title)}</title>",
            f'<rect width="{w}" height="{h}" fill="white"/>',
            '<path fill="black" d="',
            *(f"M{a} {b}H{c}V{d}H{a}Z" for a, b, c, d in _numbers(self.rectangles)),
            '"/>',
        ]
        for discs in self.discs:
            colour, width = "white" if discs.white else "black", _number(discs.diameter_mm)
            lines.append(f'<path fill="none" stroke="{colour}" stroke-width="{width}" stroke-linecap="round" d="')
            lines += [f"M{a} {y}H{b}" for a, y, b in _numbers([discs.strokes()])]
            lines.append('"/>')
        for text in self.texts:
            place = f'x="{_number(text.x_mm)}" y="{_number(text.y_mm)}" font-size="{_number(text.height_mm)}"'
            lines.append(f'<text {place} font-family="Helvetica, Arial, sans-serif">{escape(text.text)}</text>')
        return "\n".join([*lines, "</svg>", ""]).encode()

    def pdf(self) -> bytes:
        """Return the page as a PDF file, which asks the printing program not to scale it."""
        content = zlib.compress("\n".join(self._operators()).encode("latin-1", "replace"))
        size = f"{_POINTS_PER_MM * self.width_mm:.5f} {_POINTS_PER_MM * self.height_mm:.5f}"
        return _pdf_file(
            b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size}] /Contents 4 0 R "
            "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
            f"<< /Length {len(content)} /Filter /FlateDecode >>\nstream\n".encode() + content + b"\nendstream",
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
            f"<< /Title ({_pdf_text(self.title)}) >>".encode("latin-1", "replace"),
        )

    def _operators(self) -> Iterator[str]:
        # from here on a unit is a millimetre, and Y points down
        yield f"{_POINTS_PER_MM:.9f} 0 0 {-_POINTS_PER_MM:.9f} 0 {_POINTS_PER_MM * self.height_mm:.5f} cm"
        drawn = False
        for a, b, c, d in _numbers(self.rectangles):
            drawn = True
            yield f"{a} {b} m {c} {b} l {c} {d} l {a} {d} l h"
        if drawn:
            yield "f"
        yield "1 J"
        for discs in self.discs:
            yield f"{int(discs.white)} G {_number(discs.diameter_mm)} w"
            for k, (a, y, b) in enumerate(_numbers([discs.strokes()])):
                if k and k % _DISCS_A_PATH == 0:
                    yield "S"
                yield f"{a} {y} m {b} {y} l"
            yield "S"
        for text in self.texts:
            place = f"1 0 0 -1 {_number(text.x_mm)} {_number(text.y_mm)} Tm"
            yield f"BT /F {_number(text.height_mm)} Tf {place} ({_pdf_text(text.text)}) Tj ET"


def _number(value: float) -> str:
    return f"{value:.4f}".rstrip("0").rstrip(".")


def _numbers(arrays: Iterable[Float]) -> Iterator[list[str]]:
    """Yield each row of the arrays as text, to a tenth of a micrometre."""
    for array in arrays:
        for row in array.tolist():
            yield [_number(value) for value in row]


def _pdf_text(text: str) -> str:
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _pdf_file(*objects: bytes) -> bytes:
    """Return a PDF file of these objects: the first is its catalogue, the last describes it."""
    data, places = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n", []
    for k, content in enumerate(objects, start=1):
        places.append(len(data))
        data += f"{k} 0 obj\n".encode() + content + b"\nendobj\n"
    count, start = len(objects) + 1, len(data)
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    trailer = f"trailer\n<< /Size {count} /Root 1 0 R /Info {count - 1} 0 R >>\nstartxref\n{start}\n%%EOF\n"
    return data + f"xref\n0 {count}\n0000000000 65535 f \n{table}{trailer}".encode()
