"""Measure the figures of docs/explanation/accuracy.md and write its tables and plots: ``make accuracy``.

Truth comes from the simulated rigs' formulas; images carry noise of 2 of 255 unless a row says noise-free.
Options: ``--only NAME[,NAME]`` measures some sections and writes nothing, ``--write`` puts these into their tables
nevertheless, ``--list`` names them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

from tests.bench.accuracy import adversarial as accuracy_adversarial
from tests.bench.accuracy import adversarial_reliefs as accuracy_adversarial_reliefs
from tests.bench.accuracy import blur_in_time as accuracy_blur
from tests.bench.accuracy import bumps as accuracy_bumps
from tests.bench.accuracy import calibration as accuracy_calibration
from tests.bench.accuracy import calibration_beside as accuracy_beside
from tests.bench.accuracy import (
    cards,
    curved,
    gauges,
    lenses_motions,
    line_grid_covariance,
    matching,
    real_boards,
    rig_campaign,
    sequence,
)
from tests.bench.accuracy import coverage as accuracy_coverage
from tests.bench.accuracy import cracks as accuracy_cracks
from tests.bench.accuracy import experiments as accuracy_experiments
from tests.bench.accuracy import faces_speed as accuracy_faces_speed
from tests.bench.accuracy import large as accuracy_large
from tests.bench.accuracy import models as accuracy_models
from tests.bench.accuracy import models_images as accuracy_models_images
from tests.bench.accuracy import noise as accuracy_noise
from tests.bench.accuracy import prefilter as accuracy_prefilter
from tests.bench.accuracy import reliefs as accuracy_reliefs
from tests.bench.accuracy import smoothing as accuracy_smoothing
from tests.bench.accuracy import specimen as accuracy_specimen
from tests.bench.accuracy import strain as accuracy_strain
from tests.bench.accuracy import strain_rim as accuracy_rim
from tests.bench.accuracy import targets as accuracy_targets
from tests.bench.accuracy.pages import FIGURES, write_headlines, write_section
from tests.bench.accuracy.table import Section

SECTIONS: dict[str, Callable[[Path], Section]] = {
    "calibration": accuracy_calibration.calibration,
    "aspect": accuracy_calibration.aspect,
    "lenses": lenses_motions.lenses,
    "motions": lenses_motions.motions,
    "line-grid": line_grid_covariance.line_grid,
    "beside": accuracy_beside.beside,
    "rigs": rig_campaign.rigs,
    "coverage": accuracy_coverage.coverage,
    "real-boards": real_boards.real_boards,
    **accuracy_targets.SECTIONS,
    "plane": matching.plane,
    "translation": matching.translation,
    "strain": matching.strain,
    "rotation": matching.rotation,
    "epipolar": matching.epipolar,
    **curved.SECTIONS,
    **accuracy_strain.SECTIONS,
    **accuracy_rim.SECTIONS,
    **accuracy_specimen.SECTIONS,
    **gauges.SECTIONS,
    "cards": cards.evaluations,
    **accuracy_models.SECTIONS,
    **accuracy_models_images.SECTIONS,
    "cracks": accuracy_cracks.cracks,
    "large": accuracy_large.large_motion,
    "updates": sequence.updates,
    "adversarial": accuracy_adversarial.adversarial,
    **accuracy_adversarial_reliefs.SECTIONS,
    **accuracy_reliefs.SECTIONS,
    **accuracy_faces_speed.SECTIONS,
    "noise-random": accuracy_noise.random_error,
    "noise-mean": accuracy_noise.mean_error,
    "noise-model": accuracy_noise.camera_noise,
    **accuracy_blur.SECTIONS,
    "prefilter": accuracy_prefilter.prefilter,
    "smoothing": accuracy_smoothing.smoothing,
    "bumps": accuracy_bumps.bumps,
    "plate": accuracy_experiments.plate,
    "steel": accuracy_experiments.steel,
    "panel": accuracy_experiments.panel,
    "specimen": accuracy_experiments.specimen,
}


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
    write = args.write or not args.only
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
        if write:
            print(f"  put into {write_section(name, section)}")
    if write:
        write_headlines()
    print(f"\n{missed} figure(s) above their limit")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
