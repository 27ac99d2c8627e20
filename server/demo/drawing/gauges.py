"""Pictures of gauges' readings: the crack's opening, the buckle's shape, strain about the crack, a rigid motion."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField
from stereorig.server.demo.drawing.fields import HEIGHT, STYLE, colour_limit, draw_difference, draw_map, save
from stereorig.server.demo.experiments.panel_gauges import ENDS_PX, CrackOpening, Slice
from stereorig.server.demo.experiments.panel_strain import PanelStrain
from stereorig.server.demo.experiments.steel_motion import Moved
from stereorig.server.demo.strain import MICRO

_DOTS: Any = {"fmt": ".", "markersize": 5, "elinewidth": 0.8}


def opening(out: Path, found: CrackOpening, loads_kn: Sequence[float], half_crack_mm: float) -> dict[str, str]:
    """Draw the opening along the crack and over the load, and by how much the lips part out of the plane."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 3, figsize=(13.0, 4.2), layout="constrained")
        colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.85, len(loads_kn)))
        x = found.position * half_crack_mm
        inner = np.linspace(-half_crack_mm, half_crack_mm, 201)
        for k, (load, colour) in enumerate(zip(loads_kn, colours, strict=True)):
            axes[0].errorbar(x, 1e3 * found.found[k], 1e3 * found.sigma[k], label=f"{load:g} kN", color=colour, **_DOTS)
            _true(axes[0], x, 1e3 * found.true[k], half_crack_mm)
            lens = np.max(found.lips[k]) * np.sqrt(1.0 - (inner / half_crack_mm) ** 2)  # one position is the middle
            axes[0].plot(inner, 1e3 * lens, "--", color="0.5", linewidth=0.7)
            axes[2].errorbar(x, 1e3 * found.parting[k], 1e3 * found.parting_sigma[k], color=colour, **_DOTS)
            _true(axes[2], x, 1e3 * found.parting_true[k], half_crack_mm)
        axes[0].set_ylabel("elongation over the crack, um")
        axes[0].set_title(
            f"Extensometers, ends {ENDS_PX:g} px off the crack\n(lines: true of these ends; dashed: of the lips)"
        )
        axes[0].legend(frameon=False, fontsize=7)
        axes[2].set_ylabel("out of the plane, um")
        axes[2].set_title("By how much both ends part out of the plane\n(lines: true)")
        for axis in (axes[0], axes[2]):
            axis.set_xlabel("along the crack, mm")
            axis.axvline(-half_crack_mm, color="0.7", linewidth=0.6, linestyle=":")
            axis.axvline(half_crack_mm, color="0.7", linewidth=0.6, linestyle=":")
        steps = np.array([0.0, *loads_kn])
        middle = len(x) // 2
        for i in (middle, middle + 4, len(x) - 2, len(x) - 1):
            read, sigma, true = (np.concatenate([[0.0], 1e3 * v[:, i]]) for v in (found.found, found.sigma, found.true))
            where = f"{x[i]:.0f} mm from the middle" if i != middle else "middle"
            axes[1].errorbar(steps, read, sigma, fmt="o", markersize=3, elinewidth=0.8, label=where)
            axes[1].plot(steps, true, "-", color="black", linewidth=0.7)
        axes[1].set_xlabel("load, kN")
        axes[1].set_ylabel("elongation over the crack, um")
        axes[1].set_title("The same over the load steps (lines: true)")
        axes[1].legend(frameon=False, fontsize=7)
        save(figure, out / "panel_opening.png")
    return {"panel_opening.png": "opening of the crack along it and over the load, with the true one"}


def _true(axis: Any, x: Float, y: Float, half_crack_mm: float) -> None:
    """Draw true values over the crack as a line, and those ahead of its tips as ticks."""
    over = np.abs(x) < half_crack_mm
    axis.plot(x[over], y[over], "-", color="black", linewidth=0.7)
    axis.plot(x[~over], y[~over], "_", color="black", markersize=9)


