"""What each standard asks for: the window of the modulus, and the numbers by their symbols."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Profile:
    """A standard.

    Attributes
    ----------
    title
        Its name.
    by
        The modulus' window is between two strains, or two shares of the proof stress.
    lower, upper
        The window.
    numbers
        Numbers of the card with their symbols, in order.
    """

    title: str
    by: Literal["strain", "share"]
    lower: float
    upper: float
    numbers: Mapping[str, str]


_METALS = {
    "modulus": "E",
    "poisson": "nu",
    "proof": "Rp0.2",
    "upper_yield": "ReH",
    "lower_yield": "ReL",
    "strength": "Rm",
    "uniform": "Ag",
    "elongation": "A",
    "r": "r",
    "n": "n",
    "k": "K",
}
_PLASTICS = {
    "modulus": "Et",
    "poisson": "mu",
    "upper_yield": "sigma_y",
    "strength": "sigma_m",
    "strain_at_strength": "eps_m",
    "strain_at_break": "eps_b",
}
_FLEXURE = {
    "modulus": "E_B",
    "upper_yield": "sigma_fy",
    "strength": "sigma_fM",
    "strain_at_strength": "eps_fM",
    "strain_at_break": "eps_fB",
}
# ISO 6892-1 regresses the modulus between a lower and an upper share of the proof stress; ISO 527 states its strains
PROFILES: dict[str, Profile] = {
    "iso_6892_1": Profile("ISO 6892-1", "share", 0.10, 0.40, _METALS),
    "astm_e8": Profile(
        "ASTM E8",
        "share",
        0.10,
        0.40,
        {**_METALS, "proof": "YS0.2", "upper_yield": "UYS", "lower_yield": "LYS", "strength": "TS", "uniform": "UE"},
    ),
    "iso_527_2": Profile("ISO 527-2", "strain", 0.0005, 0.0025, _PLASTICS),
    "astm_d638": Profile("ASTM D638", "strain", 0.0005, 0.0025, {**_PLASTICS, "modulus": "E", "proof": "YS0.2"}),
    # the chord modulus; stress and strain are those of the outer face at midspan
    "astm_d790": Profile("ASTM D790", "strain", 0.0005, 0.0025, _FLEXURE),
}
UNITS = {
    **dict.fromkeys(("modulus", "proof", "upper_yield", "lower_yield", "strength", "k"), "MPa"),
    **dict.fromkeys(("poisson", "uniform", "elongation", "strain_at_strength", "strain_at_break", "r", "n"), "1"),
}
