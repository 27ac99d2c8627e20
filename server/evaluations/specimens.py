"""Several specimens of one material: mean, spread, and the bound that most of the material exceeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from pydantic import BaseModel, Field
from scipy.stats import nct, norm

from stereorig.server.base.models import Reply
from stereorig.server.evaluations.cards import CardNumber
from stereorig.server.formats.csv_cells import row

_SHARE, _CONFIDENCE = 0.90, 0.95
#: causes that are new at each specimen
_NEW = ("strain", "load", "reference", "section", "sampling")


class Card(Protocol):
    """A card of a specimen."""

    @property
    def verdict(self) -> str:
        """Its verdict."""
        ...

    @property
    def numbers(self) -> Mapping[str, CardNumber]:
        """Its numbers by their symbols."""
        ...


class OverSpecimens(BaseModel):
    """A number over the specimens of which it is good."""

    units: str = Field(description="Unit; 1 of a ratio.")
    count: int = Field(description="Specimens of which it is good.")
    left_out: int = Field(description="Specimens of which it is doubtful or missing.")
    mean: float | None = Field(None, description="Mean.")
    s: float | None = Field(None, description="Standard deviation over the specimens, with count - 1.")
    u: float | None = Field(
        None, description="Standard uncertainty of the mean: s over the root of count, and load and clock in full."
    )
    k: float | None = Field(
        None, description="Factor of the one-sided bound: mean - k s is exceeded by 90 % of the material, 95 % sure."
    )
    bound: float | None = Field(None, description="That bound.")


class MaterialFound(Reply):
    """The numbers of a material, over its specimens."""

    specimens: list[str] = Field(description="Specimens with a card.")
    verdicts: dict[str, str] = Field(description="Verdict of each card.")
    numbers: dict[str, OverSpecimens] = Field(description="The numbers by their symbols.")


def over_specimens(cards: Mapping[str, Card]) -> MaterialFound:
    """Return the numbers over specimens by their cards."""
    symbols = dict.fromkeys(symbol for card in cards.values() for symbol in card.numbers)
    return MaterialFound(
        specimens=list(cards),
        verdicts={name: card.verdict for name, card in cards.items()},
        numbers={symbol: _over(symbol, list(cards.values())) for symbol in symbols},
    )


def _over(symbol: str, cards: list[Card]) -> OverSpecimens:
    each = [card.numbers[symbol] for card in cards if symbol in card.numbers]
    good = [one for one in each if one.state == "good" and one.value is not None]
    values = np.array([one.value for one in good], dtype=np.float64)
    found = OverSpecimens(units=each[0].units, count=len(good), left_out=len(cards) - len(good))
    if len(good):
        found.mean = float(values.mean())
    if len(good) > 1:
        found.s = float(values.std(ddof=1))
        # one load cell, one clock and one calibration of the cameras for all: their parts do not scatter
        alike = [sum(part**2 for cause, part in one.parts.items() if cause not in _NEW) for one in good]
        found.u = float(np.sqrt(found.s**2 / len(good) + np.mean(alike)))
        found.k = factor(len(good))
        found.bound = float(values.mean() - found.k * found.s)
    return found


def factor(count: int) -> float:
    """Return the factor of the one-sided tolerance bound of a normal distribution, by the noncentral t."""
    return float(nct.ppf(_CONFIDENCE, count - 1, norm.ppf(_SHARE) * np.sqrt(count)) / np.sqrt(count))


def table_over(found: MaterialFound) -> str:
    """Return the numbers over the specimens as CSV."""
    head = ("symbol", "units", "count", "left_out", "mean", "s", "u", "k", "bound")
    each = [
        (symbol, one.units, one.count, one.left_out, one.mean, one.s, one.u, one.k, one.bound)
        for symbol, one in found.numbers.items()
    ]
    return "".join(map(row, [head, *each]))
