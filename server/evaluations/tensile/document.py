"""The material card as a document, a table and a page."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from stereorig.server.base.models import Reply
from stereorig.server.evaluations.cards import NUMBER_COLUMNS, CardNumber, MarkFound, cells_of, page
from stereorig.server.formats.csv_cells import row


class CurveFound(BaseModel):
    """The curve, a value a step."""

    steps: list[int] = Field(description="Numbers of the steps.")
    strain: list[float | None] = Field(description="Engineering strain along the pull.")
    lateral: list[float | None] = Field(description="Engineering strain across it.")
    stress_mpa: list[float | None] = Field(description="Engineering stress.")
    strain_u: list[float | None] = Field(description="Standard uncertainty of the strain.")
    stress_u_mpa: list[float | None] = Field(description="Standard uncertainty of the stress.")
    true_strain: list[float | None] = Field(description="True strain of the local gauge; without one of the gauge.")
    true_strain_u: list[float | None] = Field(description="Its standard uncertainty.")
    true_stress_mpa: list[float | None] = Field(
        description="True stress there, at constant volume; past the largest load of a local gauge in the neck alone."
    )


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
    return "".join(map(row, [NUMBER_COLUMNS, *(cells_of(symbol, one) for symbol, one in card.numbers.items())]))


def page_of(title: str, card: MaterialCardFound) -> str:
    """Return the card as an HTML page."""
    return page(title, f"{card.standard}, {card.section_mm2:.5g} mm2: {card.verdict}", {"": card.numbers}, card.marks)
