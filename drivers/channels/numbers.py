"""The number in a line of an instrument: a decimal comma, thousands, a separate sign, a unit behind it.

A line that could mean two numbers gives none: the setting that decides is named.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

Decimal = Literal[".", ","]

_SIGN_APART = re.compile(r"(^|[\s,;:=])([+-])[ \t]{1,8}([0-9.,])")
_BETWEEN_DIGITS = re.compile(r"[0-9],[0-9]")
_GROUP_APART = re.compile(r"([0-9])[ \u00a0\u202f]([0-9]{3})([^0-9]|$)")
_SIGN_BEFORE = re.compile(r"(^|[^\w.)])-[ \t]{0,8}$")
_NUMBER = re.compile(
    r"([+-]?(?:[0-9]{1,30}\.?[0-9]{0,30}|\.[0-9]{1,30})(?:[eE][+-]?[0-9]{1,3})?)([^\W0-9_][^0-9]{0,12}|%|)"
)
_WHOLE = re.compile(r"[+-]?[0-9]{1,3}")
_GROUPED = re.compile(r"[0-9],[0-9]{3}\.")
_UNSURE = "a comma between digits: declare decimal, or thousands"


@dataclass(frozen=True, kw_only=True)
class Notation:
    """Notation of an instrument's numbers.

    Attributes
    ----------
    decimal
        Decimal sign; None: a point, and a comma between two digits is refused, since it may be a decimal comma, group
        thousands or part two numbers.
    thousands
        Sign that groups thousands; None: there is none.
    """

    decimal: Decimal | None = None
    thousands: Literal[",", ".", " ", "'"] | None = None

    def column(self, line: str, column: int) -> float | str:
        """Return the number in a part of a line, from 1; the reason if there is none.

        Semicolons and blanks separate parts, and commas unless they are decimal or group thousands.
        """
        text = _SIGN_APART.sub(r"\1\2\3", line.strip())
        if self._is_unsure(text):
            return _UNSURE
        marks = ";" if "," in (self.decimal, self.thousands) else ",;"
        if self.thousands == " ":
            while (joined := _GROUP_APART.sub(r"\1\2\3", text)) != text:
                text = joined
        # a sign and a number may touch a mark; of several blanks in a row none is a part
        parts = [part for piece in re.split(f"[{marks}]", text) for part in piece.split() or [""]]
        if column > len(parts):
            return f"it has {len(parts)} parts"
        return self.number(parts[column - 1])

    def group(self, line: str, pattern: re.Pattern[str]) -> float | str:
        """Return the number in the first group of a pattern; the reason if there is none, or if it cuts a number."""
        found = pattern.search(line)
        if found is None or found.group(1) is None:
            return "the pattern finds nothing"
        before, after = line[: found.start(1)], line[found.end(1) :]
        if _SIGN_BEFORE.search(before):
            return "the pattern leaves out the sign"
        if re.search(r"[0-9][.,]?$", before) or re.match(r"[.,]?[0-9]", after):
            return "the pattern cuts a number"
        return self.number(_SIGN_APART.sub(r"\1\2\3", found.group(1).strip()))

    def number(self, text: str) -> float | str:
        """Return the number that a text contains, with any unit behind it; the reason if it contains none."""
        if self._is_unsure(text):
            return _UNSURE
        mark = self.thousands
        if mark is not None and mark in text:
            whole, *groups = text.partition(self.decimal or ".")[0].split(mark)
            if not _WHOLE.fullmatch(whole) or any(len(part.strip()) != 3 for part in groups):
                return f"{text!r} is not grouped in thousands by {mark!r}"
            text = text.replace(mark, "")
        if self.decimal == ",":
            if "." in text:
                return f"{text!r} has a point, and the comma is declared decimal"
            text = text.replace(",", ".")
        found = _NUMBER.fullmatch(text)
        if found is None:
            return f"{text!r} is no number"
        value = float(found.group(1))
        return value if math.isfinite(value) else f"{text!r} is no number"

    def _is_unsure(self, text: str) -> bool:
        if self.decimal == "," or self.thousands == ",":
            return False
        return (_BETWEEN_DIGITS if self.decimal is None else _GROUPED).search(text) is not None
