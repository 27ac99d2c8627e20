"""Pages drawn as pixels by programs that know nothing of this one: PDFium for PDF, Chromium for SVG."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stereorig.server.formats.prints.drawing import PrintedPage


def pdf_image(drawing: PrintedPage, per_mm: float) -> NDArray[np.uint8]:
    """Draw the page's PDF; without rounding of its size to pixels, which would change its scale."""
    pdfium: Any = pytest.importorskip("pypdfium2", reason="pypdfium2 not found: pip install pypdfium2 to draw PDF")
    raw = pdfium.raw
    page = pdfium.PdfDocument(drawing.pdf())[0]
    width, height = round(drawing.width_mm * per_mm), round(drawing.height_mm * per_mm)
    bitmap = pdfium.PdfBitmap.new_native(width, height, raw.FPDFBitmap_Gray)
    bitmap.fill_rect((255, 255, 255, 255), 0, 0, width, height)
    scale = per_mm * 25.4 / 72.0
    matrix, clip = raw.FS_MATRIX(scale, 0, 0, scale, 0, 0), raw.FS_RECTF(0, 0, width, height)
    raw.FPDF_RenderPageBitmapWithMatrix(bitmap, page, matrix, clip, 0)
    return np.array(bitmap.to_numpy(), dtype=np.uint8).reshape(height, width)


def svg_image(drawing: PrintedPage, per_mm: float) -> NDArray[np.uint8]:
    """Draw the page's SVG; the page's size must be a whole number of pixels."""
    from tests.support.page_bench import browser

    width, height = round(drawing.width_mm * per_mm), round(drawing.height_mm * per_mm)
    source = base64.b64encode(drawing.svg()).decode()
    image = f'<img width="{width}" height="{height}" src="data:image/svg+xml;base64,{source}">'
    with browser() as chromium:
        page = chromium.new_page(viewport={"width": width, "height": height})
        page.set_content(f"<style>*{{margin:0}}img{{display:block}}</style>{image}")
        page.wait_for_function("document.images[0].complete")
        shot = np.frombuffer(page.screenshot(), np.uint8)
    return np.asarray(cv2.imdecode(shot, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def as_seen(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a page as a camera exposes it: paper is not white, ink is not black."""
    return np.rint(30.0 + image * (190.0 / 255.0)).astype(np.uint8)
