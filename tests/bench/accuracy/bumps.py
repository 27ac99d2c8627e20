"""Bumped cameras: what the repair from speckle leaves, what it says about that, and what is not called a bump."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.errors import CalibrationError
from stereorig.core.orientation import changes_between, judge_offsets
from stereorig.core.orientation.matched import MatchedPoints
from tests.bench.accuracy.table import Row, Section
from tests.support.bumped_rig import CAM1, CAM2, SUBSET_PX, core_pair, false_strain, grid, pose_points, repaired, turned
from tests.support.independent_rig import PlainCamera

SIZES_DEG = (0.02, 0.2, 2.0)
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
OBLIQUE = (0.6, -0.64, 0.48)
POSES = (0, 1, 2)
_RAYS = 2  # a pixel's side
MOTIONS = 300


@dataclass(frozen=True)
class Bump:
    """A bump, and what its repair leaves."""

    name: str
    size_deg: float
    before_px: float
    offset_px: float
    strain: float
    between: float
    sigma: float
    squares: float


def _bump(name: str, size: float, one: PlainCamera, two: PlainCamera) -> Bump:
    repair = repaired(one, two, POSES, _RAYS)
    old, new = core_pair(CAM1, CAM2), core_pair(one, two)
    xy1 = grid().xy_px.reshape(-1, 2)
    true = pose_points(one, 0, xy1)
    xy2 = two.project(true)
    before, after = (p.epipolar_residual_px(xy1, xy2) for p in (old, repair.pair))
    found = repair.pair.triangulate(xy1, xy2).xyz_mm
    # the specimen moved rigidly by 12 mm and 3 degrees: the same points of it in both poses
    turn = np.array([[np.cos(0.05), 0.0, np.sin(0.05)], [0.0, 1.0, 0.0], [-np.sin(0.05), 0.0, np.cos(0.05)]])
    moved = true @ turn.T + np.array([5.0, -4.0, 10.0])
    found_moved = repair.pair.triangulate(one.project(moved), two.project(moved)).xyz_mm
    error = repair.change - changes_between(old, new)
    return Bump(
        name,
        size,
        float(np.sqrt(np.mean(before**2))),
        float(np.sqrt(np.mean(after**2))),
        1e6 * float(np.sqrt(np.mean(false_strain(true, found) ** 2))),
        1e6 * float(np.sqrt(np.mean(false_strain(found, found_moved) ** 2))),
        repair.consequence.strain_sigma_microstrain,
        float(error @ np.linalg.solve(repair.estimate.covariance, error)) / 5.0,
    )


def bumps(figures: Path) -> Section:
    """Measure every figure of the section."""
    made: list[Bump] = []
    for size in SIZES_DEG:
        for axis, unit in AXES.items():
            by = tuple(size * u for u in unit)
            made.append(_bump(f"camera 2 about {axis}", size, CAM1, turned(CAM2, (by[0], by[1], by[2]))))
        by = tuple(size * u for u in OBLIQUE)
        made.append(_bump("camera 1, oblique", size, turned(CAM1, (by[0], by[1], by[2])), CAM2))
    rows: list[Row] = []
    groups: dict[float, list[Bump]] = defaultdict(list)
    for bump in made:
        groups[bump.size_deg].append(bump)
    for size, group in groups.items():
        head = f"{size:g} degrees, 4 bumps, worst"
        rows += [
            Row(f"{head}: epipolar offset before", max(b.before_px for b in group), "px"),
            Row(f"{head}: epipolar offset left", max(b.offset_px for b in group), "px", 0.01),
            Row(f"{head}: false strain of shapes", max(b.strain for b in group), "ue", 20.0),
            Row(f"{head}: false strain between two poses", max(b.between for b in group), "ue", 20.0),
        ]
    rms = float(np.sqrt(np.mean([b.strain**2 for b in made])))
    rows += [
        Row("all bumps, worst: epipolar offset left", max(b.offset_px for b in made), "px", 0.01),
        Row("all bumps, rms: false strain of shapes", rms, "ue", 20.0),
        Row(
            "all bumps: standard uncertainty stated for the largest strain",
            float(np.mean([b.sigma for b in made])),
            "ue",
        ),
        Row(
            "all bumps: normalised squared error of the five numbers, mean",
            float(np.mean([b.squares for b in made])),
            "",
        ),
    ]
    rows += _with_lever() + _refused() + _false_alarms()
    _plot(figures / "accuracy_bumps.png", made)
    return Section(
        "Bumps repaired from speckle",
        "A rig apart from the program's code: 800 x 640 px, 34 degrees of view, 25 degrees between the cameras, speckle of 4 px, noise 2. "
        "A camera turns about its pinhole; three poses of a flat specimen after the bump; "
        f"`calibration repair` with subsets of {SUBSET_PX} px. False strain of shapes is that of the specimen at rest against its true "
        "shape, rms over the points of the larger principal strain; between two poses it is what a rigid motion of 12 mm and 3 degrees shows.",
        rows,
        [("accuracy_bumps.png", "Epipolar offset before and after the repair, and false strain left, by bump")],
        [
            "The strain of shapes is nearly all one scale: the vergence shows in the offsets only through terms of second order, so that it is "
            "known the worse the narrower the view is. The repair states it. A bump that shifts a pinhole along the baseline changes the scale by "
            "the shift over the baseline: nothing in the offsets shows it, and the uncertainty allows for as much as is seen across."
        ],
    )


def _with_lever() -> list[Row]:
    """A bump that changes the baseline's length, which the offsets do not show."""
    by = tuple(0.2 * u for u in OBLIQUE)
    bump = _bump("lever", 0.2, turned(CAM1, (by[0], by[1], by[2]), lever_mm=40.0), CAM2)
    head = "0.2 degrees about a point 40 mm behind the pinhole"
    return [
        Row(f"{head}: epipolar offset left", bump.offset_px, "px", 0.01),
        Row(f"{head}: false strain between two poses", bump.between, "ue", 20.0),
        Row(f"{head}: false strain of shapes", bump.strain, "ue"),
        Row(f"{head}: that over its standard uncertainty", bump.strain / bump.sigma, "", 3.0),
    ]