def buckle(out: Path, up: Slice, across: Slice, loads_kn: Sequence[float]) -> dict[str, str]:
    """Draw w along two lines through the buckle at every load, and its error."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            2, 2, figsize=(10.4, 6.2), height_ratios=(2.0, 1.0), sharex="col", layout="constrained"
        )
        colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.85, len(loads_kn)))
        titles = ("Along the load, through the crack's middle", "Along the crack, over the upper crest")
        for k, (line, title) in enumerate(zip((up, across), titles, strict=True)):
            order = np.argsort(line.at_mm)
            at = line.at_mm[order]
            gaps = np.flatnonzero((at[:-1] < 0.0) & (at[1:] >= 0.0) & (k == 0)) + 1
            for i, (load, colour) in enumerate(zip(loads_kn, colours, strict=True)):
                # the crack parts the line: nothing is drawn over it
                true = np.insert(line.true[i][order], gaps, np.nan)
                axes[0, k].plot(np.insert(at, gaps, 0.0), true, "-", color="black", linewidth=0.7)
                axes[0, k].plot(at, line.found[i][order], ".", color=colour, markersize=4, label=f"{load:g} kN")
                off, sd = 1e3 * (line.found[i] - line.true[i])[order], 1e3 * line.sigma[i][order]
                axes[1, k].plot(at, off, ".-", color=colour, markersize=3, linewidth=0.6)
                if i == len(loads_kn) - 1:
                    axes[1, k].fill_between(at, -sd, sd, color="0.85", linewidth=0.0, zorder=0, label="reported sigma")
            axes[0, k].set_title(f"{title} (lines: true)")
            axes[1, k].set_xlabel("along the load, mm" if k == 0 else "along the crack, mm")
        axes[0, 0].set_ylabel("w towards the cameras, mm")
        axes[1, 0].set_ylabel("measured minus true, um")
        axes[0, 1].legend(frameon=False, fontsize=7)
        axes[1, 1].legend(frameon=False, fontsize=7)
        save(figure, out / "panel_buckle.png")
    return {
        "panel_buckle.png": "shape of the buckle along two lines with the true one; plane patches flatten its crests"
    }


def strain(
    out: Path, field: Field, found: PanelStrain, measured: StrainField, load_kn: float, crack_px: Float
) -> dict[str, str]:
    """Draw strain along the load at one load about the crack, and along the column next to the crack's middle."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(11.0, 8.4), layout="constrained")
        values, read = MICRO * found.found, np.where(measured.valid, MICRO * found.read, np.nan)
        low, high = np.nanpercentile(np.concatenate([values, read]), [0.5, 99.5])
        scale = {"cmap": HEIGHT, "vmin": low, "vmax": high}
        title = f"strain along the load at {load_kn:g} kN, gauge of {measured.gauge_mm:.0f} mm"
        draw_map(axes[0, 0], field, values, title, "microstrain", **scale)
        draw_map(axes[0, 1], field, read, "true, as this gauge reads it", "microstrain", **scale)
        draw_difference(
            axes[1, 0],
            field,
            values - read,
            f"difference: rms {found.all_read.rms:.0f}, reported {found.all_read.reported:.0f}",
            "microstrain",
        )
        axis = axes[1, 1]
        middle = 0.5 * (crack_px[0] + crack_px[-1])
        column = int(np.argmin(np.abs(field.x_px[0] - middle[0])))
        y = field.y_px[:, column]
        true = MICRO * found.true[:, column]
        for side in (y < middle[1], y > middle[1]):
            axis.plot(y[side], true[side], "-", color="black", linewidth=0.8, label="true at the points")
            axis.plot(
                y[side], read[side, column], "--", color="0.4", linewidth=0.8, label="true, as the gauge reads it"
            )
        axis.errorbar(
            y,
            values[:, column],
            MICRO * found.sigma[:, column],
            fmt=".",
            color="#2060a0",
            elinewidth=0.7,
            label="measured",
        )
        axis.axvline(middle[1], color="black", linewidth=1.2)
        axis.annotate(
            "crack",
            (middle[1], 0.97),
            xycoords=("data", "axes fraction"),
            xytext=(4, 0),
            textcoords="offset points",
            va="top",
            fontsize=8,
        )
        axis.set_title(f"along the load through the crack's middle, x = {field.x_px[0, column]:.0f} px")
        axis.set_xlabel("y, px")
        axis.set_ylabel("microstrain")
        handles, labels = axis.get_legend_handles_labels()
        once = dict(zip(labels, handles, strict=True))
        axis.legend(once.values(), once.keys(), frameon=False, fontsize=7)
        save(figure, out / "panel_strain.png")
    return {"panel_strain.png": "strain along the load about the crack, which no gauge reaches over"}


def moved(out: Path, fields: Sequence[Field], strains: Sequence[StrainField], found: Sequence[Moved]) -> dict[str, str]:
    """Draw each rigid motion's w and the strain that it must not make."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(3, len(found), figsize=(4.2 * len(found), 9.0), squeeze=False, layout="constrained")
        limit = max(colour_limit(MICRO * s.strain[..., :2]) for s in strains)
        for k, (field, strain, one) in enumerate(zip(fields, strains, found, strict=True)):
            w = field.uvw_mm[..., 2]  # type: ignore[index]
            draw_map(axes[0, k], field, w, f"{one.name}: w", "mm", cmap=HEIGHT)
            for j, name in enumerate(("exx", "eyy")):
                sd = f"sd {one.false_sd[j]:.0f}, reported {one.reported[j]:.0f}"
                title = f"false {name}: mean {one.false_mean[j]:+.1f}, {sd}"
                draw_difference(axes[1 + j, k], field, MICRO * strain.strain[..., j], title, "microstrain", limit)
        save(figure, out / "steel_motion.png")
    return {"steel_motion.png": "three rigid motions, and the strain that is not there"}
