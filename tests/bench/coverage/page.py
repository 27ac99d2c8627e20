"""The table on coverage: measured figures and their limits by stratum, motion and quantity, with a plot."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import matplotlib as mpl
import numpy as np

from tests.bench.accuracy.pages import FIGURES, write_part
from tests.bench.coverage.coverage import MAIN_REPLICATES, OUT, file_of, kept
from tests.bench.coverage.figures import Figures, Kept, Share, alarms_of, figures_of, read_figures, write_figures
from tests.bench.coverage.score import MEAN
from tests.bench.coverage.strata import CONTROLS, LATER, MAIN, OTHERS, STRATA, Stratum

mpl.use("Agg")
import matplotlib.pyplot as plt

TITLE = "The whole chain through the command line"
FIGURE = "coverage_by_motion.png"
LEAST = 10
"""Replicates of a stratum below which its cells say nothing over all: what points share is one draw a replicate."""
Named = tuple[str, Figures]
Cells = tuple[str, str, str, str, str]
REST = (*OTHERS, *(stratum for stratum in LATER if stratum.must != "fail"))
REFUSED = tuple(stratum for stratum in LATER if stratum.must == "fail")
_HOW = """Each replicate draws a target with errors of its nodes, pitch and stage, two cameras, a texture and its phase, image noise
and the signs of the motions. Its views of the target are rendered and calibrated by `stereorig calibrate`, a tilted plane (a
curved one where the stratum says so) and seven motions of it are rendered and measured by `stereorig measure`, lengths of 10 mm,
means over an area and rigid motions are read by `stereorig gauge`. Truth and pictures come from a renderer that shares nothing
with the program (`tests/bench/coverage`, `tests/support/relief_rig.py`): rays through the lens to the moved surface. 224 x 224 px,
0.067 mm a px, +- 15 degrees, grid of 7 x 7 lines of 1.55 mm at dZ 0, 5 and 10 mm, 9 x 9 points, 21 px, step 14, strain over 5
points, noise of 2 grey levels where nothing else is said. Per point X, Y, Z, u, v, w, strain; differences of a step from the first
by the files' `reference_covariance` and `common_factor`. A cell is one quantity of one motion of one stratum; a cell of a motion is
the mean over its quantities. What is drawn is what the files declare, but for the negative controls. `make coverage` goes on where
a run was stopped."""

_CHOSEN = """What was chosen after first trials: the soft texture has knots 2.7 px apart, since with knots of 1.3 px u, v and w were
covered too little in three trial replicates, and at 1.8 px pictures without noise still had most of the error; the renderer's
three samples a side, the interpolation, or both may be the cause, which was not told apart, so that finer speckle is not proven here.
A tilt of 1 mrad with its prior off did not fail on so small a sensor, nor did spatially correlated noise declared white, which the
residual test sees: the control of the tilt is one of 20 mrad, and that of whiteness is noise of the reference taken for new in
each step."""


def drawn_now() -> Kept:
    """Return the figures of all strata that have replicates in :data:`tests.bench.coverage.coverage.OUT`."""
    found = Kept()
    for stratum in STRATA:
        entries = kept(stratum)
        if not entries:
            continue
        day = datetime.fromtimestamp(file_of(stratum).stat().st_mtime, UTC).date().isoformat()
        found.strata[stratum.name] = figures_of(stratum, entries, day)
        moved, of = alarms_of(entries)
        before = found.alarms.get(day, (0, 0))
        found.alarms[day] = before[0] + moved, before[1] + of
    return found


def write_page() -> Path:
    """Write the section and its figure: strata that were drawn here replace the kept ones, and are kept."""
    drawn, shown = drawn_now(), read_figures()
    if not drawn.strata:
        raise SystemExit(f"no replicates in {OUT}")
    shown.strata.update(drawn.strata)
    shown.alarms.update(drawn.alarms)
    write_figures(shown)
    return write_from(shown)


def write_from(shown: Kept) -> Path:
    """Write the section and its figure from figures."""
    _plot(_of(shown, (*MAIN, *REST)), FIGURES / FIGURE)
    return write_part("coverage", TITLE, notes(shown), rows(shown))


def _of(shown: Kept, strata: Sequence[Stratum]) -> list[Named]:
    return [(s.name, shown.strata[s.name]) for s in strata if s.name in shown.strata]


def notes(shown: Kept) -> list[str]:
    """Return the conditions of the figures, and the days on which the strata were drawn."""
    main, others = _of(shown, MAIN), _of(shown, REST)
    lines = [*(" ".join(paragraph.split()) for paragraph in (_HOW, _CHOSEN)), f"plot: docs/figures/{FIGURE}"]
    least = min((f.replicates for _, f in main), default=0)
    if least < MAIN_REPLICATES:
        lines.append(f"A main stratum has at least {least} of {MAIN_REPLICATES} replicates here.")
    days: dict[str, list[str]] = {}
    for name, f in (*main, *others, *_of(shown, (*CONTROLS, *REFUSED))):
        days.setdefault(f.drawn, []).append(name)
    lines += [f"Drawn on {day}, with the program of that day: {'; '.join(days[day])}." for day in sorted(days)]
    lines += [
        f"No camera moves in these replicates; of those drawn on {day}, {moved} of {of} have a step that reports a motion."
        for day, (moved, of) in sorted(shown.alarms.items())
    ]
    return lines


def rows(shown: Kept) -> list[Cells]:
    """Return the rows: asked figures, main strata by motion and by quantity, other strata, negative controls."""
    main, others = _of(shown, MAIN), _of(shown, REST)
    cover = {s.name for s in STRATA if s.must == "cover"}
    covering = [(n, f) for n, f in (*main, *others) if n in cover and f.replicates >= LEAST]
    found = _asked(main, covering) if covering else []
    for name, f in main:
        found.append((f"{name}: replicates", str(f.replicates), "", "", ""))
        for part, share in (*f.motions.items(), *((f"all motions, {q}", s) for q, s in f.quantities.items())):
            found += _share(f"{name}: {part}", share)
    for name, f in others:
        found += _other(name, f)
    return found + _controls(shown)


def _row(what: str, value: float, limits: tuple[float, float] | None = None, unit: str = "", digits: int = 1) -> Cells:
    limit, met = "", ""
    if limits is not None:
        limit, met = f"{limits[0]:g} to {limits[1]:g}", "yes" if limits[0] <= value <= limits[1] else "no"
    return what, f"{value:.{digits}f}", limit, unit, met


def _asked(main: Sequence[Named], covering: Sequence[Named]) -> list[Cells]:
    shares = [(f.whole, f.cells) for _, f in covering if f.whole is not None]
    cells = sum(count for _, count in shares)
    total = 100.0 * sum(share.coverage * count for share, count in shares) / cells
    every = sum((share.nees or np.nan) * count for share, count in shares) / cells
    motions = [(share, name, m) for name, f in main for m, share in f.motions.items()]
    low, high = (of(motions, key=lambda v: v[0].coverage) for of in (min, max))
    squared = [(share.nees, name, m) for share, name, m in motions if share.nees is not None]
    narrow, wide = min(squared), max(squared)
    sharp = [(f.sharpness, f.cells) for _, f in covering if f.sharpness is not None]
    found = [
        _row("coverage of 95 % intervals, mean of all cells", total, (94, 96), "%"),
        _row("cells in that mean", cells, digits=0),
        _row("strata in that mean", len(covering), digits=0),
    ]
    found += [
        _row(f"coverage, {which} motion of a main stratum ({name}: {motion})", 100.0 * share.coverage, (92, 98), "%")
        for which, (share, name, motion) in (("lowest", low), ("highest", high))
    ]
    found.append(_row("squared error over variance, mean of all cells", every, (0.95, 1.05), digits=3))
    found += [
        _row(
            f"squared error over variance, {which} motion of a main stratum ({name}: {m})", nees, (0.85, 1.2), digits=2
        )
        for which, (nees, name, m) in (("lowest", narrow), ("highest", wide))
    ]
    if sharp:
        mean = float(np.exp(np.average(np.log([s for s, _ in sharp]), weights=[count for _, count in sharp])))
        what = f"reported over true rms, geometric mean of the cells of {len(sharp)} strata"
        found.append(_row(what, mean, (0.95, 1.1), digits=3))
    return found


def _share(what: str, share: Share, limits: tuple[float, float] | None = None) -> list[Cells]:
    """Return coverage in per cent, its standard error between replicates, and squared error over variance."""
    found = [_row(f"{what}, within 95 %", 100.0 * share.coverage, limits, "%")]
    if share.spread is not None:
        found.append(_row(f"{what}, standard error", 100.0 * share.spread, None, "%"))
    if share.nees is not None:
        found.append(_row(f"{what}, squared error over variance", share.nees, digits=2))
    return found


def _other(name: str, f: Figures) -> list[Cells]:
    found: list[Cells] = [(f"{name}: replicates", str(f.replicates), "", "", "")]
    if f.refused:
        found.append((f"{name}: refused", str(f.refused), "", "", ""))
    if f.whole is None or f.sharpness is None:
        return found
    found += _share(f"{name}: all motions", f.whole, (92, 98) if f.replicates >= LEAST else None)
    found.append(_row(f"{name}: reported over true rms", f.sharpness, digits=2))
    motion, share = min(f.motions.items(), key=lambda item: item[1].coverage)
    found.append(_row(f"{name}: lowest motion ({motion}), within 95 %", 100.0 * share.coverage, None, "%"))
    if f.structure:
        found.append((f"{name}: calibrations that name a structure", str(f.structure), "", "", ""))
    return found


def _controls(shown: Kept) -> list[Cells]:
    found: list[Cells] = []
    for name, f in _of(shown, MAIN[1:3]):
        for q, share in f.off.items():
            found += _share(f"must fail, {name}, calibration's part off: {q}", share)
    for name, f in _of(shown, MAIN[:1]):
        if f.white is not None:
            found += _share(f"must fail, {name}, frozen noise of the reference declared white in time: {MEAN}", f.white)
    for name, f in _of(shown, CONTROLS):
        for k, share in f.tilted.items():
            found += _share(f"must fail, {name}: {', '.join(reversed(k.split('|')))}", share)
    for name, f in _of(shown, REFUSED):
        found.append((f"must fail, {name}: refused of {f.replicates + f.refused}", str(f.refused), "", "", ""))
    return found


def _plot(shown: Sequence[Named], path: Path) -> None:
    shown = [(name, f) for name, f in shown if f.whole is not None]
    fig, ax = plt.subplots(figsize=(8.5, 0.32 * len(shown) + 1.2), layout="constrained")
    ax.axvspan(92.0, 98.0, color="0.9", zorder=0, label="asked of a motion")
    ax.axvline(95.0, color="0.5", lw=0.8)
    for row, (_, f) in enumerate(reversed(shown)):
        assert f.whole is not None
        first = row == 0
        motions = [100.0 * share.coverage for share in f.motions.values()]
        ax.plot(motions, np.full(len(motions), row), "o", color="tab:red", ms=3.5, label="motion" if first else None)
        whole, spread = 100.0 * f.whole.coverage, 100.0 * (f.whole.spread or 0.0)
        ax.errorbar(whole, row, xerr=spread, fmt="|", color="tab:blue", ms=9, label="all cells" if first else None)
    ax.set_yticks(range(len(shown)), [f"{name} ({f.replicates})" for name, f in reversed(shown)], fontsize=7)
    ax.set_xlim(80.0, 101.0)
    ax.set_xlabel("values within their 95 % interval, %")
    ax.legend(fontsize=7, loc="lower left")
    fig.savefig(path, dpi=110)
    plt.close(fig)
