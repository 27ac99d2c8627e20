"""K_I of a centre crack in a panel that is pulled across it: the closed formula beside what is measured."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from stereorig.core.errors import InputError
from stereorig.server.evaluations.cards import CardNumber, number_found, number_missing

#: symbols: measured, of a wide sheet, of the panel, and what is measured over the panel's
K_I, WIDE, PANEL, RATIO = "K_I", "K_I, wide sheet", "K_I, panel", "K_I / panel's"
_UNITS = "MPa m^0.5"
_LONGEST = 0.9  # share of the width up to which the correction holds


class Panel(NamedTuple):
    """Width and thickness of a panel in mm, and the relative standard uncertainty of its stress, load over section."""

    width_mm: float
    thickness_mm: float
    stress_u: float

    def wide(self, load_n: float, half_mm: float) -> float:
        """Return K_I in MPa m^0.5 of half a crack's length as in a wide sheet under the panel's stress."""
        return load_n / (self.width_mm * self.thickness_mm) * float(np.sqrt(1e-3 * np.pi * half_mm))

    def k(self, load_n: float, half_mm: float) -> float:
        """Return K_I in MPa m^0.5 of half a crack's length in the panel."""
        return self.wide(load_n, half_mm) * width_factor(half_mm, self.width_mm)


def width_factor(half_mm: float, width_mm: float) -> float:
    """Return by how much a panel's width raises K_I over that of a wide sheet; half the crack's length is ``half_mm``.

    Notes
    -----
    Feddersen's secant (1966) with the polynomial of Tada (1973), within 0.1 %.

    Raises
    ------
    InputError
        ``panel_invalid`` if the crack is nearly as long as the panel is wide.
    """
    share = 2.0 * half_mm / width_mm
    if share > _LONGEST:
        raise InputError(
            f"A crack of {2.0 * half_mm:.4g} mm is {share:.0%} of a panel's width of {width_mm:.4g} mm.",
            code="panel_invalid",
            remedy="State the panel's whole width; the formula holds up to nine tenths of it.",
        )
    return float((1.0 - 0.025 * share**2 + 0.06 * share**4) / np.sqrt(np.cos(0.5 * np.pi * share)))


def beside(
    measured: CardNumber, panel: Panel, load_n: float | None, half_mm: float, half_u_mm: Mapping[str, float]
) -> dict[str, CardNumber]:
    """Return the formula's numbers by their symbols.

    Parameters
    ----------
    measured
        K_I as it was measured.
    panel, load_n
        The panel, and its load; None if that is not known.
    half_mm, half_u_mm
        Half the crack's length, and its standard uncertainties by cause.

    Raises
    ------
    InputError
        As :func:`width_factor`.
    """
    if load_n is None or load_n <= 0.0:
        return {PANEL: number_missing("k_panel", _UNITS, "load_missing: the step has no load that pulls.")}
    wide, k = panel.wide(load_n, half_mm), panel.k(load_n, half_mm)
    parts = {cause: panel.k(load_n, half_mm + u) - k for cause, u in half_u_mm.items()} | {"stress": k * panel.stress_u}
    of_wide = {cause: panel.wide(load_n, half_mm + u) - wide for cause, u in half_u_mm.items()}
    found = {
        WIDE: number_found("k_wide", wide, _UNITS, of_wide | {"stress": wide * panel.stress_u}, ()),
        PANEL: number_found("k_panel", k, _UNITS, parts, ()),
    }
    if measured.value is not None:
        ratio, doubts = measured.value / k, [measured.why] if measured.why else []
        shares = {"measured": (measured.u or 0.0) / k, "formula": abs(ratio) * (found[PANEL].u or 0.0) / k}
        found[RATIO] = number_found("k_ratio", ratio, "1", shares, doubts)
    return found


def by_load(steps: Mapping[float, Mapping[str, CardNumber]]) -> dict[str, CardNumber]:
    """Return K_I by load beside the formula's, one number a line, of steps' numbers by their load in N."""
    return {
        f"{load:g} N: {symbol}": numbers[symbol]
        for load, numbers in sorted(steps.items())
        for symbol in (K_I, WIDE, PANEL, RATIO)
        if PANEL in numbers and symbol in numbers
    }
