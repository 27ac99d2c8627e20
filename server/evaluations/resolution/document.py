"""The resolution study as a document, a table and a page."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, Field

from stereorig.server.base.models import Reply
from stereorig.server.evaluations.cards import NUMBER_COLUMNS, CardNumber, MarkFound, cells_of, page
from stereorig.server.formats.csv_cells import row


class SubsetFound(BaseModel):
    """Noise and resolution of displacements with one subset."""

    subset_px: int = Field(description="Subset.")
    patch: str = Field(description="Patch that most points were measured with.")
    l10_px: float = Field(description="Period of a displacement that keeps 90 % of its height.")
    l10_mm: float = Field(description="The same on the surface.")
    numbers: dict[str, CardNumber] = Field(
        description="Noise of u, v, w, its ratio to the reported one, its product with l10, and what the patch loses "
        "at the steepest place."
    )
    steepest_px: dict[str, tuple[float, float]] = Field(description="Those places in camera 1's reference image.")


class SettingFound(BaseModel):
    """Noise and resolution of one setting."""

    subset_px: int = Field(description="Subset.")
    spacing_px: float = Field(description="Distance of the points.")
    strain_window: int = Field(description="Points across the strain's window.")
    gauge_px: float = Field(description="Width of the virtual strain gauge.")
    l10_px: float = Field(description="Period of a strain that keeps 90 % of its height in the worse direction.")
    l10_mm: float = Field(description="The same on the surface.")
    numbers: dict[str, CardNumber] = Field(
        description="Noise, its ratio to the reported one, its product with l10^2, and what the gauge loses at the "
        "steepest place."
    )
    steepest_px: dict[str, tuple[float, float]] = Field(description="Those places in camera 1's reference image.")


class Reported(BaseModel):
    """An item of the tables."""

    item: str = Field(description="Its name in the guide.")
    value: str | None = Field(description="Its value; null: nobody stated it, and no record has it.")


class ResolutionFound(Reply):
    """Noise and spatial resolution of a test's pattern and rig."""

    verdict: Literal["met", "not met", "not asked"] = Field(description="Whether a setting has what was asked for.")
    accepted: bool = Field(description="False if none has it.")
    subset_px: int = Field(description="Subset of the measurement.")
    patch: str = Field(description="Its patch.")
    static_steps: list[int] = Field(description="Steps from which the noise is measured.")
    mm_per_px: float = Field(description="Size of a pixel on the surface, along its longer side.")
    l10_px: float = Field(description="Period of a displacement that keeps 90 % of its height.")
    l10_mm: float = Field(description="The same on the surface.")
    displacement: dict[str, CardNumber] = Field(description="The measured subset's numbers.")
    steepest_step: int | None = Field(description="Step whose steepest place was looked for; null without one.")
    subsets: list[SubsetFound] = Field(description="Displacements by subset, the measured one first.")
    settings: list[SettingFound] = Field(description="Strain by subset, spacing and window.")
    chosen: SettingFound | None = Field(
        description="The setting with the least noise that resolves the smallest feature; null without one."
    )
    marks: list[MarkFound] = Field(description="What the data show.")
    reporting: list[Reported] = Field(
        description="The iDICs guide's reporting tables, of the chosen setting or the first; empty without stated "
        "settings."
    )


def heading(one: SettingFound) -> str:
    """Return a setting in words."""
    return (
        f"Subset {one.subset_px} px, spacing {one.spacing_px:g} px, strain window {one.strain_window}: "
        f"gauge {one.gauge_px:g} px, l10 {one.l10_mm:.4g} mm"
    )


def table_of(card: ResolutionFound) -> str:
    """Return the numbers as CSV."""
    lines: list[tuple[object, ...]] = [("subset_px", "spacing_px", "strain_window", "l10_mm", *NUMBER_COLUMNS)]
    for own in card.subsets:
        head: tuple[object, ...] = (own.subset_px, None, None, own.l10_mm)
        lines += [(*head, *cells_of(symbol, number)) for symbol, number in own.numbers.items()]
    for one in card.settings:
        head = (one.subset_px, one.spacing_px, one.strain_window, one.l10_mm)
        lines += [(*head, *cells_of(symbol, number)) for symbol, number in one.numbers.items()]
    return "".join(map(row, lines))


def page_of(title: str, card: ResolutionFound) -> str:
    """Return the study as an HTML page."""
    chosen = "" if card.chosen is None else f"; chosen: {heading(card.chosen)}"
    head = f"{card.patch} patch, {card.mm_per_px:.4g} mm a pixel, {len(card.static_steps)} static steps"
    tables = {f"Displacement, subset {one.subset_px} px: l10 {one.l10_mm:.4g} mm": one.numbers for one in card.subsets}
    tables |= {heading(one): one.numbers for one in card.settings}
    items = {one.item: one.value or "not stated" for one in card.reporting}
    return page(title, f"{head}: {card.verdict}{chosen}", tables, card.marks, items)
