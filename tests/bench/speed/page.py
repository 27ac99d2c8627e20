"""Writes ``docs/explanation/performance.md`` and its plots from what the bench measured."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from tests.bench.accuracy.table import Row
from tests.bench.documents.prose import wrapped
from tests.bench.speed.assembly import HERE, LoopCount
from tests.bench.speed.ceilings import Ceilings
from tests.bench.speed.kernel import Costs, Rate
from tests.bench.speed.parts import Parts
from tests.bench.speed.peer import Outcome

DOCS = Path(__file__).resolve().parents[3] / "docs"


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
    ours, peer
        Outcomes by scene.
    peer_version
        None where the peer is not installed.
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
    peer: dict[str, list[Outcome]] = field(default_factory=dict)
    peer_version: str | None = None
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


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def thousands(value: float) -> str:
    """Three digits that count, with commas."""
    if not np.isfinite(value):
        return "-"
    digits = max(0, int(np.floor(np.log10(abs(value)))) - 2) if value else 0
    return f"{round(value / 10**digits) * 10**digits:,.0f}"


def save(figure: plt.Figure, name: str, caption: str) -> str:
    """Write a plot and return its line in the page."""
    (DOCS / "figures").mkdir(exist_ok=True)
    figure.savefig(DOCS / "figures" / name, dpi=110)
    plt.close(figure)
    return f"![{caption}](../figures/{name})"


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
        for fit, subset, min_rate in (("motion", 33, 6e4), ("motion", 21, 1.2e5), ("shape", 33, 2e5)):
            rate = pick_rate(report, fit, "cubic", subset, max_threads)
            rows.append(
                Row(
                    f"{fit}, cubic, {subset} px, {max_threads} thread{'s' if max_threads > 1 else ''}",
                    rate,
                    "points/s",
                    min_rate,
                    at_least=True,
                )
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
    return [*rows, *peer_rows(report), *report.rows]


def target_line(row: Row) -> list[str]:
    """One line of the page's first table."""

    def figure(value: float) -> str:
        return f"{value:.3g}" if abs(value) < 1e3 else thousands(value)  # which also handles NaN

    limit = "" if row.limit is None else f"{'at least' if row.at_least else 'at most'} {figure(row.limit)}"
    met = "" if row.limit is None else ("yes" if row.met else "**no**")
    return [row.what, figure(row.measured), row.unit, limit, met]


# the peer


def find(outcomes: list[Outcome], name: str, threads: int) -> Outcome | None:
    """The outcome of a run by its name."""
    return next((o for o in outcomes if o.run.name == name and o.threads == threads), None)


def further_s(outcomes: list[Outcome], sequence: Outcome) -> float:
    """Seconds of a step after the first: a sequence less the single step of the same setting; NaN without one."""
    setting = sequence.run.name.split(" ", 1)[0]
    for o in outcomes:
        same = (o.threads, o.run.subset_px, o.run.steps) == (sequence.threads, sequence.run.subset_px, 1)
        if same and o.run.name.startswith(setting) and sequence.run.steps > 1:
            return (sequence.wall_s - o.wall_s) / (sequence.run.steps - 1)
    return float("nan")


def peer_rows(report: Report) -> list[Row]:
    """Ratios to the peer and errors beside its."""
    rows = []
    for scene, outcomes in report.ours.items():
        for ours in outcomes:
            if ours.run.subset_px != 33 or "tuned" not in [o.run.name.split()[0] for o in report.peer.get(scene, [])]:
                continue
            what = ours.run.name.split(" ", 1)[1]
            peer = find(report.peer[scene], f"tuned {what}", ours.threads)
            if peer is None or scene != "modern":
                continue
            min_rate = 10.0 if "sequence" in what else 3.0
            label = f"{ours.run.name}, {ours.threads} thread{'s' if ours.threads > 1 else ''}"
            rows.append(Row(f"speed over the peer's: {label}", ours.rate / peer.rate, "", min_rate, at_least=True))
            if "sequence" in what:
                further = further_s(report.peer[scene], peer) / further_s(outcomes, ours)
                rows.append(Row("the same, steps after the first alone", further, ""))
            if "sequence" in what and ours.threads == max(o.threads for o in outcomes):
                worst = float(np.max(ours.errors.sd_um[:3] / peer.errors.sd_um[:3]))
                rows.append(Row(f"random error over the peer's, worst of u, v, w: {label}", worst, "", 1.0))
                rows.append(Row(f"points lost: {label}", ours.errors.lost, "", 0))
    return rows


def _outcome_row(program: str, o: Outcome) -> list[str]:
    e = o.errors
    sd, mean = [f"{v:.3f}" for v in e.sd_um], [f"{v:+.3f}" for v in e.mean_um]
    return [
        program,
        o.run.name,
        str(o.threads),
        f"{o.wall_s:.2f}",
        thousands(o.rate),
        str(e.lost),
        " / ".join(sd),
        " / ".join(mean),
    ]


def peer_text(report: Report) -> list[str]:
    """The section about the peer."""
    head = [
        "program",
        "run",
        "threads",
        "s",
        "points/s",
        "lost",
        "sd of u / v / w / Z, um",
        "mean of u / v / w / Z, um",
    ]
    text = [PEER_HOW.format(version=report.peer_version or "not installed here")]
    for scene, ours in report.ours.items():
        rows = [_outcome_row("stereorig", o) for o in ours]
        rows += [_outcome_row("pyvale", o) for o in report.peer.get(scene, [])]
        text += [f"### {SCENES[scene]}", table(head, rows)]
    if report.peer:
        text += [_speed_plot(report), _accuracy_plot(report)]
    return text


