"""What the page on coverage shows of a stratum, kept in a file of the repository.

Replicates are large and stay where they were drawn; their figures are kept, so that a page can be written anew from
some strata alone: those drawn take the place of the kept ones, all others stand as they were.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.coverage.pooled import WHITE, Cell, Entries, mean, pooled, sharpness
from tests.bench.coverage.score import MEAN, OFF, SHAPE
from tests.bench.coverage.strata import Stratum

FIGURES = Path(__file__).with_name("figures.json")
TILTED = ((SHAPE, "X"), (SHAPE, "length"), ("w of 2 mm", "mean w"))
"""Cells that an axis' tilt shows in."""
OFF_SHOWN = ("X", "length", "mean w")
"""Quantities that show what leaving out the calibration's part does."""


@dataclass(frozen=True)
class Share:
    """Cells taken together.

    Attributes
    ----------
    coverage
        Mean share within the 95 % intervals.
    nees
        Mean of squared error over reported variance; None where it was not kept.
    spread
        Standard error of the share between replicates; None where it was not kept.
    """

    coverage: float
    nees: float | None = None
    spread: float | None = None

    @staticmethod
    def of(cells: Sequence[Cell], spread: float = float("nan")) -> Share:
        """Return that of cells."""
        known = spread if np.isfinite(spread) else None
        return Share(mean(cells, lambda c: c.coverage), mean(cells, lambda c: c.nees), known)


@dataclass(frozen=True)
class Figures:
    """The figures of one stratum.

    Attributes
    ----------
    drawn
        Day of the drawing, ISO 8601.
    replicates, refused
        Numbers of those scored, and of those that a command refused.
    cells
        Number of cells.
    whole
        All cells; None without any.
    motions, quantities
        By name, as far as they were kept.
    sharpness
        Reported over true root mean square, the geometric mean over cells; None where it was not kept.
    structure
        Calibrations that named a structure of their residuals.
    off
        By quantity of :data:`OFF_SHOWN`, without the calibration's part.
    white
        Mean of all steps, the reference's noise declared white in time.
    tilted
        Cells of :data:`TILTED`.
    """

    drawn: str
    replicates: int
    refused: int = 0
    cells: int = 0
    whole: Share | None = None
    motions: Mapping[str, Share] = field(default_factory=dict)
    quantities: Mapping[str, Share] = field(default_factory=dict)
    sharpness: float | None = None
    structure: int = 0
    off: Mapping[str, Share] = field(default_factory=dict)
    white: Share | None = None
    tilted: Mapping[str, Share] = field(default_factory=dict)


@dataclass(frozen=True)
class Kept:
    """All that the page is made from.

    Attributes
    ----------
    strata
        By name.
    alarms
        By day: replicates in which a step said that a camera moved, and replicates of that day.
    """

    strata: dict[str, Figures] = field(default_factory=dict)
    alarms: dict[str, tuple[int, int]] = field(default_factory=dict)


def figures_of(stratum: Stratum, entries: Entries, drawn: str) -> Figures:
    """Return the figures of a stratum's replicates."""
    pool = pooled(stratum, entries)
    if not pool.cells:
        return Figures(drawn, pool.replicates, pool.refused)
    off, white = (pooled(stratum, entries, control=name) for name in (OFF, WHITE))
    return Figures(
        drawn,
        pool.replicates,
        pool.refused,
        len(pool.cells),
        Share.of(pool.cells, pool.coverage()[1]),
        {m: Share.of(pool.of(m), pool.coverage(m)[1]) for m in pool.motions()},
        {q: Share.of(pool.of(quantity=q)) for q in dict.fromkeys(c.quantity for c in pool.cells)},
        sharpness(pool.cells),
        sum(any("structure" in reason for reason in entry.get("reasons", ())) for entry in entries),
        {q: Share.of(off.of(quantity=q)) for q in OFF_SHOWN if off.of(quantity=q)},
        Share.of(white.of(MEAN)) if white.of(MEAN) else None,
        {f"{m}|{q}": Share.of(pool.of(m, q)) for m, q in TILTED if stratum.must == "fail" and pool.of(m, q)},
    )


def alarms_of(entries: Entries) -> tuple[int, int]:
    """Return how many replicates have a step that said that a camera moved, and of how many."""
    told = [entry["warnings"] for entry in entries if "warnings" in entry]
    return sum(any("a camera moved" in line for line in lines) for lines in told), len(told)


def read_figures(path: Path = FIGURES) -> Kept:
    """Return what is kept; nothing where there is no file."""
    if not path.exists():
        return Kept()
    content = json.loads(path.read_text(encoding="utf-8"))
    return Kept(
        {name: _figures(values) for name, values in content["strata"].items()},
        {day: (int(moved), int(of)) for day, (moved, of) in content["alarms"].items()},
    )


def write_figures(kept: Kept, path: Path = FIGURES) -> None:
    """Keep figures, to five digits."""
    content = {"strata": {name: _plain(asdict(f)) for name, f in kept.strata.items()}, "alarms": kept.alarms}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items() if v not in (None, {})}
    return float(f"{value:.5g}") if isinstance(value, float) else value


def _figures(values: dict[str, Any]) -> Figures:
    shares = {
        name: {key: Share(**share) for key, share in values.get(name, {}).items()}
        for name in ("motions", "quantities", "off", "tilted")
    }
    one = {name: Share(**values[name]) if name in values else None for name in ("whole", "white")}
    return Figures(**{**values, **shares, **one})
