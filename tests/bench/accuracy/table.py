"""Rows and sections of the tables on accuracy."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One measured figure with its limit (None: stated, not limited)."""

    what: str
    measured: float
    unit: str
    limit: float | None = None
    at_least: bool = False

    @property
    def met(self) -> bool:
        """True if the limit is kept, or there is none."""
        if self.limit is None:
            return True
        # written so that NaN does not pass
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    def _limit(self) -> str:
        if self.limit is None:
            return ""
        return f"{'>=' if self.at_least else '<='} {self.limit:g}"

    def cells(self) -> tuple[str, str, str, str, str]:
        """Return name, measured value, limit, unit and verdict as a table has them."""
        met = "" if self.limit is None else ("yes" if self.met else "no")
        return self.what, f"{self.measured:.4g}", self._limit(), self.unit, met

    def text(self) -> str:
        """One line for the terminal."""
        flag = "" if self.met else "   <-- MISSED"
        return f"{self.what:70s} {self.measured:10.4g} {self.unit:6s} limit {self._limit():11s}{flag}"


@dataclass(frozen=True)
class Section:
    """One section of a table: its title, the conditions of its figures, rows, plots (file, caption) and notes."""

    title: str
    how: str
    rows: list[Row]
    figures: list[tuple[str, str]]
    notes: list[str]
