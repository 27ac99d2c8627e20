"""Writes ``docs/explanation/live_speed.md`` and its plots from what a run showed."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullFormatter

from stereorig.server.workflows.live.series import KEPT_FRAMES
from tests.bench.documents.prose import wrapped

if TYPE_CHECKING:
    from tests.bench.live.live import Run

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = DOCS / "explanation" / "live_speed.md"
FIGURE = DOCS / "figures" / "live_speed.png"
#: ms, of the distribution
ASKED = {50.0: 8.0, 99.0: 20.0, 99.9: 40.0}
RATE_HZ = 50.0
_IDLE_LOAD = 3.0


def write_page(main: Run, runs: list[Run], faster: list[Run]) -> None:
    """Write page and plot; ``faster`` are runs with other settings, at as many points as the main one."""
    _draw(main, runs)
    rows = "\n".join(
        f"| p{q:g} | {asked:g} | {main.percentile(q):.1f} | {'held' if main.percentile(q) <= asked else '**missed**'} |"
        for q, asked in ASKED.items()
    )
    rates = "\n".join(
        f"| {run.points:,} | {run.rate_hz:.1f} | {run.percentile(50.0):.1f} | {run.percentile(99.0):.1f} | "
        f"{run.account['skipped']} | {run.account['refused']} |"
        for run in runs
    )
    by_settings = "\n".join(
        f"| {run.settings['subset_px']} | {run.settings['interpolation']} | {run.rate_hz:.1f} | "
        f"{run.percentile(50.0):.1f} | {run.percentile(99.0):.1f} | {run.busy_ms:.1f} |"
        for run in (next(run for run in runs if run.points == main.points), *faster)
    )
    quarter, last = np.array(main.memory_mib[len(main.memory_mib) // 4 :][:5]), np.array(main.memory_mib[-5:])
    grown = last.mean(axis=0) - quarter.mean(axis=0)
    busy = main.load > _IDLE_LOAD
    load = f"The machine's load average was {main.load:.1f} on {os.cpu_count()} cores" + (
        ": other programs ran on it, and these figures are no measure of an idle machine." if busy else "."
    )
    account = main.account
    PAGE.write_text(
        "\n\n".join(
            [
                "# Speed of a live measurement",
                wrapped(
                    f"Written by `make livebench` on {datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, "
                    f"{os.cpu_count()} cores. {load}"
                ),
                wrapped(
                    f"Two simulated cameras of 512 x 480 px at {RATE_HZ:g} Hz show pictures that were rendered "
                    "beforehand; the service, the cameras, the computation and the reader share the machine. Latency "
                    "runs from the arrival of the later frame in memory to the value in the reader's process, over a "
                    "WebSocket. The pictures move by 0.2 px a frame, and turn back every twelfth."
                ),
                f"## {main.points:,} points and 12 gauges beside a stored step a second",
                wrapped(
                    f"{main.seconds / 60.0:.1f} minutes, subsets of {main.settings['subset_px']} px, "
                    f"{main.settings['interpolation']}; {main.rate_hz:.1f} values a second; "
                    f"{main.captures} steps were stored meanwhile. The computation took {main.busy_ms:.1f} ms of "
                    "processor time a pair, all of its threads together."
                ),
                f"| latency | asked, ms | measured, ms | |\n| --- | --- | --- | --- |\n{rows}",
                "![Latency, rate by points and memory](../figures/live_speed.png)",
                wrapped(
                    f"Of {account['frames']:,} pairs {account['measured']:,} were measured ({account['step']} with all "
                    f"checks), {account['skipped']:,} skipped for a newer one, {account['refused']} refused. Resident "
                    f"memory grew by {grown[0]:+.1f} MiB (service) and {grown[1]:+.1f} MiB (computation) from the "
                    f"end of the first quarter to the end; before, the last {KEPT_FRAMES:,} values were gathered."
                ),
                "## Rate by points",
                "| points | values/s | p50, ms | p99, ms | skipped | refused |\n| --- | --- | --- | --- | --- | --- |\n"
                + rates,
                f"## {main.points:,} points with other settings",
                wrapped(
                    "What a live measurement takes by its subsets and interpolation; a value's standard deviation goes "
                    "with the width of the subset, and the cubic spline's bias is about three times the quintic's."
                ),
                "| subset, px | interpolation | values/s | p50, ms | p99, ms | processor time a pair, ms |\n"
                "| --- | --- | --- | --- | --- | --- |\n" + by_settings,
            ]
        )
        + "\n",
        encoding="utf-8",
    )


def _draw(main: Run, runs: list[Run]) -> None:
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12.0, 3.6), constrained_layout=True)
    latency = np.sort(main.latency_ms)
    left.loglog(latency, 1.0 - np.arange(len(latency)) / max(len(latency), 1), label="measured")
    for q, asked in ASKED.items():
        left.plot(asked, 1.0 - q / 100.0, "kv", ms=6, label="asked" if q == 50.0 else None)
    left.set(xlabel="latency, ms", ylabel="share of values that took longer", title=f"{main.points:,} points")
    left.xaxis.set_minor_formatter(NullFormatter())
    left.legend()
    middle.semilogx([run.points for run in runs], [run.rate_hz for run in runs], "o-")
    middle.axhline(RATE_HZ, color="gray", lw=0.8, ls="--")
    middle.set(
        xlabel="points", ylabel="values a second", ylim=(0.0, 1.1 * RATE_HZ), title="Rate; dashed: of the cameras"
    )
    memory = np.array(main.memory_mib)
    for k, name in enumerate(("service", "computation")):
        right.plot(np.arange(len(memory)) / 60.0, memory[:, k], label=name)
    right.set(xlabel="minutes", ylabel="resident memory, MiB", title="Memory")
    right.set_ylim(0.0)
    right.legend()
    figure.savefig(FIGURE, dpi=110)
    plt.close(figure)
