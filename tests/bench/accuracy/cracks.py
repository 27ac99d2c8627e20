"""Cracks drawn as lines: how near to the line, and how well, both lips are measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import Camera
from stereorig.core.cameras.lens import SeidelLens
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.region import PointGrid
from stereorig.core.measure import MeasureOptions, ReferencePair
from stereorig.sim.catalog import make_scene
from stereorig.sim.panel import CrackedPanel
from stereorig.sim.render import RenderOptions, render
from stereorig.sim.rig import SimRig
from stereorig.sim.scene import Scene
from stereorig.sim.truth import truth_at
from tests.bench.accuracy.paper_rig import ROOT
from tests.bench.accuracy.table import Row, Section

SIZE_PX, CORNER_PX = (288, 160), (112.0, 160.0)  # the whole crack and what lies above and below it
LOAD_KN = 35.6
SUBSET_PX, SPACING_PX = 21, 4
REPEATS = 16
BANDS = ((0.0, 2.0), (2.0, 5.0), (5.0, 10.5), (14.0, 40.0))
MIDDLE_MM = 30.0  # from the crack's middle: nearer to the tips, 51 mm away, its field bends within a subset


def cut_middle(camera: Camera) -> Camera:
    lens = camera.lens
    assert isinstance(lens, SeidelLens)
    return replace(camera, lens=replace(lens, cx_px=lens.cx_px - CORNER_PX[0], cy_px=lens.cy_px - CORNER_PX[1]))


def noisy(clean: list[NDArray[np.float32]], seed: int) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(seed)
    return [np.clip(np.rint(255 * i + 2 * rng.standard_normal(i.shape)), 0, 255).astype(np.uint8) for i in clean]


def distance_px(xy: Float, line: Float) -> Float:
    a, along = line[:-1], np.diff(line, axis=0)
    t = np.clip(((xy[..., None, :] - a) * along).sum(-1) / (along**2).sum(-1), 0.0, 1.0)
    return np.linalg.norm(xy[..., None, :] - a - t[..., None] * along, axis=-1).min(axis=-1)


def cracks(figures: Path) -> Section:
    """Measure the cracked panel's opening with and without its line."""
    rig = SimRig.from_toml(ROOT / "config" / "sim_panel.toml")
    pair = StereoPair(cut_middle(rig.cam1.camera), cut_middle(rig.cam2.camera))
    before, after = make_scene(rig, "panel", load=0.0), make_scene(rig, "panel", load=LOAD_KN)
    half = CrackedPanel().half_crack_mm
    along = np.linspace(-half, half, 41)
    points = before.surface.positions(np.stack([along, np.zeros(41)], axis=-1), 1.0)
    line = np.asarray(pair.cam1.project(before.sys_from_body.apply(points)).xy)
    plain = PointGrid.rectangle(20, 20, SIZE_PX[0] - 21, SIZE_PX[1] - 21, spacing_px=SPACING_PX)
    grid, options = plain.with_cracks([line]), MeasureOptions(subset_px=SUBSET_PX, patch="affine")
    clean = [rendered(rig, pair, scene) for scene in (before, after)]
    truth = truth_at(before, pair.cam1, grid.xy_px, now=after)
    away, middle = distance_px(grid.xy_px, line), np.abs(truth.st_mm[..., 0]) < MIDDLE_MM
    fields = [
        ReferencePair(pair, *noisy(clean[0], 2 * k)).motion(*noisy(clean[1], 2 * k + 1), grid, options)
        for k in range(REPEATS)
    ]
    without = ReferencePair(pair, *noisy(clean[0], 0)).motion(*noisy(clean[1], 1), plain, options)
    errors = np.stack([_moved(f) - truth.uvw_mm for f in fields])
    sigma = np.stack([f.sigma_mm[..., 3:] for f in fields])
    rows = _rows(fields, without, errors, sigma, away, middle)
    lower = grid.y_px > np.interp(grid.x_px, line[:, 0], line[:, 1])
    lips = middle & (away < 3.0) & np.isfinite(errors).all(axis=(0, -1))
    # the body hangs at 45 degrees to the system frame's axes: the opening is along the panel's y
    across = before.sys_from_body.rotation[:, 1]
    opening = np.array(
        [_mean(_moved(f) @ across, lips & lower) - _mean(_moved(f) @ across, lips & ~lower) for f in fields]
    )
    true = _mean(truth.uvw_mm @ across, lips & lower) - _mean(truth.uvw_mm @ across, lips & ~lower)
    rows += [
        Row("opening between the lips, points within 3 px of the line, true", 1e3 * abs(true), "um"),
        Row("opening: mean error over the repeats", 1e3 * abs(float(opening.mean()) - true), "um"),
        Row("opening: mean error, of the opening", 100.0 * abs(float(opening.mean()) / true - 1.0), "%", 2.0),
        Row("opening: scatter over the repeats", 1e3 * float(opening.std(ddof=1)), "um"),
    ]
    _draw(figures / "accuracy_cracks.png", grid, line, away, middle, (without, fields[0]), truth.uvw_mm, across)
    return Section(
        "Cracks drawn as lines",
        f"Cracked panel at {LOAD_KN:g} kN on its rig, true calibration, noise 2, {SUBSET_PX} px subsets, plane patches, {REPEATS} repeats. The line is "
        f"drawn where camera 1 sees the crack. Points within {MIDDLE_MM:g} mm of the crack's middle, by their distance from the line. Scatter: "
        "standard deviation over the repeats over the stated one, rms over u, v, w.",
        rows,
        [
            (
                "accuracy_cracks.png",
                "Displacement across the crack without and with the line, and error against distance",
            )
        ],
        [
            "A point at the line has half of a subset, all on one side of it: its plane is extrapolated to the point and scatters "
            "more for it. The covariance says so."
        ],
    )


