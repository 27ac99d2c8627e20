"""Strain where windows are one-sided: at the rim of the clamped plate's region, and beside the panel's crack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.core.settings import StrainOrder
from stereorig.core.strain import StrainOptions, surface_strain
from stereorig.sim.catalog import make_scene
from stereorig.sim.panel import CrackedPanel
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import Scene
from stereorig.sim.truth import truth_at
from tests.bench.accuracy import cracks
from tests.bench.accuracy.paper_rig import ROOT
from tests.bench.accuracy.table import Row, Section

MICRO = 1e6
REPEATS = 12
WINDOW = 9
PLATE_KPA, PLATE_SUBSET, PLATE_STEP, PLATE_MARGIN_PX = 689.0, 33, 10, 36
PANEL_STEP = 4
ORDERS: tuple[StrainOrder, ...] = (1, 2, "auto")
NAMES = {1: "planes", 2: "quadratics", "auto": "auto"}


@dataclass(frozen=True, eq=False)
class Case:
    """Repeated fields, their true strain (r, c, 3), and where their windows are one-sided."""

    name: str
    fields: list[Field]
    truth: Float
    where: Bool
    subset_px: int


@dataclass(frozen=True, eq=False)
class Errors:
    """Mean error (r, c, 3) of each point over the repeats, its rms, and the reported standard deviation."""

    mean: Float
    rms: Float
    reported: Float
    raised: float


def _true_strain(before: Scene, after: Scene, pair: StereoPair, xy_px: Float) -> Float:
    """Green-Lagrange strain exx, eyy, exy of a body that hangs at an angle to the system's axes, nearly flat."""
    found = truth_at(before, pair.cam1, xy_px, now=after).stretch
    e = np.stack([found[..., 0], found[..., 2], found[..., 2], found[..., 1]], axis=-1).reshape(*found.shape[:2], 2, 2)
    to_sys = before.sys_from_body.rotation[:2, :2]
    e = to_sys @ e @ to_sys.T
    return np.stack([e[..., 0, 0], e[..., 1, 1], e[..., 0, 1]], axis=-1)


def _repeated(
    pair: StereoPair, clean: Sequence[list[NDArray[np.float32]]], grid: PointGrid, options: MeasureOptions
) -> list[Field]:
    return [
        ReferencePair(pair, *cracks.noisy(clean[0], 2 * k)).motion(*cracks.noisy(clean[1], 2 * k + 1), grid, options)
        for k in range(REPEATS)
    ]


def _plate() -> Case:
    rig = SimRig.from_toml(ROOT / "config" / "sim_paper.toml")
    pair = StereoPair(rig.cam1.camera, rig.cam2.camera)
    size = rig.cam1.size_px
    before, after = (make_scene(rig, "plate", load=load) for load in (0.0, PLATE_KPA))
    options = RenderOptions(blur_px=rig.blur_px, threads=2)
    clean = [
        [render(scene, camera, size, options=options) for camera in (pair.cam1, pair.cam2)] for scene in (before, after)
    ]
    m = PLATE_MARGIN_PX
    grid = PointGrid.rectangle(m, m, size[0] - 1 - m, size[1] - 1 - m, spacing_px=PLATE_STEP)
    fields = _repeated(pair, clean, grid, MeasureOptions(subset_px=PLATE_SUBSET))
    valid = np.logical_and.reduce([f.valid for f in fields])
    whole = minimum_filter(valid, size=WINDOW, mode="constant", cval=False)
    return Case("plate's rim", fields, _true_strain(before, after, pair, grid.xy_px), valid & ~whole, PLATE_SUBSET)


