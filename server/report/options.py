"""Choices about a report: its sections, the laboratory's logo, the page that its links lead to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from stereorig.core.errors import InputError

#: sections by the name of their heading's anchor, in the order of the page
SECTIONS = {
    "fields": "maps of the steps that are drawn, and of the reference",
    "histories": "courses of load, motion, strain and gauges",
    "steps": "tables of the steps",
    "models": "comparison with a model",
    "test": "purpose, specimen, operator",
    "hardware": "cameras, lenses, geometry, light, pattern",
    "analysis": "subset, filters, strain window",
    "noise-floor": "noise floor and bias from static steps",
    "uncertainty": "sentence to quote, budgets",
    "calibration": "verdict, checks, parameters",
    "seen": "reference images with the measured points",
    "not-stated": "items that nobody stated",
    "annex": "settings and checksums of the files",
}


@dataclass(frozen=True)
class ReportOptions:
    """Choices about a report.

    Attributes
    ----------
    sections
        Names of :data:`SECTIONS`.
    logo
        File of the logo; None: ``report_logo.png``, ``.jpg`` or ``.svg`` of the data folder, if it has one.
    service_url
        Address of the service, whose forms the report links; empty: no links.
    """

    sections: Sequence[str] = field(default_factory=lambda: tuple(SECTIONS))
    logo: Path | None = None
    service_url: str = ""


def chosen_sections(names: Sequence[str]) -> tuple[str, ...]:
    """Return sections in the order of the page.

    Raises
    ------
    InputError
        An unknown name, or none.
    """
    unknown = [name for name in names if name not in SECTIONS]
    if unknown or not names:
        raise InputError(
            f"{unknown[0][:40]!r} is not a section of the report." if unknown else "No section is named.",
            remedy=f"Choose from {', '.join(SECTIONS)}.",
        )
    return tuple(name for name in SECTIONS if name in names)
