"""Rows and sections of the accuracy page."""

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
        """True where the limit is kept, or there is none."""
        if self.limit is None:
            return True
        # written so that NaN does not pass
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    def _limit(self) -> str:
        if self.limit is None:
            return ""
        return f"{'>= ' if self.at_least else ''}{self.limit:g}"

    @staticmethod
    def header() -> str:
        """Head of the table."""
        return "| what | measured | at most | unit | met |\n| --- | --- | --- | --- | --- |"

    def markdown(self) -> str:
        """One row of the table."""
        met = "" if self.limit is None else ("yes" if self.met else "**no**")
        return f"| {self.what} | {self.measured:.4g} | {self._limit()} | {self.unit} | {met} |"

    def text(self) -> str:
        """One line for the terminal."""
        flag = "" if self.met else "   <-- MISSED"
        return f"{self.what:70s} {self.measured:10.4g} {self.unit:6s} limit {self._limit():8s}{flag}"


@dataclass(frozen=True)
class Section:
    """One part of the page."""

    title: str
    how: str
    rows: list[Row]
    figures: list[tuple[str, str]]
    notes: list[str]
