"""Measure every figure of docs/accuracy.md and write that page with its plots: ``make accuracy``.

Truth comes from the simulated rigs' formulas; pictures carry noise of 2 of 255 unless a row says noise-free.
Options: ``--only NAME[,NAME]`` measures some sections (the page is then not written), ``--write`` puts these into the
page as it is, ``--list`` names them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

from tests.bench.accuracy import adversarial as accuracy_adversarial
from tests.bench.accuracy import calibration as accuracy_calibration
from tests.bench.accuracy import cracks as accuracy_cracks
from tests.bench.accuracy import curved, gauges, matching, sequence
from tests.bench.accuracy import experiments as accuracy_experiments
from tests.bench.accuracy import large as accuracy_large
from tests.bench.accuracy import noise as accuracy_noise
from tests.bench.accuracy import prefilter as accuracy_prefilter
from tests.bench.accuracy import smoothing as accuracy_smoothing
from tests.bench.accuracy import specimen as accuracy_specimen
from tests.bench.accuracy import strain as accuracy_strain
from tests.bench.accuracy.table import Row, Section

FIGURES = Path(__file__).resolve().parents[3] / "docs" / "figures"
PAGE = Path(__file__).resolve().parents[3] / "docs" / "accuracy.md"

SECTIONS: dict[str, Callable[[Path], Section]] = {
    "calibration": accuracy_calibration.calibration,
    "aspect": accuracy_calibration.aspect,
    "plane": matching.plane,
    "translation": matching.translation,
    "strain": matching.strain,
    "rotation": matching.rotation,
    "epipolar": matching.epipolar,
    **curved.SECTIONS,
    **accuracy_strain.SECTIONS,
    **accuracy_specimen.SECTIONS,
    **gauges.SECTIONS,
    "cracks": accuracy_cracks.cracks,
    "large": accuracy_large.large_motion,
    "updates": sequence.updates,
    "adversarial": accuracy_adversarial.adversarial,
    "noise-random": accuracy_noise.random_error,
    "noise-mean": accuracy_noise.mean_error,
    "noise-model": accuracy_noise.camera_noise,
    "prefilter": accuracy_prefilter.prefilter,
    "smoothing": accuracy_smoothing.smoothing,
    "plate": accuracy_experiments.plate,
    "steel": accuracy_experiments.steel,
    "panel": accuracy_experiments.panel,
    "specimen": accuracy_experiments.specimen,
}


@dataclass
class _Page:
    lines: list[str] = field(default_factory=list)

    def add(self, section: Section) -> None:
        self.lines += [f"## {section.title}", "", section.how, "", Row.header()]
        self.lines += [row.markdown() for row in section.rows]
        self.lines.append("")
        for name, caption in section.figures:
            self.lines += [f"![{caption}](figures/{name})", ""]
        for note in section.notes:
            self.lines += [note, ""]


HEAD = """# Accuracy, measured

Every figure on this page was measured by `make accuracy`, which writes the page anew; nothing is typed in. Pictures
come from the simulated rigs (`sim/`): analytic surfaces and textures, each sub-pixel's ray solved with the surface,
no image ever warped or interpolated. The noise is 2 of 255 grey levels unless a row says noise-free (then grey levels are not
rounded either). 1 px is 33 um on the paper's rig. "At most" is what the project asks of itself.
"""


def _put_in(text: str, page: _Page) -> str:
    """The page's text with some sections measured anew; one that was not there comes before the experiments."""
    parts = ("\n" + text).split("\n## ")
    new = ("\n" + "\n".join(page.lines)).split("\n## ")[1:]
    for section in new:
        title = section.split("\n", 1)[0]
        same = [i for i, part in enumerate(parts) if part.split("\n", 1)[0] == title]
        before = [i for i, part in enumerate(parts) if part.startswith("Clamped plate")] or [len(parts)]
        section = section.rstrip() + "\n"
        if same:
            parts[same[0]] = section
        else:
            parts.insert(before[0], section)
    return "\n## ".join(parts).lstrip("\n").rstrip() + "\n"


def main() -> int:
    """Run the sections asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--list", action="store_true")
    args = parser.parse_args()
    if args.list:
        print("\n".join(SECTIONS))
        return 0
    wanted = [name for name in args.only.split(",") if name] or list(SECTIONS)
    FIGURES.mkdir(exist_ok=True)
    page = _Page([HEAD])
    missed = 0
    for name in wanted:
        start = time.perf_counter()
        section = SECTIONS[name](FIGURES)
        print(f"\n{section.title}  ({time.perf_counter() - start:.0f} s)")
        for row in section.rows:
            print("  " + row.text())
            missed += not row.met
        for note in section.notes:
            print("  " + note)
        page.add(section)
    if args.only and args.write:
        PAGE.write_text(_put_in(PAGE.read_text(), page))
        print(f"\nput into {PAGE}")
    if not args.only:
        PAGE.write_text("\n".join(page.lines).rstrip() + "\n")
        print(f"\nwrote {PAGE}")
    print(f"\n{missed} figure(s) above their limit")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
