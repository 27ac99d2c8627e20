"""Ours beside the peers, as rows, sections and plots of ``docs/explanation/performance.md``."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from tests.bench.accuracy.table import Row
from tests.bench.speed.layout import of_threads, save, table, thousands
from tests.bench.speed.peers.programs import PEERS
from tests.bench.speed.peers.runs import Beside, Outcome

Ours = dict[str, list[Outcome]]  # by scene
SMALL_S = 0.12  # asked of a single step on the small scene


def rows(ours: Ours, besides: list[Beside]) -> list[Row]:
    """Ratios to each peer and errors beside its; what is asked holds with all threads."""
    out = [row for beside in besides for row in _peer_rows(ours, beside)]
    most = max((o.threads for outcomes in ours.values() for o in outcomes), default=0)
    for o in ours.get("modern", []):
        if (o.run.kind, o.run.subset_px, o.threads) == ("sequence", 33, most):
            out.append(Row(f"points lost: {_label(o)}", o.errors.lost, "", 0))
    for o in ours.get("paper", []):
        if (o.run.kind, o.run.subset_px, o.threads) == ("single", 33, most):
            out.append(Row(f"{_small(o)}: {_label(o)}", o.wall_s, "s", SMALL_S))
    return out


def _peer_rows(ours: Ours, beside: Beside) -> list[Row]:
    peer, out = beside.peer, []
    for scene, outcomes in ours.items():
        theirs = [o for o in beside.outcomes.get(scene, []) if o.run.setting == peer.compared]
        most = max(o.threads for o in outcomes)
        for o in outcomes:
            other = next((p for p in theirs if _what(p) == _what(o)), None)
            asked = peer.asked.get((scene, o.run.kind)) if o.threads == most else None
            if other is None or o.run.subset_px != 33 or (scene != "modern" and asked is None):
                continue
            where = "" if scene == "modern" else f"{_small(o)}, "
            ratio = o.rate / other.rate
            out.append(Row(f"speed over {peer.owner}: {where}{_label(o)}", ratio, "", asked, at_least=True))
            if o.run.kind == "sequence":
                further = further_s(theirs, other) / other.points / (further_s(outcomes, o) / o.points)
                out.append(Row("the same, steps after the first alone", further, ""))
            if o.run.kind == "sequence" and o.threads == most:
                worst = float(np.max(o.errors.sd_um[:3] / other.errors.sd_um[:3]))
                out.append(
                    Row(
                        f"random error over {peer.owner}, worst of u, v, w: {_label(o)}",
                        worst,
                        "",
                        1.0 if peer.asked else None,
                    )
                )
    return out


def _what(o: Outcome) -> tuple[str, int, int]:
    """What must be alike where a peer's outcome is compared with ours; a slow peer's sequence may be shorter."""
    return o.run.kind, o.run.subset_px, o.threads


def _label(o: Outcome) -> str:
    return f"{o.run.name}, {of_threads(o.threads)}"


def _small(o: Outcome) -> str:
    return f"{thousands(o.points)} points"


def further_s(outcomes: list[Outcome], sequence: Outcome) -> float:
    """Seconds of a step after the first: a sequence less the single step of the same setting; NaN without one, or below it."""
    for o in outcomes:
        same = (o.threads, o.run.subset_px, o.run.steps) == (sequence.threads, sequence.run.subset_px, 1)
        if same and o.run.setting == sequence.run.setting and sequence.run.steps > 1:
            more_s = sequence.wall_s - o.wall_s
            return more_s / (sequence.run.steps - 1) if more_s > 0.0 else float("nan")
    return float("nan")


def text(ours: Ours, besides: list[Beside]) -> list[str]:
    """The section about the peers."""
    head = ["program", "run", "threads", "s", "points", "points/s", "lost", "sd of u / v / w / Z, um"]
    head.append("mean of u / v / w / Z, um")
    found = {beside.peer.name: beside for beside in besides}
    out = [HOW]
    for peer in PEERS:
        version = found[peer.name].version if peer.name in found else "(not measured in this run)"
        settings = [f"- `{s.name}`: {s.says}." for s in peer.settings]
        compared = f"Ratios compare with `{peer.compared}`. Its settings:"
        out += [f"**{peer.name}** {version}: {peer.about} {compared}", "\n".join(settings)]
    out += [f"{b.peer.name} failed in this run: {'; '.join(b.failed)}." for b in besides if b.failed]
    out.append(ERRORS_HOW)
    for scene, outcomes in ours.items():
        lines = [_line("stereorig", o) for o in outcomes]
        for beside in besides:
            lines += [_line(beside.peer.name, o) for o in beside.outcomes.get(scene, [])]
        out += [f"### {SCENES[scene]}", table(head, lines)]
    return [*out, _speed_plot(ours, besides), _accuracy_plot(ours, besides)] if besides else out


def _line(program: str, o: Outcome) -> list[str]:
    e = o.errors
    return [
        program,
        o.run.name,
        str(o.threads),
        f"{o.wall_s:.2f}",
        thousands(o.points),
        thousands(o.rate),
        str(e.lost),
        " / ".join(f"{v:.3f}" for v in e.sd_um),
        " / ".join(f"{v:+.3f}" for v in e.mean_um),
    ]


def _programs(scene: str, ours: Ours, besides: list[Beside]) -> list[tuple[str, str, list[Outcome]]]:
    """Name, colour and outcomes of every program that measured a scene, ours first."""
    out = [("stereorig", "C0", ours[scene])]
    colours = {peer.name: f"C{k}" for k, peer in enumerate(PEERS, start=1)}
    return out + [(b.peer.name, colours.get(b.peer.name, "C9"), b.outcomes.get(scene, [])) for b in besides]


def _speed_plot(ours: Ours, besides: list[Beside]) -> str:
    scene = "modern" if "modern" in ours else next(iter(ours))
    counts = sorted({o.threads for o in ours[scene]})
    programs = _programs(scene, ours, besides)
    bars = [
        (name, colour, o)
        for name, colour, outcomes in programs
        for o in outcomes
        if o.run.subset_px == 33 and o.threads in counts
    ]
    most = max(sum(o.threads == n for _, _, o in bars) for n in counts)
    size = (4.8 * len(counts), 1.2 + 0.28 * most)
    figure, axes = plt.subplots(1, len(counts), figsize=size, layout="constrained", squeeze=False)
    for ax, threads in zip(axes[0], counts, strict=True):
        shown = [bar for bar in bars if bar[2].threads == threads]
        names = [f"{name}: {o.run.name.removesuffix(', 33 px')}" for name, _, o in shown]
        drawn = ax.barh(names, [o.rate for _, _, o in shown], color=[colour for _, colour, _ in shown])
        ax.bar_label(drawn, [thousands(o.rate) for _, _, o in shown], padding=3, fontsize=8)
        ax.set(xlabel="points / s", title=of_threads(threads))
        ax.tick_params(axis="y", labelsize=8)
        ax.margins(x=0.22)
        ax.invert_yaxis()
    figure.suptitle("Disk to disk, 33 px")
    return save(figure, "bench_peer_speed.png", "Points a second, ours and the peers'")


def _accuracy_plot(ours: Ours, besides: list[Beside]) -> str:
    scenes = list(ours)
    figure, axes = plt.subplots(1, len(scenes), figsize=(4.6 * len(scenes), 3.8), layout="constrained", squeeze=False)
    for ax, scene in zip(axes[0], scenes, strict=True):
        most = max(o.threads for o in ours[scene])
        for name, colour, outcomes in _programs(scene, ours, besides):
            shown = [o for o in outcomes if o.threads == most and o.run.kind == "sequence"]
            for k, o in enumerate(shown):
                place, label = (o.rate, o.errors.sd3_um), f"{o.run.setting}, {o.run.subset_px} px"
                mark = "o" if o.run.subset_px == 33 else "s"
                ax.plot(*place, mark, color=colour, label=name if k == 0 else None)
                offset = (4, -10 if k % 2 else 4)
                ax.annotate(label, place, fontsize=7, xytext=offset, textcoords="offset points")
        ax.set(xscale="log", xlabel="points / s", ylabel="random error of the displacement / um", title=SCENES[scene])
        ax.title.set_fontsize(9)
        low, high = np.log10(ax.dataLim.intervalx)
        ax.set_xlim(10 ** np.floor(low), 10 ** np.ceil(high + 0.3))
        ax.set_ylim(0.0, 1.2 * ax.dataLim.ymax)
        ax.legend(fontsize=7, loc="lower right")
    return save(figure, "bench_peer_accuracy.png", "Random error against speed")


SCENES = {
    "modern": "25 degrees, 1200 x 1100 px, 39 um a pixel, 9,900 points",
    "paper": "60 degrees, 512 x 480 px, 33 um a pixel, 1,330 points",
}
HOW = """`stereorig measure` and its peers, each called in one warm process of its own, on as many cores as threads: image files on disk to result
files on disk, the same TIFF files (8 bit, noise 2 of 255), the same points (step 10 px) where a peer can take them, the same cameras to the last digit
(OpenCV's lens with distortion, in all). "single" is the reference and one step, "sequence" the reference and several; points a second count the
points of the displacement fields, and the time is the whole call's, the reference's own work and, for us, the search for seeds included. Strain is
in our time where a run says `+strain` (9 points), and in no peer's. All weigh all pixels alike."""
ERRORS_HOW = """Means and scatters are over points against the simulation's truth, in the system of the specimen (w and Z across its plane); the scatter is pooled over
steps, the mean is the worst step's."""
