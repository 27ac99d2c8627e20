"""The material card as a document, a table and a page."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Literal

from pydantic import BaseModel, Field

from stereorig.server.base.models import Reply
from stereorig.server.formats.csv_cells import row


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


class CurveFound(BaseModel):
    """The curve, a value a step."""

    steps: list[int] = Field(description="Numbers of the steps.")
    strain: list[float | None] = Field(description="Engineering strain along the pull.")
    lateral: list[float | None] = Field(description="Engineering strain across it.")
    stress_mpa: list[float | None] = Field(description="Engineering stress.")
    strain_u: list[float | None] = Field(description="Standard uncertainty of the strain.")
    stress_u_mpa: list[float | None] = Field(description="Standard uncertainty of the stress.")
    true_strain: list[float | None] = Field(description="True strain; of a gauge that is stretched alike.")
    true_stress_mpa: list[float | None] = Field(description="True stress, at constant volume; up to the largest load.")


class MaterialCardFound(Reply):
    """The material card of a test."""

    verdict: Literal["good", "doubtful", "incomplete"] = Field(
        description="Incomplete if a required number is missing, doubtful if a number is."
    )
    accepted: bool = Field(description="True if the verdict is good.")
    standard: str = Field(description="The standard.")
    section_mm2: float = Field(description="Section that the stress refers to.")
    numbers: dict[str, CardNumber] = Field(description="The numbers by their symbols.")
    toe_strain: float | None = Field(description="Strain at which the modulus' line has no stress; it is taken off.")
    window_steps: list[int] = Field(description="Steps of the modulus' window.")
    marks: list[MarkFound] = Field(description="What the data show of the test.")
    not_included: list[str] = Field(description="Parts of the uncertainty that are not known and not included.")
    curve: CurveFound = Field(description="The curve.")


def table_of(card: MaterialCardFound) -> str:
    """Return the numbers as CSV."""
    head = ("symbol", "value", "units", "u", "lower_95", "upper_95", "state", "why")
    each = [
        (symbol, one.value, one.units, one.u, one.lower, one.upper, one.state, one.why)
        for symbol, one in card.numbers.items()
    ]
    return "".join(map(row, [head, *each]))


def page_of(title: str, card: MaterialCardFound) -> str:
    """Return the card as an HTML page that needs nothing else."""
    rows = [
        (
            symbol,
            *(("", "", "") if one.value is None else _figures(one)),
            one.units if one.units != "1" else "",
            one.state if one.state == "good" else f"{one.state}: {one.why}",
        )
        for symbol, one in card.numbers.items()
    ]
    marks = "".join(f"<li>{html.escape(mark.code)}: {html.escape(mark.text)}</li>" for mark in card.marks)
    head = f"{html.escape(card.standard)}, {card.section_mm2:.5g} mm2: {card.verdict}"
    style = "body{font-family:sans-serif}table{border-collapse:collapse}td,th{border:1px solid;padding:.2em .6em}"
    titles = ("", "value", "u (k = 1)", "95 % interval", "unit", "state")
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{style}</style><h1>{html.escape(title)}</h1><p>{head}</p>"
        f"<table>{_row('th', titles)}{''.join(_row('td', cells) for cells in rows)}</table><ul>{marks}</ul></html>\n"
    )


def _figures(one: CardNumber) -> tuple[str, str, str]:
    return f"{one.value:.5g}", f"{one.u:.2g}", f"{one.lower:.5g} to {one.upper:.5g}"


def _row(cell: str, texts: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{cell}>{html.escape(text)}</{cell}>' for text in texts)}</tr>"
