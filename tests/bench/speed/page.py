"""Writes the figures of ``docs/explanation/performance.md``, its tables and its plots."""

from __future__ import annotations

import os
import platform
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from tests.bench.accuracy.table import Row
from tests.bench.documents.prose import marked, wrapped, write_tables
from tests.bench.speed import layout
from tests.bench.speed.assembly import HERE, LoopCount
from tests.bench.speed.ceilings import Ceilings
from tests.bench.speed.kernel import Costs, Rate
from tests.bench.speed.layout import of_threads, save, table, thousands
from tests.bench.speed.parts import Parts
from tests.bench.speed.peers import page as peers_page
from tests.bench.speed.peers.runs import Beside, Outcome


@dataclass
class Report:
    """Everything measured; what was left out is empty.

    Attributes
    ----------
    quick
        Whether this is the short form.
    ceilings, rates, costs, parts, loops
        See the modules of these names.
    iterations
        Iterations of each point by the fit's name.
    ours
        Outcomes by scene.
    peers
        Those of each peer that is installed.
    more
        Sections that other scripts measured: title, text.
    rows
        Targets of those.
    """

    quick: bool
    ceilings: list[Ceilings] = field(default_factory=list)
    rates: list[Rate] = field(default_factory=list)
    iterations: dict[str, NDArray[np.int32]] = field(default_factory=dict)
    costs: list[Costs] = field(default_factory=list)
    parts: list[Parts] = field(default_factory=list)
    loops: list[LoopCount] = field(default_factory=list)
    ours: dict[str, list[Outcome]] = field(default_factory=dict)
    peers: list[Beside] = field(default_factory=list)
    more: list[tuple[str, str]] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)


def machine() -> list[str]:
    """The machine that it ran on, one item an entry."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        named = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = named[0] if named else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "llvmlite"))
    return [
        f"{model} (LLVM calls it {llvm.get_host_cpu_name()}), {cores} cores for this process",
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}, {packages}, "
        f"LLVM {'.'.join(map(str, llvm.llvm_version_info))}",
        datetime.now(UTC).strftime("%Y-%m-%d"),
    ]


# targets


def pick_rate(report: Report, fit: str, interpolation: str, subset: int, threads: int) -> float:
    """Points a second of one kind of fit, NaN if it was not measured."""
    found = [
        r.per_second
        for r in report.rates
        if (r.fit, r.interpolation, r.subset_px, r.threads) == (fit, interpolation, subset, threads)
    ]
    return found[0] if found else float("nan")


def targets(report: Report) -> list[Row]:
    """What the project asks of itself."""
    rows: list[Row] = []
    if report.rates:
        max_threads = max(r.threads for r in report.rates)
        for fit, subset, min_rate in (("motion", 33, 1.2e5), ("motion", 21, 2e5), ("shape", 33, 2e5)):
            rate = pick_rate(report, fit, "cubic", subset, max_threads)
            rows.append(
                Row(f"{fit}, cubic, {subset} px, {of_threads(max_threads)}", rate, "points/s", min_rate, at_least=True)
            )
        slower = pick_rate(report, "motion", "cubic", 33, 1) / pick_rate(report, "motion", "quintic", 33, 1)
        rows.append(Row("quintic over cubic, motion, 33 px, time", slower, "", 1.8))
    for cost in report.costs:
        limit = cost.interpolation == "cubic"
        spent = float(np.mean(report.iterations.get(f"motion, {cost.interpolation}, 33 px", np.array([2.0]))))
        rows.append(
            Row(
                f"pixel loop, {cost.interpolation}",
                cost.loop_ns,
                "ns a pixel, image, iteration",
                3.0 if limit else None,
            )
        )
        rows.append(
            Row(
                f"time of a motion without pixels, {cost.interpolation}",
                cost.overhead_us(spent),
                "us a point",
                3.0 if limit else None,
            )
        )
    return [*rows, *peers_page.rows(report.ours, report.peers), *report.rows]


def target_line(row: Row) -> list[str]:
    """One line of the page's first table."""

    def figure(value: float) -> str:
        return f"{value:.3g}" if abs(value) < 1e3 else thousands(value)  # which also handles NaN

    limit = "" if row.limit is None else f"{'at least' if row.at_least else 'at most'} {figure(row.limit)}"
    met = "" if row.limit is None else ("yes" if row.met else "**no**")
    return [row.what, figure(row.measured), row.unit, limit, met]


