"""Displacement smoothing: noise left, its reported uncertainty, and how much of a wave is left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.smoothed import smoothed_displacement
from stereorig.core.strain import StrainOptions, surface_strain
from tests.bench.accuracy.paper_rig import load_rig
from tests.bench.accuracy.strain import SUBSET, moved_fields
from tests.bench.accuracy.table import Row, Section

WINDOWS = (0, 3, 5, 9, 15)
STATED = (5, 9)
REPEATS = 16
STRAIN_WINDOW = 9
STEP = 10.0
PERIODS_PX = np.geomspace(24.0, 1200.0, 60)


def smoothing(figures: Path) -> Section:
    """Measure every figure of the section."""
    measured = moved_fields(load_rig(), REPEATS)
    rows: list[Row] = []
    noise: dict[int, tuple[float, float]] = {}
    for window in WINDOWS:
        fields = [smoothed_displacement(f, window, subset_px=SUBSET) if window else f for f in measured]
        uvw, reported = np.array([f.uvw_mm for f in fields]), np.array([f.sigma_mm[..., 3:] for f in fields])
        ratio, scatter = _compared(uvw, reported)
        noise[window] = 1e3 * float(scatter.max()), float(ratio.mean())
        if window not in STATED:
            continue
        smooth = fields[0].smoothing
        assert smooth is not None
        head = f"{window} points, {smooth.resolution_px:g} px wide"
        rows.append(Row(f"{head}: noise of w left, of {noise[0][0]:.3g} um", noise[window][0], "um"))
        rows.append(
            Row(
                f"{head}: reported over empirical sd of u, v, w, departure from 1, worst component",
                100.0 * float(np.abs(ratio - 1.0).max()),
                "%",
                5.0,
            )
        )
        strains = [surface_strain(f, StrainOptions(window=STRAIN_WINDOW), subset_px=SUBSET) for f in fields]
        ratio, scatter = _compared(np.array([s.strain for s in strains]), np.array([s.sigma for s in strains]))
        rows.append(
            Row(
                f"{head}, strain over {STRAIN_WINDOW} points, gauge {strains[0].gauge_px:g} px: noise of exx",
                1e6 * float(scatter[0]),
                "ue",
            )
        )
        rows.append(
            Row(
                f"{head}, strain: reported over empirical sd, departure from 1, worst component",
                100.0 * float(np.abs(ratio - 1.0).max()),
                "%",
                5.0,
            )
        )
    left = {window: _left_of_waves(measured[0], window) for window in WINDOWS if window}
    for window in STATED:
        last = int(np.flatnonzero(left[window] < 0.9)[-1])  # shorter waves may come back, upside down
        period = float(np.interp(0.9, left[window][last : last + 2], PERIODS_PX[last : last + 2]))
        rows.append(Row(f"{window} points: period of a wave of which nine tenths are left", period, "px"))
    _plot(figures / "accuracy_smoothing.png", noise, left)
    return Section(
        "Displacement smoothing",
        f"Repeated noisy pictures of a plane on the paper's rig, noise 2, {SUBSET} px subsets, step 10 px; a quadratic over the "
        "window, edges included. Waves: exact displacements along rows in the middle of the field, without pictures; the subset's own "
        "share in what is lost comes on top. Off by default; `measure --smooth`.",
        rows,
        [("accuracy_smoothing.png", "Noise left, and amplitude left of a wave, against window and period")],
        [
            "Neighbours whose subsets overlap have much of their noise in common: smoothing over less than a subset gains little."
        ],
    )


def _compared(values: Float, reported: Float) -> tuple[Float, Float]:
    """Reported over empirical sd, and the empirical sd, by component, rms over the points that all repeats have."""
    ok = np.isfinite(values).all(axis=(0, -1))
    scatter = np.sqrt(np.mean(np.var(values[:, ok], axis=0, ddof=1), axis=0))
    return np.asarray(np.sqrt(np.mean(reported[:, ok] ** 2, axis=(0, 1))) / scatter), np.asarray(scatter)


def _left_of_waves(field: Field, window: int) -> Float:
    """Amplitude left of waves along the rows, in the middle of the field."""
    out = []
    row, col = (n // 2 for n in field.shape)
    ok = field.valid
    for period in PERIODS_PX:
        wave = np.cos(2.0 * np.pi * (field.x_px - field.x_px[row, col]) / period)
        uvw = np.where(ok[..., None], np.stack([wave] * 3, axis=-1), np.nan)
        smooth = smoothed_displacement(replace(field, uvw_mm=uvw), window, subset_px=SUBSET)
        assert smooth.uvw_mm is not None
        out.append(smooth.uvw_mm[row, col, 0])
    return np.array(out)


def _plot(path: Path, noise: dict[int, tuple[float, float]], left: dict[int, Float]) -> None:
    fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    axes[0].plot([max(w, 1) for w in noise], [n for n, _ in noise.values()], "o-")
    axes[0].set(xlabel="window / points (1: none)", ylabel="noise of w / um", ylim=(0.0, None))
    for window, amplitude in left.items():
        axes[1].semilogx(PERIODS_PX, amplitude, label=f"{window} points")
    axes[1].axhline(0.9, color="k", lw=0.6, ls=":")
    axes[1].set(xlabel="period / px", ylabel="amplitude left")
    axes[1].legend(fontsize=8)
    fig.savefig(path, dpi=110)
    plt.close(fig)
