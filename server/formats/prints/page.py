"""The page of a print: its size, its rulers, and the place that they leave for a pattern."""

from __future__ import annotations

import re

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.server.formats.prints.drawing import PrintedPage, Text

PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}
PAPER_HELP = "A4, A3, letter, or WIDTHxHEIGHT in mm"
_SMALLEST_MM, _LARGEST_MM = 40.0, 3000.0
_SIZE = re.compile(r"([0-9]{1,4}(?:\.[0-9]{1,3})?)x([0-9]{1,4}(?:\.[0-9]{1,3})?)")
_STRIP_MM = 14.0  # of a ruler with its numbers, and of the caption below the lower one
_TICK_MM, _TICK_WIDTH_MM, _TYPE_MM = 4.0, 0.1, 2.5


def laid_out(
    extent_mm: tuple[float, float], paper: str, margin_mm: float, clear_mm: float, title: str
) -> tuple[PrintedPage, Float]:
    """Return a page with its rulers, and the middle of the place for a pattern.

    Parameters
    ----------
    extent_mm
        Width and height of the pattern.
    paper
        Name or size of the paper; one with a name is turned if the pattern fits only so.
    margin_mm
        Rim on which the printer does not print.
    clear_mm
        White about the pattern.
    title
        Caption, and title of the file.

    Raises
    ------
    InputError
        ``print_page`` for a paper that is none, ``print_too_large`` for a pattern that does not fit.
    """
    if not 0.0 <= margin_mm <= _SMALLEST_MM:
        raise InputError(
            f"The margin is {margin_mm:g} mm.",
            code="print_page",
            remedy=f"Give a margin from 0 to {_SMALLEST_MM:g} mm.",
        )
    width, height = paper_mm(paper)
    room = _room(width, height, margin_mm, clear_mm)
    if not _fits(extent_mm, room) and paper in PAPERS:
        turned = _room(height, width, margin_mm, clear_mm)
        if _fits(extent_mm, turned):
            width, height, room = height, width, turned
    if not _fits(extent_mm, room):
        available = np.maximum(room[2:] - room[:2], 0.0)
        raise InputError(
            f"The pattern has {extent_mm[0]:.6g} x {extent_mm[1]:.6g} mm; {paper} with margins of {margin_mm:g} mm, "
            f"rulers and a white rim of {clear_mm:g} mm leaves {available[0]:.6g} x {available[1]:.6g} mm.",
            code="print_too_large",
            remedy="Choose a larger paper, a smaller pitch or fewer points.",
        )
    drawing = PrintedPage(width, height, title)
    _add_rulers(drawing, margin_mm)
    return drawing, 0.5 * (room[:2] + room[2:])


def room_mm(paper: str, margin_mm: float, clear_mm: float) -> tuple[float, float]:
    """Return width and height of the place that a paper leaves for a pattern; 0 where there is none."""
    room = _room(*paper_mm(paper), margin_mm, clear_mm)
    return max(float(room[2] - room[0]), 0.0), max(float(room[3] - room[1]), 0.0)


def paper_mm(paper: str) -> tuple[float, float]:
    """Return a paper's width and height.

    Raises
    ------
    InputError
        ``print_page``.
    """
    if paper in PAPERS:
        return PAPERS[paper]
    found = _SIZE.fullmatch(paper)
    if found is None or not all(_SMALLEST_MM <= float(side) <= _LARGEST_MM for side in found.groups()):
        raise InputError(
            f"{paper[:40]!r} is no paper.",
            code="print_page",
            remedy=f"Name {PAPER_HELP}, each from {_SMALLEST_MM:g} to {_LARGEST_MM:g}, as 600x400.",
        )
    return float(found[1]), float(found[2])


def _room(width: float, height: float, margin: float, clear: float) -> Float:
    """Left, top, right and bottom of the place beside both rulers."""
    rim, strip = max(margin, clear), margin + _STRIP_MM + clear
    return np.array([strip, rim, width - rim, height - strip])


def _fits(extent: tuple[float, float], room: Float) -> bool:
    return bool((np.asarray(extent) <= room[2:] - room[:2] + 1e-9).all())


def _add_rulers(drawing: PrintedPage, margin: float) -> None:
    """Draw a ruler along the lower and along the left rim: marks of every millimetre, and the caption."""
    left, foot = margin + _STRIP_MM, drawing.height_mm - margin - 0.5 * _STRIP_MM
    across, down = (int((side - left - margin - 5.0) // 10) * 10 for side in (drawing.width_mm, drawing.height_mm))
    for length, vertical in ((across, False), (down, True)):
        at = np.arange(length + 1)
        long = _TICK_MM * np.where(at % 10 == 0, 1.0, np.where(at % 5 == 0, 0.75, 0.5))
        half = 0.5 * _TICK_WIDTH_MM
        low, high = (margin + at - half, margin + at + half) if vertical else (left + at - half, left + at + half)
        if vertical:
            marks = [np.full(len(at), margin), low, margin + long, high]
        else:
            marks = [low, foot - long, high, np.full(len(at), foot)]
        drawing.rectangles.append(np.stack(marks, axis=-1))
        for k in range(0, length + 1, 10):
            text = f"{k} mm" if k == length else f"{k}"
            x, y = (margin + _TICK_MM + 1.0, margin + k + 0.35 * _TYPE_MM) if vertical else (left + k, foot + _TYPE_MM)
            drawing.texts.append(Text(x, y, _TYPE_MM, text))
    caption = f"{drawing.title}. Print at 100 %, then measure both rulers."
    drawing.texts.append(Text(left, drawing.height_mm - margin - 0.5, _TYPE_MM, caption))
