"""Pictures of strain: the plate's profiles and maps, the panel's maps about its crack."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from stereorig.core.field.points.result import Field
from stereorig.core.strain import StrainField
from stereorig.server.demo.drawing.fields import HEIGHT, STYLE, draw_difference, draw_map, save
from stereorig.server.demo.experiments.plate_strain import PlateStrain
from stereorig.server.demo.strain import MICRO
from stereorig.sim.plate import CircularPlate

_SHOWN = 5  # pressures in the profiles


def plate(
    out: Path,
    fields: Sequence[Field],
    strains: Sequence[StrainField],
    found: Sequence[PlateStrain],
    pressures_kpa: Sequence[float],
    theory: CircularPlate,
) -> dict[str, str]:
    """Draw measured and theoretical radial and hoop strain over the radius, and maps at the highest pressure."""
    names = ("radial", "hoop")
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 2, figsize=(10.6, 4.6), sharey=True, layout="constrained")
        every = max(1, len(found) // _SHOWN)
        shown = range(len(found) - 1, -1, -every)
        colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.85, len(found)))
        for k, axis in enumerate(axes):
            for i in shown:
                one, ok = found[i], strains[i].valid
                edge = ok & ~one.whole
                axis.plot(one.r_mm[edge], MICRO * one.found[k][edge], ".", color=colours[i], markersize=1.6, alpha=0.3)
                axis.plot(one.r_mm[one.whole], MICRO * one.found[k][one.whole], ".", color=colours[i], markersize=2.2)
                _theory(axis, k, theory, pressures_kpa[i], one, strains[i])
            axis.set_xlabel("distance from the centre, mm")
            axis.set_title(f"{names[k]} strain of the face")
            axis.set_xlim(-1.0, None)
        axes[0].set_ylabel("Green-Lagrange strain, microstrain")
        bending, edges, whole = (
            Line2D([], [], color="black", linewidth=0.7, linestyle="--"),
            Line2D([], [], color=colours[-1], marker=".", linestyle="", alpha=0.4),
            Line2D([], [], color=colours[-1], marker=".", linestyle=""),
        )
        line, band = Line2D([], [], color="black", linewidth=0.8), Patch(color="0.8")
        axes[1].legend(
            [whole, edges, line, band, bending],
            [
                f"measured, gauge of {strains[-1].gauge_mm:.1f} mm",
                "its window cut by the region's edge",
                "plate theory at the point",
                "+- sigma reported",
                "its bending alone",
            ],
            frameon=False,
            fontsize=7,
            loc="lower left",
        )
        save(figure, out / "plate_strain.png")

        figure, axes = plt.subplots(2, 3, figsize=(11.4, 6.8), layout="constrained")
        one, last = found[-1], fields[-1]
        for k, name in enumerate(names):
            measured = np.where(strains[-1].valid, MICRO * one.found[k], np.nan)
            true = np.where(strains[-1].valid, MICRO * one.theory[k], np.nan)
            scale = {"cmap": HEIGHT, "vmin": float(np.nanmin(true)), "vmax": float(np.nanmax(true))}
            draw_map(
                axes[k, 0], last, measured, f"{name} strain at {pressures_kpa[-1]:.0f} kPa", "microstrain", **scale
            )
            draw_map(axes[k, 1], last, true, "plate theory at the points", "microstrain", **scale)
            draw_difference(
                axes[k, 2], last, measured - true, "measured minus theory (windows are cut at the edges)", "microstrain"
            )
        save(figure, out / "plate_strain_maps.png")
    return {
        "plate_strain.png": "radial and hoop strain over the radius, with plate theory",
        "plate_strain_maps.png": "radial and hoop strain at the highest pressure, with theory",
    }


def _theory(axis: Any, k: int, theory: CircularPlate, pressure: float, one: PlateStrain, strain: StrainField) -> None:
    radius = np.linspace(0.0, float(np.nanmax(one.r_mm[strain.valid])), 200)
    value = MICRO * theory.face_strain(radius, pressure)[k]
    reported = MICRO * float(np.median(one.sigma[k][one.whole]))
    axis.fill_between(radius, value - reported, value + reported, color="0.8", linewidth=0.0, zorder=0)
    axis.plot(radius, value, "-", color="black", linewidth=0.8)
    axis.plot(radius, MICRO * theory.bending_strain(radius, pressure)[k], "--", color="black", linewidth=0.6)
    axis.annotate(
        f"{pressure:.0f} kPa",
        (0.0, value[0]),
        xytext=(-3, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=7,
    )
