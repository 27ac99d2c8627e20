"""Text files of one name and one number a line."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from server.formats.calibrations.programs.imported_pair import invalid, unreadable


def named_numbers(
    data: bytes,
    *,
    name: str,
    line_form: re.Pattern[str],
    key_of: Callable[[str], str],
    is_remark: Callable[[str], bool],
) -> dict[str, float]:
    """Return the numbers of a file by their names.

    Parameters
    ----------
    data, name
        The file, and what it is called in errors.
    line_form
        A line: its name and its number as groups.
    key_of
        From a name as written to the one that is looked up.
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
        found = line_form.fullmatch(line)
        if found is None:
            raise unreadable(name, f"line {number} is no name and value")
        written, text = found[1], found[2]
        key = key_of(written)
        if key in values:
            raise unreadable(name, f"{written} occurs twice in it")
        try:
            values[key] = float(text)
        except ValueError as error:
            if is_remark(key):
                continue
            raise unreadable(name, f"{written} is {text!r}, not a number") from error
        if not np.isfinite(values[key]):
            raise invalid(name, f"{written} is {text}")
    return values
