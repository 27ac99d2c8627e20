"""Notation of the numbers of a record: a decimal point or comma, groups of thousands, and cells that are not sure."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.formats.load_frames.description import Decimal, RecordQuestion, shown

_GROUPS = "' \u2019\u00a0\u2009\u202f"
_PLAIN = {".": re.compile(r"[-+0-9eE\n.]*"), ",": re.compile(r"[-+0-9eE\n,]*")}


def _form(mark: str, group: str) -> str:
    """Return digits with one decimal mark and an exponent, or digits in groups of three by one and the same sign."""
    return (
        rf"[-+]?(?:(?:[0-9]+(?:[{mark}][0-9]*)?|[{mark}][0-9]+)(?:[eEdD][-+]?[0-9]{{1,3}})?"
        rf"|[1-9][0-9]{{0,2}}(?P<group>[{group}{_GROUPS}])[0-9]{{3}}(?:(?P=group)[0-9]{{3}})*(?:[{mark}][0-9]*)?)"
    )


_NUMBER = {".": re.compile(_form(".", ",")), ",": re.compile(_form(",", "."))}
_STRIPPED = {mark: str.maketrans(dict.fromkeys(f"{group}{_GROUPS}")) for mark, group in ((".", ","), (",", "."))}
#: states that there was no reading
_NONE = frozenset(("nan", "n/a", "na", "#n/a", "null", "none", "-", "--", "---"))


@dataclass(frozen=True)
class Cells:
    """A column's cells as numbers; NaN for those that are none.

    Attributes
    ----------
    unread, stated
        Of cells that are neither empty nor a number, and of those that state that there was no reading.
    """

    values: Float
    unread: list[int]
    stated: list[int]


def marks_of(cells: Sequence[str]) -> tuple[dict[str, int], str]:
    """Return how many cells allow one decimal mark only, by the mark, and the first cell that allows two values.

    ``1,234`` is 1.234 or 1234; ``12,5`` and ``0,125`` are decimals, ``1,234,567`` and ``1,234.5`` groups.
    """
    sure, open_ = {".": 0, ",": 0}, ""
    text = "".join(cells)
    both = "," in text and "." in text
    if not both and "," not in text and "." not in text:
        return sure, open_
    for cell in cells:
        if "," in cell or "." in cell:
            signed = cell.replace("\u2212", "-")
            taken = [mark for mark, pattern in _NUMBER.items() if pattern.fullmatch(signed)]
            if len(taken) == 1:
                sure[taken[0]] += 1
                if not both:
                    break
            elif taken:
                open_ = open_ or cell
    return sure, open_


def decimals(
    columns: Mapping[int, Sequence[str]], titles: Sequence[str], wanted: Decimal | None, separator: str
) -> tuple[dict[int, Decimal], RecordQuestion | None]:
    """Return each column's decimal mark: its own cells decide, else the other columns', else the file is asked about.

    Parameters
    ----------
    columns
        Cells of the columns, by their index.
    wanted
        Decimal mark of all columns, given by the user; None: recognised.
    """
    if wanted is not None:
        return dict.fromkeys(columns, wanted), None
    found: dict[int, Decimal] = {}
    left: dict[int, str] = {}
    for k, cells in columns.items():
        sure, open_ = marks_of(cells)
        if any(sure.values()):
            found[k] = "." if sure["."] >= sure[","] else ","
        else:
            left[k] = open_
    marks = set(found.values())
    if len(marks) == 1:
        return found | dict.fromkeys(left, marks.pop()), None
    found |= dict.fromkeys(left, ".")
    # commas that part the cells are no decimal marks
    asked = [k for k, cell in left.items() if cell and (marks or "," in cell or separator != "comma")]
    if not asked:
        return found, None
    cause = (
        f"{shown(left[asked[0]])!r} in the column {titles[asked[0]]!r} has a decimal mark or groups thousands, and no "
        "other cell decides it."
    )
    return found, RecordQuestion(option="decimal", cause=cause, choices=[".", ","])


def read_cells(cells: Sequence[str], decimal: Decimal) -> Cells:
    """Return a column's cells as numbers."""
    text = "\n".join(cells)
    if _PLAIN[decimal].fullmatch(text):
        try:
            values = np.array([float(cell) for cell in text.replace(",", ".").split("\n")])
        except ValueError:
            pass  # an empty cell, or one that is no number
        else:
            if np.isfinite(values).all():
                return Cells(values, [], [])
    found = np.full(len(cells), np.nan)
    unread: list[int] = []
    stated: list[int] = []
    for k, cell in enumerate(cells):
        number = _number(cell, decimal)
        if number is not None and np.isfinite(number):
            found[k] = number
        elif cell:
            (stated if cell.lower() in _NONE else unread).append(k)
    return Cells(found, unread, stated)


def _number(cell: str, decimal: Decimal) -> float | None:
    signed = cell.replace("\u2212", "-")
    if not _NUMBER[decimal].fullmatch(signed):
        return None
    plain = signed.translate(_STRIPPED[decimal]).replace(",", ".")
    return float(plain.replace("d", "e").replace("D", "e"))
