"""Text files of one name and one number a line."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from stereorig.server.formats.calibrations.programs.imported_pair import invalid, unreadable

MAX_LINE = 1000  # characters
_LOOKED_AT = 65536  # bytes of a file whose kind is asked


def has_line(data: bytes, begin: re.Pattern[bytes]) -> bool:
    """Return True if a line near the file's begin starts with this, blanks before it left out."""
    return any(begin.match(line.lstrip()) for line in data[:_LOOKED_AT].splitlines())


def named_numbers(
    data: bytes,
    *,
    name: str,
    parted: Callable[[str], tuple[str, str]],
    key_of: Callable[[str], str],
    is_remark: Callable[[str], bool],
) -> dict[str, float]:
    """Return the numbers of a file by their names.

    Parameters
    ----------
    data, name
        The file, and its name in errors.
    parted
        Splits a line into a name and a number; returns empty texts for a line that is neither.
    key_of
        Turns a name as written into the name that is looked up.
    is_remark
        True for a key whose value may be text, which is then left out.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable`` or ``calibration_invalid``.
    """
    values: dict[str, float] = {}
    for number, line in enumerate(data.decode("utf-8-sig", "replace").splitlines(), 1):
        if not line.strip():
            continue
        written, text = parted(line) if len(line) <= MAX_LINE else ("", "")
        if not written or not text:
            raise unreadable(name, f"line {number} is no name and value")
        key = key_of(written)
        if key in values:
            raise unreadable(name, f"{written} occurs twice in it")
        try:
            if not text.isascii():  # other scripts' digits
                raise ValueError
            values[key] = float(text)
        except ValueError as error:
            if is_remark(key):
                continue
            raise unreadable(name, f"{written} is {text!r}, not a number") from error
        if not np.isfinite(values[key]):
            raise invalid(name, f"{written} is {text}")
    return values
