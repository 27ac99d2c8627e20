"""Writes the section on load of ``docs/explanation/reliability.md``, and its plot, from what a run showed."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from tests.bench.documents.prose import wrapped
from tests.bench.reliability.load import PER_MINUTE, READERS, Load, percentile

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = DOCS / "explanation" / "reliability.md"
FIGURE = DOCS / "figures" / "load.png"
BEGIN, END = "<!-- load: begin -->", "<!-- load: end -->"


def per_second(samples: list[tuple[float, float]], share: float) -> tuple[list[float], list[float]]:
    """Return whole seconds, and in each of them the value that this share did not exceed."""
    seconds = sorted({int(at) for at, _ in samples})
    return [float(s) for s in seconds], [percentile([v for at, v in samples if int(at) == s], share) for s in seconds]


def draw(load: Load) -> None:
    """Draw the run over its time."""
    figure, axes = plt.subplots(3, 1, figsize=(8.0, 7.5), sharex=True, constrained_layout=True)
    reads = [(at, ms) for at, _, ms in load.gets]
    for share, name in ((0.5, "median"), (1.0, "slowest")):
        axes[0].semilogy(*per_second(reads, share), lw=0.8, label=f"plain GET, {name} of each second")
    axes[0].axhline(100.0, color="k", ls=":", lw=0.8)
    axes[0].set_ylabel("ms")
    axes[0].legend(loc="upper right", fontsize=8)
    axes[1].semilogy(*zip(*load.captures, strict=True), ".", ms=2, label="capture, until both images are durable")
    axes[1].semilogy(*zip(*load.stops, strict=True), "v", ms=4, color="C3", label="stop, until it is on the wire")
    axes[1].axhline(50.0, color="C3", ls=":", lw=0.8)
    axes[1].set_ylabel("ms")
    axes[1].legend(loc="upper right", fontsize=8)
    times, service, worker = np.array(load.memory).T
    axes[2].plot(times, service, label="service")
    axes[2].plot(times, worker, label="worker")
    axes[2].set_ylim(bottom=0.0)
    axes[2].set_ylabel("resident memory, MiB")
    axes[2].set_xlabel("seconds")
    axes[2].legend(loc="lower right", fontsize=8)
    figure.savefig(FIGURE, dpi=110)
    plt.close(figure)


def _row(name: str, limit: str, figure: str, holds: bool) -> str:
    return f"| {name} | {limit} | {figure} | {'held' if holds else '**missed**'} |"


def section(load: Load) -> str:
    """Return the section's text."""
    stops, captures = [ms for _, ms in load.stops], [ms for _, ms in load.captures]
    asked = round(load.seconds / 60.0 * PER_MINUTE)
    late = percentile(stops, 0.99)
    p99 = load.latency(0.99)
    rows = [
        _row("captures lost", "0", f"{len(load.lost)} of {len(captures)} acknowledged", not load.lost),
        _row(
            "captures taken",
            f"{PER_MINUTE} a minute",
            f"{len(captures)} in {load.seconds:.0f} s",
            len(captures) >= 0.98 * asked - 1,
        ),
        _row(
            "plain GET, p99",
            "100 ms",
            f"{p99:.1f} ms (median {load.latency(0.5):.1f}, slowest {load.latency(1.0):.0f}; "
            f"{len(load.gets)} of them, {len(load.wrong)} failed)",
            p99 <= 100.0 and not load.wrong,
        ),
        _row(
            "stop on the wire, p99",
            "50 ms",
            f"{late:.1f} ms (median {percentile(stops, 0.5):.1f}, slowest {max(stops):.1f}; {len(stops)} of them)",
            late <= 50.0,
        ),
        _row(
            "memory of the service",
            "flat",
            f"{load.memory[-1][1]:.0f} MiB at the end, {load.growth_mib(1):+.1f} MiB from the "
            "second third of the run to the last",
            load.growth_mib(1) <= 8.0,
        ),
        _row(
            "memory of the worker",
            "flat",
            f"{load.memory[-1][2]:.0f} MiB, {load.growth_mib(2):+.1f} MiB",
            load.growth_mib(2) <= 8.0,
        ),
    ]
    model = next(
        (
            line.split(":")[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if line.startswith("model name")
        ),
        platform.machine(),
    )
    kinds = ", ".join(
        f"`{kind}` {load.latency(0.99, kind):.0f} ms" for kind in sorted({kind for _, kind, _ in load.gets})
    )
    when = datetime.now(UTC).strftime("%Y-%m-%d")
    return "\n".join(
        [
            "",
            f"`make load`, {when}, {os.cpu_count()} processors ({model}), Python {platform.python_version()}. The processors were busy to "
            f"{load.busy_share:.0%}; {load.others_share:.0%} of them worked for programs that had nothing to do with the run.",
            "",
            f"{PER_MINUTE} captures a minute for {load.seconds / 60:.1f} minutes with two cameras of 512 x 480 px, {READERS} readers that each ask for a "
            "plain document about once a second, two readers that take a live view and the event stream at 20 kB/s, the worker measuring "
            f"fields all the time ({load.results} results written), and before every twentieth capture a move that is stopped, and one back.",
            "",
            "| what | limit | measured | |",
            "| --- | --- | --- | --- |",
            *rows,
            "",
            f"A capture took {percentile(captures, 0.5):.0f} ms in the median and {percentile(captures, 0.99):.0f} ms at p99, until both images "
            "and the step's document were durable. "
            f"{len(load.refused)} requests were refused and asked for again. Every acknowledged step was read back "
            "from disk after the run and compared with the checksums that the capture's answer gave.",
            "",
            f"Plain reads by what was read, p99: {kinds}. `rig` asks the motion controller over its line each time. The limits are meant for a "
            "machine that does nothing else; where a row says **missed**, look first at the share that other programs took.",
            "",
            "![latencies and memory over the run](../figures/load.png)",
            "",
        ]
    )


def write_page(load: Load) -> None:
    """Put section and plot in their places."""
    draw(load)
    text = PAGE.read_text(encoding="utf-8")
    head, rest = text.split(BEGIN)
    PAGE.write_text(f"{head}{BEGIN}{wrapped(section(load))}{END}{rest.split(END)[1]}", encoding="utf-8")