def _refused() -> list[Row]:
    lenses = {"focal length of camera 2 by 0.2 %": replace(CAM2, phd=1.002 * CAM2.phd)}
    count = 0
    for two in lenses.values():
        try:
            repaired(CAM1, two, POSES, _RAYS)
        except CalibrationError as error:
            count += error.code == "repair_structure"
    return [Row(f"{', '.join(lenses)}: refused", 100.0 * count / len(lenses), "%", 100.0, at_least=True)]


def _false_alarms() -> list[Row]:
    """Judge steps in which nothing moved: noise of 0.01 px a point, another one each time."""
    rng = np.random.default_rng(6)
    xy1 = grid().xy_px.reshape(-1, 2)[::3]
    true = pose_points(CAM1, 0, xy1)
    xy2 = CAM2.project(true)
    pair = core_pair(CAM1, CAM2)

    def noisy() -> MatchedPoints:
        return MatchedPoints.of(xy1, xy2 + rng.normal(0.0, 0.01, xy2.shape))

    called = 0
    for _ in range(MOTIONS):
        before = noisy()
        offsets = pair.epipolar_residual_px(before.xy1_px, before.xy2_px)
        finding = judge_offsets(pair, noisy(), before=(before, offsets), against="reference")
        called += bool(finding is not None and finding.camera_moved)
    return [Row(f"{MOTIONS} steps in which nothing moved: called a motion", float(called), "", 1.0)]


def _plot(path: Path, made: list[Bump]) -> None:
    fig, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    names = sorted({b.name for b in made})
    for i, name in enumerate(names):
        own = [b for b in made if b.name == name]
        x = [b.size_deg for b in own]
        axes[0].plot(x, [b.before_px for b in own], "s--", color=f"C{i}", ms=4)
        axes[0].plot(x, [b.offset_px for b in own], "o-", color=f"C{i}", ms=4, label=name)
        axes[1].errorbar(
            x, [b.strain for b in own], yerr=[b.sigma for b in own], fmt="o-", color=f"C{i}", ms=4, capsize=2
        )
    axes[0].axhline(0.01, color="k", lw=0.8, ls=":")
    axes[1].axhline(20.0, color="k", lw=0.8, ls=":")
    axes[0].set_ylabel("epipolar offset, rms / px (dashed: before)")
    axes[1].set_ylabel("false strain of shapes / microstrain")
    axes[0].set_yscale("log")
    for ax in axes:
        ax.set_xscale("log")
        ax.set_xlabel("bump / degrees")
    axes[0].legend(fontsize=7)
    fig.savefig(path, dpi=110)
    plt.close(fig)