def _panel() -> Case:
    rig = SimRig.from_toml(ROOT / "config" / "sim_panel.toml")
    pair = StereoPair(cracks.cut_middle(rig.cam1.camera), cracks.cut_middle(rig.cam2.camera))
    before, after = (make_scene(rig, "panel", load=load) for load in (0.0, cracks.LOAD_KN))
    half = CrackedPanel().half_crack_mm
    along = np.linspace(-half, half, 41)
    points = before.surface.positions(np.stack([along, np.zeros(41)], axis=-1), 1.0)
    line = np.asarray(pair.cam1.project(before.sys_from_body.apply(points)).xy)
    width, height = cracks.SIZE_PX
    grid = PointGrid.rectangle(20, 20, width - 21, height - 21, spacing_px=PANEL_STEP).with_cracks([line])
    clean = [cracks.rendered(rig, pair, scene) for scene in (before, after)]
    fields = _repeated(pair, clean, grid, MeasureOptions(subset_px=cracks.SUBSET_PX, patch="affine"))
    truth = truth_at(before, pair.cam1, grid.xy_px, now=after)
    away = cracks.distance_px(grid.xy_px, line)
    beside = (np.abs(truth.st_mm[..., 0]) < cracks.MIDDLE_MM) & (away < WINDOW // 2 * PANEL_STEP)
    strain = _true_strain(before, after, pair, grid.xy_px)
    return Case("crack's flanks", fields, strain, beside, cracks.SUBSET_PX)


def _errors(case: Case, order: StrainOrder) -> Errors:
    options = StrainOptions(window=WINDOW, order=order)
    found = [surface_strain(f, options, subset_px=case.subset_px) for f in case.fields]
    error = np.stack([s.strain - case.truth for s in found])
    sigma = np.stack([s.sigma for s in found])
    # in every repeat and with every order: the same points are compared
    kept = case.where & np.isfinite(error).all(axis=(0, -1))
    shown = np.where(kept[..., None], 1.0, np.nan)
    raised = [s.raised[kept].mean() for s in found if s.raised is not None]
    return Errors(
        error.mean(axis=0) * shown,
        np.sqrt((error**2).mean(axis=0)) * shown,
        np.sqrt((sigma**2).mean(axis=0)) * shown,
        float(np.mean(raised)) if raised else 0.0,
    )


def _rows(case: Case) -> tuple[list[Row], dict[StrainOrder, Errors]]:
    found = {order: _errors(case, order) for order in ORDERS}
    rows = []
    common = np.logical_and.reduce([np.isfinite(e.mean).all(axis=-1) for e in found.values()])
    for order, e in found.items():
        head = f"{case.name}, {NAMES[order]}"
        mean, reported = e.mean[common], e.reported[common]
        worst = int(np.argmax((mean**2).mean(axis=0)))
        rows += [
            Row(f"{head}: mean error of a point over the repeats, rms, worst component",
                MICRO * float(np.sqrt((mean[:, worst] ** 2).mean())), "ue"),
            Row(f"{head}: the largest", MICRO * float(np.abs(mean).max()), "ue"),
            Row(f"{head}: reported standard deviation, rms, the same component",
                MICRO * float(np.sqrt((reported[:, worst] ** 2).mean())), "ue"),
            Row(f"{head}: rms error over reported standard deviation",
                float(np.sqrt((e.rms[common] ** 2).mean() / (reported**2).mean())), "",
                1.3 if order == "auto" else None),
            Row(f"{head}: mean errors below the reported standard deviation",
                100.0 * float((np.abs(mean) < reported).mean()), "%",
                95.0 if order == "auto" else None, at_least=order == "auto"),
        ]  # fmt: skip
    rows.append(Row(f"{case.name}, auto: windows with quadratics", 100.0 * found["auto"].raised, "%"))
    return rows, found


def rim(figures: Path) -> Section:
    """Measure bias and reported uncertainty of one-sided windows."""
    rows: list[Row] = []
    fig, axes = plt.subplots(2, len(ORDERS), figsize=(11, 5.6), layout="constrained")
    for line, case in zip(axes, (_plate(), _panel()), strict=True):
        more, found = _rows(case)
        rows += more
        shown = None
        for axis, (order, e) in zip(line, found.items(), strict=True):
            shown = axis.imshow(np.abs(e.mean / e.reported).max(axis=-1), vmin=0.0, vmax=3.0, cmap="magma_r")
            axis.set_title(f"{case.name}: {NAMES[order]}", fontsize=9)
            axis.set_xticks([])
            axis.set_yticks([])
        assert shown is not None
        fig.colorbar(shown, ax=line, label="mean error over reported sd")
    fig.savefig(figures / "accuracy_strain_rim.png", dpi=110)
    plt.close(fig)
    return Section(
        "Strain at a rim and beside a crack",
        f"Green-Lagrange strain over {WINDOW} points where an edge or a crack leaves one side of the window, {REPEATS} repeats of noise 2, true "
        f"calibration. Plate: {PLATE_KPA:g} kPa, {PLATE_SUBSET} px subsets, step {PLATE_STEP} px, all windows that the rim cuts. Panel: {cracks.LOAD_KN:g} kN, "
        f"{cracks.SUBSET_PX} px subsets, step {PANEL_STEP} px, within {cracks.MIDDLE_MM:g} mm of the crack's middle, windows that the drawn line cuts. A mean over the "
        f"repeats keeps {1 / np.sqrt(REPEATS):.2f} of the noise.",
        rows,
        [("accuracy_strain_rim.png", "Mean error over the reported standard deviation, worst component; white: none")],
        [
            "Planes return the strain in the middle of the points that are left. `auto`, the default, takes quadratics where the "
            "planes' estimated error outweighs their noise, and else adds it to the uncertainty."
        ],
    )


SECTIONS = {"strain-rim": rim}
