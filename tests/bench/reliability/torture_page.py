"""The section on kills of docs/explanation/reliability.md, and its figure, from the figures of a run."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")
import matplotlib.pyplot as plt

from tests.bench.documents.prose import wrapped

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = DOCS / "explanation" / "reliability.md"
BEGIN, END = "<!-- kills: begin -->", "<!-- kills: end -->"
FIGURE = "reliability_kills.png"
_ACTS = {
    "record": "two clients capture and import steps",
    "analyse": "an analysis runs, steps are captured beside it",
    "calibrate": "a calibration moves the stage and fits, steps are imported beside it",
    "delete": "tests are deleted and restored, steps are captured beside it",
    "noise": "a noise measurement runs, steps are imported beside it",
    "start": "the service is starting",
}
_COUNTS = {
    "steps": "steps acknowledged",
    "images read back": "of their images read back over HTTP and compared with the acknowledged SHA-256",
    "results": "results of analyses announced",
    "results read back": "of them read back and compared",
    "complete, unacknowledged steps": "steps that were whole although no reply had been sent",
    "incomplete steps": "steps left incomplete, each one that had no answer",
    "jobs": "jobs acknowledged",
    "interrupted after a kill": "jobs that read `interrupted` after the restart",
    "deleted": "tests deleted",
}


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))


def percentile(values: list[float], share: float) -> float:
    """Value that this share of the values does not exceed."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def section(run: dict[str, Any]) -> str:
    """Write the section."""
    machine = run["machine"]
    counts = run["counts"]
    lines = [
        f"{run['kills']} kills: {len(run['wrong'])} acknowledged things lost or wrong. {machine['processors']} processors "
        f"({machine['model']}), Python {machine['python']}, load {machine['load']} at the end; {run['wall_s'] / 60:.0f} minutes, version {run['version']}.",
        "",
        table(["kills", "while"], [[str(run["by_act"].get(act, 0)), text] for act, text in _ACTS.items()]),
        "",
        table(
            ["", "over all kills"],
            [[f"{counts[name]:,}".replace(",", " "), text] for name, text in _COUNTS.items() if counts.get(name)],
        ),
        "",
        "After each kill, on the same folder: `stereorig verify` finds nothing damaged and nothing missing from the catalogue, every acknowledged step "
        "is what was acknowledged, no more steps are incomplete or unacknowledged than requests had no answer, those requests sent again have one "
        "effect, every job is in a final state, deleted tests are either in their place or in the trash, and a new capture works.",
        "",
        "From the start of the process to the first answer, to the first capture (rig ready) and to `/readyz` (worker ready too):",
        "",
        table(
            ["start", "n", "", "median", "95 %", "slowest"],
            [row for name, starts in _kinds(run) for row in _times(name, starts)],
        ),
        "",
        _processor(run),
        "",
        f"![Restart to ready](../figures/{FIGURE})",
    ]
    return "\n".join(lines)


def _kinds(run: dict[str, Any]) -> list[tuple[str, list[dict[str, float]]]]:
    first = [start for start in run["cold"] if start.get("first")]
    beside = [start for start in run["cold"] if not start.get("first")]
    return [
        ("from the shell, before everything else on the machine", first),
        (f"from the shell, beside what else ran (load {run['machine']['load']})", beside),
        ("forked from a process that has loaded the modules, beside what else ran", run["forked"]),
    ]


def _times(name: str, starts: list[dict[str, float]]) -> list[list[str]]:
    rows = []
    for key, text in (("answers_s", "answers"), ("captures_s", "captures"), ("ready_s", "ready")):
        values = [start[key] for start in starts]
        if values:
            rows.append(
                [
                    name,
                    str(len(values)),
                    text,
                    *(f"{v:.2f} s" for v in (statistics.median(values), percentile(values, 0.95), max(values))),
                ]
            )
    return rows


def _processor(run: dict[str, Any]) -> str:
    cold = run["cold"]
    if not cold:
        return ""
    service, worker = (statistics.median(start[f"{who}_cpu_s"] for start in cold) for who in ("service", "worker"))
    return (
        f"Until it is ready, a start from the shell takes {service:.1f} s of processor time in the service and {worker:.1f} s in its worker, side by "
        "side: no start can be faster than the longer of both."
    )


def draw(run: dict[str, Any]) -> None:
    """Draw how long restarts took."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    first = [start for start in run["cold"] if start.get("first")] or run["cold"]
    for axis, starts, title in ((axes[0], first, "from the shell"), (axes[1], run["forked"], "forked")):
        for key, text, colour in (
            ("answers_s", "answers", "#7aa6c2"),
            ("captures_s", "captures", "#3b6ea5"),
            ("ready_s", "ready", "#c4572b"),
        ):
            values = sorted(start[key] for start in starts)
            if values:
                axis.step(
                    values,
                    [100.0 * (k + 1) / len(values) for k in range(len(values))],
                    where="post",
                    label=text,
                    color=colour,
                )
        axis.axvline(5.0, color="black", linewidth=0.8, linestyle=":")
        axis.set(
            xlabel="s after the start",
            ylabel="% of the restarts",
            title=f"{title}, {len(starts)} restarts",
            ylim=(0, 102),
        )
        axis.set_xlim(left=0.0)
        axis.grid(alpha=0.3)
    axes[0].legend(frameon=False)
    (DOCS / "figures").mkdir(exist_ok=True)
    figure.savefig(DOCS / "figures" / FIGURE, dpi=110)
    plt.close(figure)


def joined(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Make one of several runs."""
    first = dict(runs[0])
    for run in runs[1:]:
        for name in ("by_act", "counts"):
            first[name] = {key: first[name].get(key, 0) + run[name].get(key, 0) for key in {*first[name], *run[name]}}
        for name in ("wrong", "forked", "cold", "left_s"):
            first[name] = first[name] + run[name]
        for name in ("kills", "wall_s"):
            first[name] += run[name]
        first["machine"], first["version"] = run["machine"], run["version"]
    return first


def write_page(run: dict[str, Any]) -> None:
    """Put the section in its place, and the figure beside it."""
    text = PAGE.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n{wrapped(section(run))}\n{END}{after}", encoding="utf-8")
    draw(run)
