"""Writes ``docs/explanation/cluster.md`` and its plot from what was measured and simulated."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt

from tests.bench.cluster.scheduler import Simulated, longest_block
from tests.bench.documents.prose import wrapped

if TYPE_CHECKING:
    from tests.bench.cluster.bench import Figures

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = DOCS / "explanation" / "cluster.md"
FIGURE = DOCS / "figures" / "cluster.png"
#: workers: times faster
ASKED = {2: 1.8, 64: 50.0}
_IDLE_LOAD = 0.5


def write_page(figures: Figures, times: dict[str, float]) -> None:
    """Write page and plot."""
    _draw(figures)
    one, two = figures.runs
    own = [sum(one.busy_s) / max(run.busy_s) for run in figures.runs]
    alone = [run.within for run in figures.runs]
    rows = "\n".join(
        f"| {run.workers} | {run.wall_s:.1f} | {one.wall_s / run.wall_s:.2f} | {sum(run.busy_s):.1f} | "
        f"{max(run.busy_s):.1f} | {by:.2f} | {within:.2f} | {run.service_s:.1f} |"
        for run, by, within in zip(figures.runs, own, alone, strict=True)
    )
    before, after = figures.load
    busy = before > _IDLE_LOAD
    many = next(s for s in figures.simulated if s.workers == max(ASKED))
    sections = [
        "# A long test on a cluster",
        wrapped(
            f"Written by `make clusterbench` on {datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {os.cpu_count()} "
            f"cores; load average {before:.1f} before and {after:.1f} after."
            + (" Other programs took their share of the cores: wall times are no measure here." if busy else "")
        ),
        "## Blocks",
        wrapped(
            "In default settings each step starts from the one before, and may change the reference for all after it. "
            "Where there is more than one worker, the steps are cut into blocks. The first step of a block, its head, "
            "is matched against the reference from seeds, so that no block waits for another; once the block before is "
            "through, it is measured again from that one's last step, as in a chain. Where both agree (same valid "
            "points, same reference, same patch, displacements within 2 % of a standard deviation, rms) the block "
            "stands; if not, its steps are measured again until one agrees. The second measurement is the one kept. A "
            "step that goes over to another reference gives all later blocks new heads, and a block whose head cannot "
            "be matched waits for the one before. So a step is final only when everything before it is; results are "
            "those of one after another, whatever a head guessed."
        ),
        "## Measured",
        wrapped(
            f"A plate that turns, moves and stretches: {figures.steps - 1} steps after the reference, {one.points:,} "
            "points of 33 px, default settings with strain; a Dask scheduler, workers of one thread, images by path. "
            "One worker measures a chain. The busiest worker's processor time is what the wall time would be on idle "
            "cores. Where other programs share the cores, the same work takes more processor time in one run than in "
            "the other; the last ratio is of one run alone: the workers' time without the heads, which a chain has "
            "not, over the busiest one's."
        ),
        "| workers | wall, s | times faster | processor time of workers, s | of the busiest, s | times faster | "
        "within the run | processor time of the service, s |\n| --- | --- | --- | --- | --- | --- | --- | --- |\n"
        + rows,
        wrapped(
            f"Asked: {ASKED[2]:g} times with two workers; by processor time of both runs {own[1]:.2f} "
            f"({_held(own[1] >= ASKED[2])}), within the run {alone[1]:.2f} ({_held(alone[1] >= ASKED[2])}), by the clock "
            f"{one.wall_s / two.wall_s:.2f}.{_compared(figures)}"
        ),
        "## Simulated",
        wrapped(
            "The same plan, asked for work by up to 128 simulated workers. Tasks take the processor time measured "
            f"above: a step {times['step']:.3f} s, a head {times['head']:.3f} s, a joint {times['joint']:.3f} s. Service "
            "and scheduler are one queue: the service's own processor time per task, "
            f"{1e3 * figures.service_s:.1f} ms as measured with workers that answer at once, and per task "
            f"{1e3 * figures.overhead.serial_s:.1f} ms of "
            f"Dask's scheduler and client with {1e3 * figures.overhead.latency_s:.0f} ms of latency, measured on a real "
            f"scheduler with {figures.overhead.workers} workers in one process whose {figures.overhead.tasks} tasks "
            f"sleep as long as a step takes and carry {figures.overhead.bytes / 1e3:.0f} kB, a task and its summary; "
            f"images and results{_weight(figures)} go by the shared disk."
        ),
        "| workers | steps | changes of the reference | times faster | heads, joints, repeats | idle | service and "
        "scheduler busy |\n| --- | --- | --- | --- | --- | --- | --- |\n"
        + "\n".join(_row(s) for s in (*figures.simulated, *figures.changed)),
        "![Speed-up](../figures/cluster.png)",
        wrapped(
            f"Asked: {ASKED[64]:g} times with 64 workers, {many.speedup:.1f} ({_held(many.speedup >= ASKED[64])}). "
            f"{_limit(many)} A block has at most {longest_block()} steps: each change of the reference makes what comes "
            "after it wait for the block in which it lies. A file system that 64 workers read and write at once is not "
            "part of the simulation."
        ),
    ]
    PAGE.write_text("\n\n".join(sections) + "\n", encoding="utf-8")


def _compared(figures: Figures) -> str:
    if figures.worst_sigma is None:
        return " The results of both runs were not compared here; a test does."
    return (
        f" Largest difference of a displacement between both runs: {figures.worst_sigma:.1e} of its standard deviation; "
        f"points with another status: {figures.status_changed}."
    )


def _weight(figures: Figures) -> str:
    return "" if figures.bytes_a_task is None else f", {figures.bytes_a_task / 1e6:.1f} MB a step,"


def _held(yes: bool) -> str:
    return "held" if yes else "**missed**"


def _row(s: Simulated) -> str:
    return (
        f"| {s.workers} | {s.steps:,} | {s.changes} | {s.speedup:.1f} | {100 * s.besides:.0f} % | {100 * s.idle:.0f} % | "
        f"{100 * s.coordinator:.0f} % |"
    )


def _limit(s: Simulated) -> str:
    causes = {
        "heads and joints, which are measured besides the steps": s.besides,
        "workers that wait for the last blocks, for the service or for the scheduler": s.idle,
    }
    first = max(causes, key=lambda name: causes[name])
    more = (
        " Service and scheduler are busy all the time: more workers gain nothing with steps as small as these."
        if s.coordinator > 0.95
        else f" Service and scheduler are busy for {100 * s.coordinator:.0f} % of the time."
    )
    return f"What limits it first: {first} ({100 * causes[first]:.0f} % of the workers' time).{more}"


def _draw(figures: Figures) -> None:
    found = figures.simulated
    workers = [s.workers for s in found]
    picture, axes = plt.subplots(figsize=(6.4, 4.0), dpi=120)
    axes.plot(workers, workers, color="0.7", label="as many times as workers")
    axes.plot(workers, [s.speedup for s in found], "o-", label="simulated, one reference")
    for s in figures.changed:
        axes.plot([s.workers], [s.speedup], "s", label=f"with {s.changes} change{'s' if s.changes > 1 else ''} of it")
    one, two = figures.runs
    axes.plot([1, 2], [1.0, sum(one.busy_s) / max(two.busy_s)], "k^", label="measured, processor time of both runs")
    axes.plot(list(ASKED), list(ASKED.values()), "r_", markersize=14, label="asked")
    axes.set(xscale="log", yscale="log", xlabel="workers", ylabel="times faster than a chain")
    axes.set_xticks(workers, [str(w) for w in workers])
    axes.set_yticks(workers, [str(w) for w in workers])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    picture.tight_layout()
    picture.savefig(FIGURE)
    plt.close(picture)
