"""Texts in CSV that a spreadsheet shows and never runs.

A cell that begins with ``= + - @`` (or their full-width forms), a tab or a line end is a formula for Excel, LibreOffice
and others. An apostrophe before it makes it text; numbers stay as they are.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable

_FORMULA = "=+\\-@\uff1d\uff0b\uff0d\uff20"
_RUNS = re.compile(f"[{_FORMULA}\t\r\n]")
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
# a spreadsheet parts a comment line too, at the separator of its own country
_IN_COMMENT = re.compile(f'([,;\t][ "]*)([{_FORMULA}][0-9.]?)')


def harmless(text: str) -> str:
    """Return a text with an apostrophe before it if a spreadsheet would run it as a formula."""
    return f"'{text}" if _RUNS.match(text) and not _NUMBER.fullmatch(text) else text


def row(cells: Iterable[object]) -> str:
    """Return a line of CSV with its line end; texts are made harmless, and quoted if they must be."""
    line = io.StringIO(newline="")
    # csv quotes the characters of its line end: an unquoted return would begin a line for a spreadsheet
    csv.writer(line, lineterminator="\r\n").writerow(harmless(c) if isinstance(c, str) else c for c in cells)
    return line.getvalue().removesuffix("\r\n") + "\n"


def comment(text: str) -> str:
    """Return a comment line (``# text``) with its line end, which no spreadsheet runs, with any cell separator."""
    return f"# {_IN_COMMENT.sub(_with_apostrophe, ' '.join(text.splitlines()))}\n"


def _with_apostrophe(found: re.Match[str]) -> str:
    """Put an apostrophe before a formula, unless it is a number."""
    before, formula = found.groups()
    return found[0] if formula[0] in "-+" and len(formula) == 2 else f"{before}'{formula}"
