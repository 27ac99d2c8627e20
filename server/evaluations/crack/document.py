"""The crack's numbers as a document, a table and a page."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from stereorig.server.base.models import Reply
from stereorig.server.evaluations.cards import NUMBER_COLUMNS, CardNumber, MarkFound, cells_of, page
from stereorig.server.evaluations.centre_crack import by_load
from stereorig.server.formats.csv_cells import row


class RingFound(BaseModel):
    """J over a ring about the tip."""

    inner_mm: float = Field(description="Inner distance from the tip.")
    outer_mm: float = Field(description="Outer distance.")
    j: float = Field(description="J, N/mm.")
    u: float = Field(description="Its standard uncertainty, without the modulus'.")


class OpeningFound(BaseModel):
    """Opening of the faces behind the tip."""

    behind_mm: list[float] = Field(description="Distances behind the tip.")
    across_mm: list[float] = Field(description="Opening across the crack.")
    across_u_mm: list[float] = Field(description="Its standard uncertainty.")
    along_mm: list[float] = Field(description="Displacement of the upper face against the lower one, along the crack.")
    along_u_mm: list[float] = Field(description="Its standard uncertainty.")


class OutOfPlaneFound(BaseModel):
    """Motion out of the plane about the tip, without the rigid motion."""

    highest_mm: float = Field(description="Largest displacement along the surface's normal.")
    lowest_mm: float = Field(description="Smallest.")
    u_mm: float = Field(description="Standard uncertainty of a point's.")
    slope: float | None = Field(description="Its slope over the ring, root mean square; null without one.")
    strain: float | None = Field(description="Strain in the plane, the same; half the slope's square adds to it.")


class CrackStepFound(BaseModel):
    """The crack in a step."""

    step: int = Field(description="Number of the step.")
    load_n: float | None = Field(description="Load; null if it is not known.")
    cycles: float | None = Field(description="Count of load cycles; null if it is not known.")
    state: Literal["good", "doubtful", "missing"] = Field(description="Whether its numbers can be used.")
    why: str = Field("", description="Why they are missing.")
    numbers: dict[str, CardNumber] = Field(default_factory=dict, description="The numbers by their symbols.")
    tip_px: list[float] | None = Field(None, description="The tip in camera 1's reference image.")
    order: int | None = Field(None, description="Order of the series.")
    points: int | None = Field(None, description="Points that the series is fitted to.")
    chi_square: float | None = Field(None, description="Of their distances from the series.")
    degrees: int | None = Field(None, description="Its degrees of freedom.")
    rings: list[RingFound] = Field(default_factory=list, description="J over each ring, the whole last.")
    opening: OpeningFound | None = Field(None, description="The faces' opening.")
    out_of_plane: OutOfPlaneFound | None = Field(None, description="Buckling about the tip.")


class GrowthFound(BaseModel):
    """Growth of the crack."""

    against: Literal["cycles", "steps"] = Field(description="What it is counted in.")
    steps: list[int] = Field(description="Steps with a tip.")
    at: list[float] = Field(description="Cycles or numbers of the steps.")
    length_mm: list[float] = Field(description="Length of the crack: of the drawn line, to the tip that is found.")
    u_mm: list[float] = Field(description="Its standard uncertainty, without that of the line's other end.")
    rate: list[float] = Field(description="Growth from each step to the next one, mm a cycle or a step.")
    rate_u: list[float] = Field(description="Its standard uncertainty; what both steps share cancels.")
    mean_rate: float = Field(description="Slope of the straight line through all steps.")
    mean_rate_u: float = Field(description="Its standard uncertainty.")


class CrackCardFound(Reply):
    """The numbers of a crack."""

    verdict: Literal["good", "doubtful", "incomplete"] = Field(
        description="Incomplete if no step has numbers, doubtful if those of a step are."
    )
    accepted: bool = Field(description="True if the verdict is good.")
    state: Literal["plane_stress", "plane_strain"] = Field(description="Stress state.")
    youngs_modulus_mpa: float = Field(description="Young's modulus.")
    poisson: float = Field(description="Poisson's ratio.")
    drawn_length_mm: float = Field(description="Length of the drawn line.")
    inner_mm: float = Field(description="Distance from the tip within which no point is used.")
    outer_mm: float = Field(description="Distance up to which points are used.")
    steps: list[CrackStepFound] = Field(description="The steps with displacements.")
    growth: GrowthFound | None = Field(description="Growth over the steps; null with less than two tips.")
    marks: list[MarkFound] = Field(description="What the data show.")
    not_included: list[str] = Field(description="Parts of the uncertainty that are not known and not included.")


def table_of(card: CrackCardFound) -> str:
    """Return the numbers as CSV."""
    lines: list[tuple[object, ...]] = [("step", "load_n", "cycles", *NUMBER_COLUMNS)]
    for one in card.steps:
        head = (one.step, one.load_n, one.cycles)
        lines += [(*head, *cells_of(symbol, number)) for symbol, number in one.numbers.items()]
        if one.state == "missing":
            lines.append((*head, *[None] * (len(NUMBER_COLUMNS) - 2), one.state, one.why))
    return "".join(map(row, lines))


def page_of(title: str, card: CrackCardFound) -> str:
    """Return the card as an HTML page."""
    head = f"{card.state.replace('_', ' ')}, E = {card.youngs_modulus_mpa:.5g} MPa, nu = {card.poisson:g}; points from "
    head += f"{card.inner_mm:.4g} to {card.outer_mm:.4g} mm: {card.verdict}"
    against = by_load({one.load_n: one.numbers for one in card.steps if one.load_n is not None})
    tables = {"K_I by load, measured and of the closed formula": against} if against else {}
    for one in card.steps:
        load = "" if one.load_n is None else f", {one.load_n:g} N"
        cycles = "" if one.cycles is None else f", {one.cycles:g} cycles"
        why = f": {one.why}" if one.state == "missing" else ""
        tables[f"Step {one.step}{load}{cycles}{why}"] = one.numbers
    return page(title, head, tables, card.marks)