def _speed_plot(report: Report) -> str:
    scene = "modern" if "modern" in report.peer else next(iter(report.peer))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained", sharey=True)
    for ax, threads in zip(axes, sorted({o.threads for o in report.ours[scene]}), strict=False):
        bars = [("stereorig", o) for o in report.ours[scene]] + [("pyvale", o) for o in report.peer[scene]]
        bars = [(program, o) for program, o in bars if o.threads == threads and o.run.subset_px == 33]
        names = [o.run.name.removesuffix(", 33 px") for _, o in bars]
        drawn = ax.barh(names, [o.rate for _, o in bars], color=["C0" if p == "stereorig" else "C1" for p, _ in bars])
        ax.bar_label(drawn, [thousands(o.rate) for _, o in bars], padding=3, fontsize=8)
        ax.set(xlabel="points / s", title=f"{threads} thread{'s' if threads > 1 else ''}")
        ax.margins(x=0.22)
    axes[0].invert_yaxis()
    figure.suptitle("Disk to disk, 33 px: stereorig (blue), pyvale (orange)")
    return save(figure, "bench_peer_speed.png", "Points a second, ours and the peer's")


def _accuracy_plot(report: Report) -> str:
    scenes = list(report.peer)
    figure, axes = plt.subplots(1, len(scenes), figsize=(4.6 * len(scenes), 3.6), layout="constrained", squeeze=False)
    for ax, scene in zip(axes[0], scenes, strict=True):
        max_threads = max(o.threads for o in report.ours[scene])
        for colour, outcomes in (("C0", report.ours[scene]), ("C1", report.peer[scene])):
            for k, o in enumerate(o for o in outcomes if o.threads == max_threads and "sequence" in o.run.name):
                ax.plot(o.rate, o.errors.sd3_um, "o" if o.run.subset_px == 33 else "s", color=colour)
                label = f"{o.run.name.split()[0]}, {o.run.subset_px} px"
                ax.annotate(
                    label,
                    (o.rate, o.errors.sd3_um),
                    fontsize=7,
                    xytext=(4, -10 if k % 2 else 4),
                    textcoords="offset points",
                )
        ax.set(xscale="log", xlabel="points / s", ylabel="random error of the displacement / um", title=SCENES[scene])
        ax.title.set_fontsize(9)
        low, high = np.log10(ax.dataLim.intervalx)
        ax.set_xlim(10 ** np.floor(low), 10 ** np.ceil(high + 0.3))
        ax.set_ylim(0.0, 1.2 * ax.dataLim.ymax)
    return save(figure, "bench_peer_accuracy.png", "Random error against speed")


SCENES = {
    "modern": "25 degrees, 1200 x 1100 px, 39 um a pixel, 9,900 points",
    "paper": "60 degrees, 512 x 480 px, 33 um a pixel, 1,330 points",
}
PEER_HOW = """pyvale {version} (`dic.calculate_3d`) and `stereorig measure`, each called in one warm process of its own, on as many cores as
threads: image files on disk to result files on disk, the same TIFF files (8 bit, noise 2 of 255), the same points (step 10
px), the same cameras to the last digit (OpenCV's lens with distortion, in both). "single" is the reference and one step, "sequence" the
reference and several; points a second count the points of the displacement fields, and the time is the whole call's, the reference's own
work and, for us, the search for seeds included. pyvale is given its seed. Its subsets move by an affine function, which leaves out the second
order of perspective, ours as planes in space; both weigh all pixels alike. Its settings:

- `tuned`: 16 px as the largest displacement to look for, which makes its first search fast; everything else its default (cubic B-spline,
  Gaussian filter of 5 px with sd 1, precision 0.001). This is what the ratios compare with.
- `default`: all its defaults (128 px to look for).
- `loose`: precision 0.01. `unfiltered`: without its Gaussian filter.

Means and scatters are over points against the simulation's truth, in the system of the specimen (w and Z across its plane); the scatter is pooled over
steps, the mean is the worst step's."""


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

HEAD = """# Performance

Everything on this page was measured by `make bench` in one run, which writes the page anew; nothing is typed in. Timings are those of this machine at that hour;
ratios within the page travel better than figures.
"""


def write_page(report: Report) -> Path:
    """Write the page and its plots; returns its path."""
    rows = [target_line(row) for row in targets(report)]
    sections: list[tuple[str, list[str]]] = [
        ("Machine", [*(f"- {line}" for line in machine())]),
        ("Targets", [table(["what", "measured", "unit", "asked", "met"], rows)]),
        ("Beside pyvale", peer_text(report) if report.ours else []),
        ("One point", kernel_text(report) if report.rates else []),
        ("The machine's limits", machine_text(report) if report.ceilings else []),
        ("Generated code", assembly_text(report)),
        *((title, [text]) for title, text in report.more),
    ]
    page = [HEAD]
    for title, parts in sections:
        if parts:
            glue = "\n" if title == "Machine" else "\n\n"
            page += [f"## {title}\n", glue.join(parts) + "\n"]
    path = DOCS / "explanation" / "performance.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text(wrapped("\n".join(page)).rstrip() + "\n")
    return path
