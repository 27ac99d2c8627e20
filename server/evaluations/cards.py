"""What cards of tests have in common: numbers with their intervals, marks, tables and pages."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, Field

COVERAGE = 1.959963984540054  # of a normal distribution, 95 %
NUMBER_COLUMNS = ("symbol", "value", "units", "u", "lower_95", "upper_95", "state", "why")
_STYLE = "body{font-family:sans-serif}table{border-collapse:collapse}td,th{border:1px solid;padding:.2em .6em}"


class Lack(NamedTuple):
    """Why there is no number."""

    code: str
    text: str


@dataclass(frozen=True)
class Mark:
    """Something that the data show.

    Attributes
    ----------
    code
        What it is.
    text
        In words.
    steps
        Numbers of the steps.
    spoils
        Numbers of the card that are doubtful for it.
    """

    code: str
    text: str
    steps: tuple[int, ...] = ()
    spoils: tuple[str, ...] = ()


class CardNumber(BaseModel):
    """A number of the card."""

    key: str = Field(description="Its key, the same in all standards.")
    value: float | None = Field(description="The number; null if there is none.")
    units: str = Field(description="Unit; 1 of a ratio.")
    u: float | None = Field(None, description="Standard uncertainty (k = 1).")
    lower: float | None = Field(None, description="Lower end of the 95 % interval.")
    upper: float | None = Field(None, description="Upper end of the 95 % interval.")
    state: Literal["good", "doubtful", "missing"] = Field(description="Whether it can be used.")
    why: str = Field("", description="Why it is doubtful or missing.")
    parts: dict[str, float] = Field(default_factory=dict, description="Standard uncertainty by cause.")


class MarkFound(BaseModel):
    """Something that the data show."""

    code: str = Field(description="What it is.")
    text: str = Field(description="In words.")
    steps: list[int] = Field(description="Steps in which it is seen.")


def number_found(key: str, value: float, units: str, parts: Mapping[str, float], doubts: Sequence[str]) -> CardNumber:
    """Return a number with its interval; ``parts`` are standard uncertainties by cause, ``doubts`` codes of marks."""
    u = float(np.sqrt(sum(part**2 for part in parts.values())))
    return CardNumber(
        key=key,
        value=value,
        units=units,
        u=u,
        lower=value - COVERAGE * u,
        upper=value + COVERAGE * u,
        state="doubtful" if doubts else "good",
        why=", ".join(doubts),
        parts=dict(parts),
    )


def number_missing(key: str, units: str, why: str) -> CardNumber:
    """Return a number that is missing for a reason."""
    return CardNumber(key=key, value=None, units=units, state="missing", why=why)


def cells_of(symbol: str, one: CardNumber) -> tuple[object, ...]:
    """Return the cells of a number, by :data:`NUMBER_COLUMNS`."""
    return symbol, one.value, one.units, one.u, one.lower, one.upper, one.state, one.why


def page(
    title: str,
    head: str,
    tables: Mapping[str, Mapping[str, CardNumber]],
    marks: Iterable[MarkFound],
    items: Mapping[str, str] | None = None,
) -> str:
    """Return a card as an HTML page that needs nothing else.

    It has a table of numbers for each heading, the marks, and a table of further items by name.
    """
    body = []
    for heading, numbers in tables.items():
        rows = [_row("td", _shown(symbol, one)) for symbol, one in numbers.items()]
        above = f"<h2>{html.escape(heading)}</h2>" if heading else ""
        titles = ("", "value", "u (k = 1)", "95 % interval", "unit", "state")
        body.append(f"{above}<table>{_row('th', titles)}{''.join(rows)}</table>")
    each = "".join(_row("td", item) for item in (items or {}).items())
    listed = "".join(f"<li>{html.escape(mark.code)}: {html.escape(mark.text)}</li>" for mark in marks)
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1><p>{html.escape(head)}</p>"
        f"{''.join(body)}<ul>{listed}</ul>{f'<table>{each}</table>' if each else ''}</html>\n"
    )


def _shown(symbol: str, one: CardNumber) -> tuple[str, ...]:
    figures = ("", "", "")
    if one.value is not None:
        figures = f"{one.value:.5g}", f"{one.u:.2g}", f"{one.lower:.5g} to {one.upper:.5g}"
    state = one.state if one.state == "good" else f"{one.state}: {one.why}"
    return symbol, *figures, one.units if one.units != "1" else "", state


def _row(cell: str, texts: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{cell}>{html.escape(text)}</{cell}>' for text in texts)}</tr>"