def rendered(rig: SimRig, pair: StereoPair, scene: Scene) -> list[NDArray[np.float32]]:
    options = RenderOptions(blur_px=rig.blur_px, threads=2)
    return [render(scene, camera, SIZE_PX, options=options) for camera in (pair.cam1, pair.cam2)]


def _moved(field: Field) -> Float:
    assert field.uvw_mm is not None
    return field.uvw_mm


def _mean(values: Float, where: NDArray[np.bool_]) -> float:
    return float(values[where].mean())


def _rows(
    fields: list[Field], without: Field, errors: Float, sigma: Float, away: Float, middle: NDArray[np.bool_]
) -> list[Row]:
    near = middle & (away < SUBSET_PX / 2)
    rows = [
        Row(
            "valid points within half a subset of the line, without it", 100.0 * float(without.valid[near].mean()), "%"
        ),
        Row(
            "valid points within half a subset of the line, with it",
            100.0 * float(np.mean([f.valid[near].mean() for f in fields])),
            "%",
            98.0,
            at_least=True,
        ),
    ]
    for low, high in BANDS:
        where = middle & (away >= low) & (away < high) & np.isfinite(errors).all(axis=(0, -1))
        e, s = errors[:, where], sigma[:, where]
        name = f"{low:g} to {high:g} px from the line"
        in_plane, out = np.sqrt(np.mean(e[..., :2] ** 2)), np.sqrt(np.mean(e[..., 2] ** 2))
        scatter = np.sqrt(np.mean(e.var(axis=0, ddof=1) / (s**2).mean(axis=0)))
        bias = np.sqrt(np.mean(e.mean(axis=0) ** 2, axis=0))
        rows += [
            Row(f"{name}: rms error of u and v", 1e3 * float(in_plane), "um"),
            Row(f"{name}: rms error of w", 1e3 * float(out), "um"),
            Row(
                f"{name}: mean error of a point over the repeats, rms of u and v",
                1e3 * float(np.sqrt(np.mean(bias[:2] ** 2))),
                "um",
            ),
            Row(f"{name}: empirical over reported standard deviation", float(scatter), ""),
        ]
    return rows


def _draw(
    path: Path,
    grid: PointGrid,
    line: Float,
    away: Float,
    middle: NDArray[np.bool_],
    fields: tuple[Field, Field],
    true: Float,
    across: Float,
) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.3), layout="constrained", width_ratios=(1, 1, 0.9))
    shown = None
    limit = 1e3 * float(np.abs(true @ across).max())
    for axis, field, name in zip(axes, fields, ("without the line", "with the line"), strict=False):
        shown = axis.scatter(
            grid.x_px, grid.y_px, c=1e3 * _moved(field) @ across, s=6, marker="s", cmap="RdBu", vmin=-limit, vmax=limit
        )
        axis.plot(line[:, 0], line[:, 1], color="black", linewidth=0.6)
        axis.set(title=name, aspect="equal", xlabel="x, px", xlim=(15, SIZE_PX[0] - 15), ylim=(SIZE_PX[1] - 15, 15))
    assert shown is not None
    figure.colorbar(shown, ax=axes[:2], label="across the crack, um", shrink=0.8)
    for field, name, colour in zip(fields, ("without", "with the line"), ("tab:red", "tab:blue"), strict=True):
        v = field.valid & middle
        error = 1e3 * np.abs((_moved(field) - true) @ across)[v]
        axes[2].plot(away[v], error, ".", markersize=3, color=colour, label=name)
    with_line = fields[1].valid & middle
    variance = np.einsum("i,...ij,j->...", across, fields[1].covariance[..., 3:, 3:], across)
    order = np.argsort(away[with_line])
    axes[2].plot(
        away[with_line][order],
        2e3 * np.sqrt(variance[with_line][order]),
        color="black",
        linewidth=0.5,
        label="2 sigma, stated",
    )
    axes[2].set(xlabel="distance from the line, px", ylabel="error across the crack, um", xlim=(0, 40), ylim=(0, None))
    axes[2].legend(frameon=False)
    figure.savefig(path, dpi=100)
    plt.close(figure)
