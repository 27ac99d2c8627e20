"""The campaign of random rigs: ``python -m tests.bench.accuracy.rig_campaign FIRST AFTER`` prints one line a rig."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from tests.bench.accuracy.table import Row, Section
from tests.support.calibration_rigs import rms
from tests.support.random_rigs import FAULTY, SIGMAS, Answer, RandomRig, answer, random_rig

RIGS = 200
FIRST_SEED = 0


def campaign(first: int, after: int, *, show: bool = False) -> list[tuple[RandomRig, Answer]]:
    """Return rigs and answers for a range of seeds."""
    out = []
    for seed in range(first, after):
        rig = random_rig(seed)
        said = answer(rig)
        out.append((rig, said))
        if show:
            more = f" | {said.detail[:300]}" if said.outcome not in ("right", "refused") else ""
            print(f"{said.outcome} {said.ratio:.2f} {said.said} {said.model} | {rig.text}{more}", flush=True)
    return out


def rigs(figures: Path) -> Section:
    """What 200 random rigs come to."""
    runs = campaign(FIRST_SEED, FIRST_SEED + RIGS)
    sound = [(r, a) for r, a in runs if r.fault is None]
    faulty = [(r, a) for r, a in runs if r.fault is not None]
    counts = Counter(a.outcome for _, a in runs)
    ratios = [a.ratio for _, a in sound if a.outcome != "refused without a fault" and a.said == "good"]
    rows = [
        Row(
            f"rigs, {len(sound)} sound and {len(faulty)} with a fault: called good and wrong",
            counts["good and wrong"],
            "",
            0,
        ),
        Row("rigs with a fault all over the views, called good", counts["good in spite of the fault"], "", 0),
        Row("sound rigs refused", counts["refused without a fault"], "", 0),
        Row("refused or warned of for another cause", counts["wrong cause"], "", 0),
        Row("sound rigs right", sum(a.outcome == "right" for _, a in sound), f"of {len(sound)}"),
        Row(
            "sound rigs outside 3 reported sigma, warned of for the cause",
            sum(a.outcome == "warned" for _, a in sound),
            "",
        ),
        Row("sound rigs called good: true over reported shape error, rms", rms(ratios), "1"),
        Row("the same, largest", max(ratios), "1", SIGMAS),
    ]
    for fault in sorted({str(r.fault) for r, _ in faulty}):
        own = [a for r, a in faulty if r.fault == fault]
        told = Counter(
            a.said if np.isnan(a.ratio) else f"{a.said}, {'right' if a.outcome == 'right' else 'wrong'}" for a in own
        )
        text = ", ".join(f"{n} x {what}" for what, n in told.most_common())
        rows.append(Row(f"{fault} ({text}): violations", sum(a.violation for a in own), f"of {len(own)}", 0))
    fig, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
    lenses = sorted({r.lens for r, _ in sound})
    for k, lens in enumerate(lenses):
        own = [(a.ratio, a.said) for r, a in sound if r.lens == lens and np.isfinite(a.ratio)]
        for level, colour in (("good", "C0"), ("warning", "C1"), ("failed", "C3")):
            values = [v for v, said in own if said == level]
            x = k + np.linspace(-0.25, 0.25, max(len(values), 1))[: len(values)]
            ax.plot(x, values, ".", color=colour, label=level if k == 0 else None)
    ax.axhline(SIGMAS, color="k", lw=1, ls="--")
    ax.set(yscale="log", ylabel="true over reported shape error")
    ax.set_xticks(range(len(lenses)), lenses)
    ax.legend(fontsize=8)
    fig.savefig(figures / "accuracy_rigs.png", dpi=100)
    plt.close(fig)
    notes = [f"Violation: {r.text}: {a.outcome}, {a.said} ({a.ratio:.2f})." for r, a in runs if a.violation]
    notes.append(
        "Right: the shape error over the report's own points, after a rigid motion, is within 3 times the reported one. A "
        "thin prism and a fisheye are lenses that no model here has. A fault may also leave a calibration right, where the "
        "views that it spoiled are left out, or one that is not called good and whose reasons name the cause."
    )
    return Section(
        "Random rigs",
        f"{RIGS} rigs by seed: 6 to 60 degrees, 0.5 to 10 m, any lens, target and motion, noise 0.005 to 0.05 px, pinhole "
        f"distance and stand-off told with errors to 20 %, angles to 5 degrees; {100.0 * FAULTY:.0f} % with one fault.",
        rows,
        [("accuracy_rigs.png", "True over reported shape error of the sound rigs, by lens and verdict")],
        notes,
    )


if __name__ == "__main__":
    campaign(int(sys.argv[1]), int(sys.argv[2]), show=True)
