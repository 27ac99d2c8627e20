"""Two parts in relief as the code before the work on faces measured them, and as today's does, on the same pictures.

What that code measured is kept in ``faces_before.npz``: status, positions and their standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, measure_shape
from stereorig.core.status import PointStatus
from tests.bench.accuracy.reliefs import SIZE, SPACING_PX, draw_row, placements, wedges
from tests.bench.accuracy.table import Row, Section
from tests.support.relief_rig import Body, two_cameras
from tests.support.relief_truth import Found, Measured, Part

KEPT = Path(__file__).with_suffix(".npz")
COMMIT = "b6816770"
_MOST_SIGMAS = 5.0


@dataclass(frozen=True)
class Before:
    """A field as it was kept; (r, c) and (r, c, 3) mm, system frame."""

    status: NDArray[np.int8]
    xyz_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(r, c)."""
        return np.asarray(self.status == PointStatus.OK)


@dataclass(frozen=True)
class Scene:
    """A part, where it is measured, and what its picture is called."""

    title: str
    part: Part
    grid: PointGrid
    subset_px: int
    most_sigmas: float | None


def scenes() -> dict[str, Scene]:
    """Both, by the name that their kept fields have."""
    corners = PointGrid.rectangle(28.0, 28.0, 612.0, 484.0, spacing_px=SPACING_PX)
    misfit = Part(two_cameras(SIZE, misfit_px=(0.0, 0.15)), (Body(),))
    return {
        "plate": Scene("plate with wedges", Part(two_cameras(SIZE), (wedges(),)), placements(21)[0], 21, _MOST_SIGMAS),
        "misfit": Scene("lens off in its corners", misfit, corners, 33, None),
    }


def before_and_after(figures: Path) -> Section:
    """Measure both parts and draw each beside what is kept."""
    rows: list[Row] = []
    shown: list[tuple[str, str]] = []
    with np.load(KEPT) as kept:
        for name, scene in scenes().items():
            before = Before(*(kept[f"{name}_{what}"] for what in ("status", "xyz_mm", "sigma_mm")))
            now = measure_shape(
                scene.part.pair, *scene.part.images(), scene.grid, MeasureOptions(subset_px=scene.subset_px)
            )
            both: list[tuple[Measured, Found]] = [
                (field, scene.part.beside_truth(field, scene.grid, scene.subset_px)) for field in (before, now)
            ]
            path = figures / f"accuracy_faces_before_{name}.png"
            _draw(path, both, scene.most_sigmas)
            shown.append((path.name, f"{scene.title.capitalize()}: before (above) and after (below)"))
            for when, (_, found) in zip(("before", "after"), both, strict=True):
                rows.append(Row(f"{scene.title}, {when}: found of the points on one face", 100.0 * found.share, "%"))
                rows.append(Row("the same: faces left empty", float(len(found.empty_faces)), ""))
    return Section(
        "Before and after",
        f"The same pictures, points and options, by the code before the work on faces (commit {COMMIT}) and by today's. "
        "Plate with wedges: subsets of 21 px; a lens 0.15 px off in the corners: 33 px.",
        rows,
        shown,
        [
            f"The scale of error over sigma ends at {_MOST_SIGMAS:g} for the plate. A misfit of the lens is in no point's sigma."
        ],
    )


def _draw(path: Path, both: list[tuple[Measured, Found]], most_sigmas: float | None) -> None:
    if most_sigmas is None:
        most_sigmas = max(float(np.nanmax(found.error_sigmas)) for _, found in both)
    fig, axes = plt.subplots(2, 3, figsize=(12, 6.6), layout="constrained")
    for row, when, (field, found) in zip(axes, ("before", "after"), both, strict=True):
        draw_row(fig, row, field, found, most_sigmas)
        row[0].set_title(f"{when}: status")
    fig.savefig(path, dpi=90)
    plt.close(fig)


SECTIONS = {"faces-before": before_and_after}
