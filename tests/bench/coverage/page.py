"""The page on coverage: the asked limits beside what was measured, by stratum, motion and quantity, with a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import matplotlib as mpl
import numpy as np

from tests.bench.accuracy.pages import FIGURES, write_part
from tests.bench.coverage.coverage import MAIN_REPLICATES, OUT, file_of, kept
from tests.bench.coverage.figures import Figures, Kept, Share, alarms_of, figures_of, read_figures, write_figures
from tests.bench.coverage.score import MEAN
from tests.bench.coverage.strata import CONTROLS, MAIN, OTHERS, STRATA, Stratum
from tests.bench.documents.prose import wrapped

mpl.use("Agg")
import matplotlib.pyplot as plt

TITLE = "The whole chain through the command line"
FIGURE = "coverage_by_motion.png"
LEAST = 10
"""Replicates of a stratum below which its cells say nothing over all: what points share is one draw a replicate."""
Named = tuple[str, Figures]
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
    """Write the section and its figure: strata that were drawn here stand in place of the kept ones, which are kept."""
    drawn, shown = drawn_now(), read_figures()
    if not drawn.strata:
        raise SystemExit(f"no replicates in {OUT}")
    shown.strata.update(drawn.strata)
    shown.alarms.update(drawn.alarms)
    write_figures(shown)
    return write_from(shown)


def write_from(shown: Kept) -> Path:
    """Write the section and its figure from figures."""
    _plot(_of(shown, (*MAIN, *OTHERS)), FIGURES / FIGURE)
    return write_part("coverage", TITLE, wrapped(text(shown)))


def _of(shown: Kept, strata: Sequence[Stratum]) -> list[Named]:
    return [(s.name, shown.strata[s.name]) for s in strata if s.name in shown.strata]


def text(shown: Kept) -> str:
    """The section's text."""
    main, others = _of(shown, MAIN), _of(shown, OTHERS)
    cover = {s.name for s in STRATA if s.must == "cover"}
    covering = [(n, f) for n, f in (*main, *others) if n in cover and f.replicates >= LEAST]
    least = min(f.replicates for _, f in main) if main else 0
    lines = [f"## {TITLE}", "", " ".join(_HOW.split()), ""]
    for paragraph in _CHOSEN.split("\n\n"):
        lines += [" ".join(paragraph.split()), ""]
    if least < MAIN_REPLICATES:
        lines += [f"A main stratum has at least {least} of {MAIN_REPLICATES} replicates here.", ""]
    lines += _days([*main, *others, *_of(shown, CONTROLS)])
    lines += _asked(main, covering) if covering else []
    lines += ["", f"![Coverage by motion](../../figures/{FIGURE})", "", *_by_motion(main), "", *_by_quantity(main)]
    lines += ["", *_others(others), "", *_controls(shown), "", *_not_covered(others), *_alarms(shown.alarms)]
    return "\n".join(lines).rstrip() + "\n"


def _days(every: Sequence[Named]) -> list[str]:
    """Which stratum was drawn when: what was drawn earlier is of an earlier state of the program."""
    days: dict[str, list[str]] = {}
    for name, f in every:
        days.setdefault(f.drawn, []).append(name)
    if len(days) < 2:
        return []
    newest, *older = sorted(days, reverse=True)
    parts = [f"drawn on {newest}: {'; '.join(days[newest])}"]
    parts += [f"drawn on {day}, with the program of that day: {'; '.join(days[day])}" for day in older]
    return [f"Strata {'. Strata '.join(parts)}. Figures of earlier days are kept to the digits shown.", ""]


def _between(low: float, value: float, high: float) -> str:
    return "yes" if low <= value <= high else "**no**"


def _asked(main: Sequence[Named], covering: Sequence[Named]) -> list[str]:
    shares = [(f.whole, f.cells) for _, f in covering if f.whole is not None]
    cells = sum(count for _, count in shares)
    total = 100.0 * sum(share.coverage * count for share, count in shares) / cells
    every = sum((share.nees or np.nan) * count for share, count in shares) / cells
    motions = [(share, name, m) for name, f in main for m, share in f.motions.items()]
    low, high = (of(motions, key=lambda v: v[0].coverage) for of in (min, max))
    squared = [(share.nees, name, m) for share, name, m in motions if share.nees is not None]
    narrow, wide = min(squared), max(squared)
    sharp = [(f.sharpness, f.cells) for _, f in covering if f.sharpness is not None]
    lines = [
        "| what | measured | asked | met |",
        "| --- | --- | --- | --- |",
        f"| coverage of 95 % intervals, mean of all {cells} cells of {len(covering)} strata | {total:.1f} % | "
        f"94 to 96 % | {_between(94.0, total, 96.0)} |",
    ]
    for what, (share, name, motion) in (("lowest motion of a main stratum", low), ("highest", high)):
        value, spread = 100.0 * share.coverage, "" if share.spread is None else f"; +- {100 * share.spread:.1f}"
        lines.append(
            f"| {what} ({name}: {motion}{spread}) | {value:.1f} % | 92 to 98 % | {_between(92.0, value, 98.0)} |"
        )
    lines += [
        f"| squared error over variance, mean of all cells | {every:.3f} | 0.95 to 1.05 | {_between(0.95, every, 1.05)} |",
        f"| the same, lowest motion of a main stratum ({narrow[1]}: {narrow[2]}) | {narrow[0]:.2f} | 0.85 to 1.2 | "
        f"{_between(0.85, narrow[0], 1.2)} |",
        f"| the same, highest ({wide[1]}: {wide[2]}) | {wide[0]:.2f} | 0.85 to 1.2 | {_between(0.85, wide[0], 1.2)} |",
    ]
    if sharp:
        mean = float(np.exp(np.average(np.log([s for s, _ in sharp]), weights=[count for _, count in sharp])))
        lines.append(
            f"| reported over true rms, geometric mean of the cells of {len(sharp)} strata | {mean:.3f} | "
            f"0.95 to 1.10 | {_between(0.95, mean, 1.10)} |"
        )
    return lines