# the kernel


def kernel_text(report: Report) -> list[str]:
    """The section about the point-level matcher."""
    rows = [
        [
            r.fit,
            r.interpolation,
            str(r.subset_px),
            str(r.threads),
            thousands(r.per_second),
            f"{1e6 * r.threads / r.per_second:.1f}",
            f"{r.iterations:.2f}",
        ]
        for r in report.rates
    ]
    text = [
        KERNEL_HOW,
        table(["fit", "spline", "subset, px", "threads", "points/s", "us a point and thread", "iterations"], rows),
    ]
    if report.iterations:
        text.append(_iterations_plot(report))
    if report.costs:
        text += _costs_text(report)
    return text


def _iterations_plot(report: Report) -> str:
    figure, ax = plt.subplots(figsize=(6.5, 3.0), layout="constrained")
    names = [name for name in report.iterations if name.startswith("motion") and "33 px" in name]
    top = max(int(report.iterations[name].max()) for name in names)
    for k, name in enumerate(names):
        spent = report.iterations[name]
        share = np.bincount(spent, minlength=top + 1)[1:] / spent.size
        middles = np.arange(1, top + 1) + 0.2 * (k - (len(names) - 1) / 2)
        ax.bar(middles, 100 * share, 0.2, label=f"{name.removeprefix('motion, ')}: mean {spent.mean():.2f}")
    ax.set(xlabel="iterations", ylabel="points / %", xticks=range(1, top + 1))
    ax.set_title("Motion, starts some 0.05 px away; far starts some 0.7 px", fontsize=10)
    ax.legend(fontsize=8)
    return save(figure, "bench_iterations.png", "Iterations spent")


def _costs_text(report: Report) -> list[str]:
    head = [
        "spline",
        "a: once a point, us",
        "b: an iteration, us",
        "c: once a pixel, ns",
        "d: pixel loop, ns a pixel, image and iteration",
        "misfit",
    ]
    rows = [
        [
            c.interpolation,
            f"{c.point_us:.2f}",
            f"{c.iteration_us:.2f}",
            f"{c.reference_ns:.2f}",
            f"{c.loop_ns:.2f}",
            f"{100 * c.misfit:.0f} %",
        ]
        for c in report.costs
    ]
    figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for k, c in enumerate(report.costs):
        far = c.iterations > np.median(c.iterations)
        for chosen, filled, label in ((~far, True, "near"), (far, False, "far")):
            ax.plot(
                c.pixels[chosen],
                c.measured_us[chosen],
                "o",
                color=f"C{k}",
                fillstyle="full" if filled else "none",
                label=f"{c.interpolation}, {label} start",
            )
            pairs = zip(c.pixels[chosen], c.iterations[chosen], strict=True)
            ax.plot(c.pixels[chosen], [c.time_us(n, i) for n, i in pairs], color=f"C{k}", lw=0.8)
    ax.set(
        xlabel="pixels in the subset", ylabel="us a point", title="Motion, one thread; lines: the model", xlim=0, ylim=0
    )
    ax.legend(fontsize=8)
    text = [COSTS_HOW, table(head, rows), save(figure, "bench_costs.png", "Time against pixels")]
    return text + (_parts_text(report) if report.parts else [])


