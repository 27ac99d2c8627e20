"""Writes ``docs/explanation/years.md``'s figures and plots, between its marks."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.server.formats.version import software_version
from tests.bench.documents.prose import wrapped
from tests.bench.years.measure import Cost
from tests.bench.years.soak import MACHINE, Soak, verdicts

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = DOCS / "explanation" / "years.md"
_BUDGET_MS, _BUDGET_S = 50.0, 5.0


def _between(name: str, text: str) -> None:
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(begin)
    _, _, after = rest.partition(end)
    PAGE.write_text(f"{before}{begin}\n{text.strip()}\n{end}{after}", encoding="utf-8")


def _machine() -> str:
    return f"{os.cpu_count()} processors, Python {platform.python_version()}, version {software_version()}"


def draw_costs(costs: list[Cost]) -> None:
    """Draw start and answers over the number of steps."""
    steps = [one.steps for one in costs]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.0), constrained_layout=True)
    for name in costs[-1].start_s:
        left.loglog(steps, [one.start_s[name][1] for one in costs], "o-", label=f"to the first answer, {name}")
    left.loglog(steps, [one.rebuilt_s[1] for one in costs], "s--", label="until all is read, after a kill")
    left.axhline(_BUDGET_S, color="k", ls=":", lw=0.8)
    left.set_ylabel("processor time of the service, s")
    for name in costs[-1].cpu_ms:
        right.loglog(steps, [max(one.cpu_ms[name], 0.1) for one in costs], "o-", label=name)
    right.axhline(_BUDGET_MS, color="k", ls=":", lw=0.8)
    right.set_ylabel("processor time of an answer, ms")
    for axes in (left, right):
        axes.set_xlabel("steps in the data folder")
        axes.legend(fontsize=7)
    figure.savefig(DOCS / "figures" / "years.png", dpi=110)
    plt.close(figure)


def write_page(costs: list[Cost]) -> None:
    """Write the section on cost over size."""
    draw_costs(costs)
    head = "|  | " + " | ".join(f"{one.tests:,} tests, {one.steps:,} steps" for one in costs) + " |"
    rows = [head.replace(",", " "), "| --- " * (len(costs) + 1) + "|"]

    def row(name: str, values: list[str]) -> None:
        rows.append(f"| {name} | " + " | ".join(values) + " |")

    for name in costs[-1].start_s:
        row(
            f"first answer, {name}: wall / processor, s",
            [f"{w:.1f} / {c:.1f}" for w, c in (one.start_s[name] for one in costs)],
        )
    row(
        "all read after a kill: wall / processor, s",
        [f"{one.rebuilt_s[0]:.1f} / {one.rebuilt_s[1]:.1f}" for one in costs],
    )
    row("stop, s", [f"{one.stop_s:.1f}" for one in costs])
    row("catalogue, MiB", [f"{one.disk_mib:.1f}" for one in costs])
    row("memory of the service, MiB", [f"{one.memory_mib:.0f}" for one in costs])
    for name in costs[-1].cpu_ms:
        row(
            f"{name}: processor / p50 / p99, ms; kB",
            [
                f"{one.cpu_ms[name]:.1f} / {one.p50_ms[name]:.1f} / {one.p99_ms[name]:.1f}; {one.reply_bytes[name] / 1e3:.0f}"
                for one in costs
            ],
        )
    loads = ", ".join(f"{one.load:.1f}" for one in costs)
    text = (
        f"{_machine()}; load of the machine while the answers were timed: {loads}. Wall times are of this load; processor times are the "
        "service's own. *A test*, *an analysis* and their lists are those of the longest test: half of all steps in the first column, "
        "5 000 in the others. p50 and p99 are of a hundred requests, one after the other."
    )
    _between("cost", wrapped(text) + "\n\n" + "\n".join(rows) + "\n\n![Cost over size](../figures/years.png)")


def draw_soak(soak: Soak) -> None:
    """Draw every series over its time."""
    series = [one.name for one in verdicts(soak)]
    figure, axes = plt.subplots(3, 2, figsize=(9.0, 7.5), sharex=True, constrained_layout=True)
    for name, box in zip(series, axes.flat, strict=False):
        at, values = np.array(soak.series[name]).T
        box.plot(at / 60.0, values, ".", ms=2)
        box.axvline(soak.warm_s / 60.0, color="k", ls=":", lw=0.8)
        box.set_ylabel(name)
        box.set_ylim(0.0, 1.2 * float(np.percentile(values, 99.5)))
    for box in axes[-1]:
        box.set_xlabel("minutes")
    figure.savefig(DOCS / "figures" / "soak.png", dpi=110)
    plt.close(figure)


def _machines_own(soak: Soak) -> str:
    """Say how fast the machine itself was after the warm-up, early and late."""
    late = np.array([value for at, value in soak.series[MACHINE] if at >= soak.warm_s])
    first, last = (float(np.median(part)) for part in (late[: len(late) // 2], late[len(late) // 2 :]))
    return f"{MACHINE[0].upper()}{MACHINE[1:]}: {first:.2f} in the first half of that time, {last:.2f} in the second."


def write_soak(soak: Soak) -> None:
    """Write the section on the soak."""
    draw_soak(soak)
    rows = ["| series | mean | growth, 95 % interval | allowed | verdict |", "| --- | --- | --- | --- | --- |"]
    rows += [
        f"| {g.name} | {g.mean:.1f} | {g.grown:+.2f} ({g.low:+.2f} to {g.high:+.2f}) | {g.allowed:g} | {g.verdict} |"
        for g in verdicts(soak)
    ]
    quarter = max(len(soak.load) // 4, 1)
    first, last = np.mean(soak.load[:quarter]), np.mean(soak.load[-quarter:])
    did = ", ".join(f"{n:,} {what}".replace(",", " ") for what, n in soak.done.items())
    text = (
        f"{soak.seconds / 60:.0f} minutes; {_machine()}; load of the machine {np.mean(soak.load):.1f} ({first:.1f} in the first "
        f"quarter, {last:.1f} in the last). Done: {did}"
        f"{'' if soak.live else '; no live measurement: this version has none'}. Answers that were not as they should be: {len(soak.wrong)}. "
        f"Growth is from minute {soak.warm_s / 60:.0f} to the end. {_machines_own(soak)}"
    )
    _between("soak", wrapped(text) + "\n\n" + "\n".join(rows) + "\n\n![Soak](../figures/soak.png)")
