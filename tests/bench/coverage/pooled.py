"""Replicates pooled: coverage, squared error over its expectation, and sharpness, by cell and over many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.bench.coverage.score import OFF
from tests.bench.coverage.score import WHITE as MEAN_WHITE
from tests.bench.coverage.strata import Stratum

Entries = Sequence[dict[str, Any]]
WHITE = MEAN_WHITE.split(":")[0]
CONTROLS = (OFF, WHITE)
"""Beginnings of the names of cells whose intervals leave something out."""


@dataclass(frozen=True)
class Cell:
    """One quantity of one motion of one stratum, over all replicates.

    Attributes
    ----------
    motion, quantity
        Their names.
    coverage
        Share of values within their 95 % interval.
    nees
        Mean of squared error over reported variance.
    sharpness
        Reported over true root mean square.
    """

    motion: str
    quantity: str
    coverage: float
    nees: float
    sharpness: float


@dataclass(frozen=True)
class Pool:
    """The cells of one stratum with the number of its replicates."""

    stratum: Stratum
    replicates: int
    refused: int
    cells: tuple[Cell, ...]
    shares: dict[str, tuple[float, ...]]

    def motions(self) -> list[str]:
        """Names of the motions, the shape first."""
        return list(dict.fromkeys(cell.motion for cell in self.cells))

    def of(self, motion: str | None = None, quantity: str | None = None) -> list[Cell]:
        """The cells of a motion or of a quantity, or all."""
        return [c for c in self.cells if motion in (None, c.motion) and quantity in (None, c.quantity)]

    def coverage(self, motion: str | None = None) -> tuple[float, float]:
        """Mean share over the cells of a motion or of all, and its standard error, which replicates' scatter shows."""
        name = "" if motion is None else motion
        each = np.array(self.shares.get(name, ()))
        spread = float(each.std(ddof=1) / np.sqrt(len(each))) if len(each) > 1 else float("nan")
        return mean(self.of(motion), lambda c: c.coverage), spread


def pooled(stratum: Stratum, entries: Entries, *, control: str | None = None) -> Pool:
    """Pool a stratum's replicates; of a ``control`` those intervals that leave something out, and no others."""
    made = [entry for entry in entries if "cells" in entry]
    sums: dict[str, Any] = {}
    shares: dict[str, list[float]] = {}
    for entry in made:
        own: dict[str, list[float]] = {}
        for name, values in entry["cells"].items():
            found = next((c for c in CONTROLS if name.startswith(c)), None)
            if found != control:
                continue
            name = name if found is None else name.removeprefix(f"{found}: ")
            sums[name] = sums.get(name, np.zeros(5)) + np.array(values)
            for group in ("", name.split("|")[0]):
                own.setdefault(group, []).append(values[1] / values[0])
        for group, each in own.items():
            shares.setdefault(group, []).append(float(np.mean(each)))
    cells = []
    for name, (n, within, z2, e2, s2) in sums.items():
        motion, quantity = name.split("|")
        cells.append(Cell(motion, quantity, within / n, z2 / n, float(np.sqrt(s2 / e2))))
    return Pool(stratum, len(made), len(entries) - len(made), tuple(cells), {k: tuple(v) for k, v in shares.items()})


def mean(cells: Sequence[Cell], of: Callable[[Cell], float]) -> float:
    """Mean over cells; NaN without any."""
    return float(np.mean([of(c) for c in cells])) if cells else float("nan")


def sharpness(cells: Sequence[Cell]) -> float:
    """Geometric mean over cells of reported over true root mean square."""
    return float(np.exp(mean(cells, lambda c: float(np.log(c.sharpness))))) if cells else float("nan")