def _parts_text(report: Report) -> list[str]:
    columns: dict[str, dict[str, float]] = {}
    for part in report.parts:
        spent = float(report.iterations[f"motion, {part.interpolation}, {part.subset_px} px"].mean())
        total = 1e6 / pick_rate(report, "motion", part.interpolation, part.subset_px, 1)
        columns[f"{part.interpolation}, {part.subset_px} px"] = part.split_us(total, spent)
    names = list(next(iter(columns.values())))
    rows = [[name, *(f"{column[name]:.2f}" for column in columns.values())] for name in names]
    rows.append(["all", *(f"{sum(column.values()):.2f}" for column in columns.values())])
    rows.append(["pixel loop alone, ns a pixel and image", *(f"{part.loop_ns:.2f}" for part in report.parts)])
    figure, ax = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
    bottoms = np.zeros(len(columns))
    for k, name in enumerate(names):
        heights = np.array([column[name] for column in columns.values()])
        ax.bar(list(columns), heights, bottom=bottoms, color=f"C{k}", label=name, width=0.6)
        bottoms += heights
    ax.set(ylabel="us a point", title="Where a motion's time goes, one thread")
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(handles[::-1], labels[::-1], fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plot = save(figure, "bench_parts.png", "Parts of a fit's time")
    return [PARTS_HOW, table(["us a point", *columns], rows), plot]


KERNEL_HOW = """`fit_shape` and `fit_motion` alone (stretch patch, three comparisons), 512 x 480 px, 60 degrees, noise 2 of 255, images prepared, starts within
a tenth of a pixel, as in a sequence. Best of several runs."""
COSTS_HOW = """Nine subset sizes from 9 to 41 px and two distances of the start values, one thread, fitted by
`time = a + b iterations + pixels (c + 3 d iterations)`: once a point (places, factors, covariance), each iteration (warps, sums' algebra, solve), once a
pixel (the reference's rows and the sums of its normal equations), and the pixel loop."""

PARTS_HOW = """The same from the other side: the kernel's own functions, each timed alone on one point, times as often as a fit calls them. "The rest" is what is left of the measured time:
tests, updates, correlations, results, calls, and memory that is not in the first cache."""


# the machine


def machine_text(report: Report) -> list[str]:
    """The section about the machine's limits and how near the loop comes to them."""
    head = [
        "threads",
        "multiply-adds, GFlop/s",
        "L1 / L2 / L3 loads, GB/s",
        "copy / triad, GB/s",
        "16 taps by gathers, ns",
        "16 taps by rows of four, ns",
    ]
    rows = [
        [
            str(c.threads),
            f"{c.fma_gflops:.0f}",
            " / ".join(f"{v:.0f}" for v in c.load_gb_s.values()),
            f"{c.copy_gb_s:.1f} / {c.triad_gb_s:.1f}",
            f"{c.gather_ns:.2f}",
            f"{c.rows_ns:.2f}",
        ]
        for c in report.ceilings
    ]
    text = [CEILINGS_HOW, table(head, rows)]
    here = {loop.loop: loop for loop in report.loops if loop.target == HERE}
    one = next((c for c in report.ceilings if c.threads == 1), None)
    if one and here and report.costs:
        lines = []
        for c in report.costs:
            loop = here[c.interpolation]
            arithmetic, loads = loop_limits_ns(loop, one)
            lines.append(
                [
                    c.interpolation,
                    f"{c.loop_ns:.2f}",
                    f"{arithmetic:.2f} ({100 * arithmetic / c.loop_ns:.0f} %)",
                    f"{loads:.2f} ({100 * loads / c.loop_ns:.0f} %)",
                ]
            )
        text += [
            SHARE_HOW,
            table(
                ["spline", "measured, ns a pixel, image and iteration", "its arithmetic alone", "its row loads alone"],
                lines,
            ),
        ]
    return text


def loop_limits_ns(loop: LoopCount, one: Ceilings) -> tuple[float, float]:
    """ns a pixel that the loop's vector arithmetic and its row loads would take alone, one thread at its measured best."""
    instructions = sum(loop.counts[name] for name in ("multiply-adds", "multiplies, adds", "rounds, converts"))
    lanes = min(loop.width_bits // 32, one.vector)
    a_second = one.fma_gflops * 1e9 / (2 * one.vector)  # vector instructions
    arithmetic = 1e9 * instructions * (8 / lanes) / (8 * a_second)
    # the ceiling's pixel is four row loads; the loop's turn is eight pixels
    return arithmetic, one.rows_ns * loop.counts["row loads"] / 32


CEILINGS_HOW = """Small loops in LLVM IR, compiled by the LLVM behind numba for this processor, all threads at once; taps come from a picture that fits the first
cache. A gather is one instruction a tap for eight pixels; rows are four loads of four values a pixel, each with a multiply-add."""
SHARE_HOW = """The pixel loop beside these limits, one thread. "Arithmetic": its vector multiplies, adds and conversions at the rate of multiply-adds. "Row loads": as many as
it has, at the measured rate. What is left is shuffles between the two, stack accesses and latency."""


# generated code


def assembly_text(report: Report) -> list[str]:
    """The section about the generated code."""
    if not report.loops:
        return []
    classes = list(report.loops[0].counts)
    head = ["processor", "loop", "vector, bit", "instructions", *classes, "touch the stack"]
    rows = [
        [x.target, x.loop, str(x.width_bits), str(x.instructions), *(str(x.counts[c]) for c in classes), str(x.stack)]
        for x in report.loops
    ]
    gathers = sum(x.counts["gathers"] for x in report.loops)
    how = ASSEMBLY_HOW.format(gathers="No gathers are left" if gathers == 0 else f"{gathers} gathers are left")
    return [how, table(head, rows)]


ASSEMBLY_HOW = """Instructions of one turn of the innermost loop (eight pixels of one image), compiled for four processors and for this one, counted in the assembly; nothing of
it was run elsewhere. `haswell` and `znver3` have AVX2, the other two AVX-512. {gathers}; taps come as rows of four (`vmovups` and `vinsertf128`; a quintic's
fifth and sixth taps as pairs). An instruction counts in one class; those with a place on the stack are counted besides."""


def write_page(report: Report) -> Path:
    """Write tables and plots, and the figures of the page; returns the page."""
    sections: list[tuple[str, list[str]]] = [
        ("Peers", peers_page.text(report.ours, report.peers) if report.ours else []),
        ("One point", kernel_text(report) if report.rates else []),
        ("Limits of the machine", machine_text(report) if report.ceilings else []),
        ("Generated code", assembly_text(report)),
        *((title, [text]) for title, text in report.more),
    ]
    texts = [(title, "\n\n".join(parts)) for title, parts in sections if parts]
    return write_sections(machine(), [target_line(row) for row in targets(report)], texts)


def write_sections(about: list[str], rows: list[list[str]], sections: list[tuple[str, str]]) -> Path:
    """Write a table for each section, and between the page's marks the machine, headline rows and sections without tables."""
    page = layout.DOCS / "explanation" / "performance.md"
    folder = page.with_suffix("")
    head = ["what", "measured", "unit", "asked", "met"]
    write_tables("\n\n".join(["\n".join(f"- {line}" for line in about), table(head, rows)]), folder, "targets")
    asked = [row for row in rows if row[3]]
    missed = [row for row in asked if row[4] != "yes"]
    shown = [row for row in asked if row in missed or not any(word in row[0] for word in _VARIANTS)]
    parts = [
        "\n".join(f"- {line}" for line in about),
        table(head, shown),
        f"Missed: {len(missed)} of the {len(asked)} figures that have a limit.",
    ]
    for title, text in sections:
        if not write_tables(text, folder, "_".join(re.findall("[a-z0-9]+", title.lower()))):
            parts += [f"### {title}", text]
    text = wrapped("\n\n".join(parts))
    page.write_text(marked(page.read_text(encoding="utf-8"), "measured", text), encoding="utf-8")
    return page


#: rows of these are not shown on the page unless they miss their limit
_VARIANTS = ("+strain", "quintic s", "points lost")