def _shown(share: Share | None) -> str:
    if share is None:
        return ""
    spread = "" if share.spread is None else f" +- {100 * share.spread:.1f}"
    squared = "" if share.nees is None else f" ({share.nees:.2f})"
    return f"{100 * share.coverage:.1f}{spread}{squared}"


def _by_motion(main: Sequence[Named]) -> list[str]:
    names = [f"{name} ({f.replicates})" for name, f in main]
    lines = [
        "Coverage in per cent by motion, its standard error between replicates, and squared error over variance:",
        "",
    ]
    lines += [f"| motion | {' | '.join(names)} |", "| --- |" + " --- |" * len(main)]
    for motion in dict.fromkeys(m for _, f in main for m in f.motions):
        lines.append(f"| {motion} | {' | '.join(_shown(f.motions.get(motion)) for _, f in main)} |")
    return lines


def _by_quantity(main: Sequence[Named]) -> list[str]:
    lines = ["The same by quantity, over all motions:", ""]
    lines += [f"| quantity | {' | '.join(name for name, _ in main)} |", "| --- |" + " --- |" * len(main)]
    for quantity in dict.fromkeys(q for _, f in main for q in f.quantities):
        lines.append(f"| {quantity} | {' | '.join(_shown(f.quantities.get(quantity)) for _, f in main)} |")
    return lines


def _others(others: Sequence[Named]) -> list[str]:
    lines = [
        f"Other strata, replicates in brackets; fewer than {LEAST} say nothing of coverage:",
        "",
        "| stratum | coverage, % (squared error over variance) | reported over true rms | lowest motion | calibration |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, f in others:
        if f.whole is None or f.sharpness is None:
            lines.append(f"| {name} ({f.replicates}) | | | | refused {f.refused} |")
            continue
        motion, share = min(f.motions.items(), key=lambda item: item[1].coverage)
        lines.append(
            f"| {name} ({f.replicates}) | {_shown(f.whole)} | {f.sharpness:.2f} | "
            f"{motion}: {100 * share.coverage:.1f} % | {_verdict(f)} |"
        )
    return lines


def _verdict(f: Figures) -> str:
    parts = [f"refused {f.refused}"] if f.refused else []
    return ", ".join(parts + ([f"structure named in {f.structure}"] if f.structure else []))


def _controls(shown: Kept) -> list[str]:
    lines = [
        "Negative controls, which must fail:",
        "",
        "| control | coverage, % (squared error over variance) |",
        "| --- | --- |",
    ]
    for name, f in _of(shown, MAIN[1:3]):
        lines += [f"| {name}, calibration's part off: {q} | {_shown(share)} |" for q, share in f.off.items()]
    for name, f in _of(shown, MAIN[:1]):
        lines.append(f"| {name}, frozen noise of the reference declared white in time: {MEAN} | {_shown(f.white)} |")
    for name, f in _of(shown, CONTROLS):
        lines += [f"| {name}: {', '.join(reversed(k.split('|')))} | {_shown(share)} |" for k, share in f.tilted.items()]
    return lines


def _not_covered(others: Sequence[Named]) -> list[str]:
    named = [
        (name, f.whole)
        for name, f in others
        if f.whole is not None and f.replicates >= LEAST and not 0.92 <= f.whole.coverage <= 0.98
    ]
    if not named:
        return []
    shown = "; ".join(f"{name}: {_shown(share)}" for name, share in named)
    return [f"Not covered, in per cent with squared error over variance: {shown}.", ""]


def _alarms(alarms: Mapping[str, tuple[int, int]]) -> list[str]:
    parts = [f"{moved} of {of} drawn on {day}" for day, (moved, of) in sorted(alarms.items())]
    return [f"No camera moves in these replicates; a step said that one did in {' and in '.join(parts)}.", ""]


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
