"""Pictures of the demo's measured and true fields."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.triangles import triangles_of
from stereorig.server.demo.calibration import ViewIntersections
from stereorig.server.demo.compare import MotionComparison
from stereorig.sim.plate import CircularPlate

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.patches import Rectangle
from matplotlib.tri import Triangulation

STYLE: Any = {  # rc_context wants every key spelled out in its type
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.dpi": 110,
    "savefig.bbox": "tight",
    "image.interpolation": "nearest",
}
HEIGHT = "viridis"


def upright_mm(xyz_mm: Float) -> tuple[Float, Float]:
    """Turn X_sys, Y_sys (along the grid's lines, at 45 degrees) to the directions right and down in the images."""
    half = np.sqrt(0.5)
    return half * (xyz_mm[..., 0] - xyz_mm[..., 1]), half * (xyz_mm[..., 0] + xyz_mm[..., 1])


def save(figure: Any, path: Path) -> None:
    """Write a figure and let go of it."""
    figure.savefig(path)
    plt.close(figure)


def colour_limit(values: Float) -> float:
    """Symmetric colour limit, the 99th percentile of the sizes, which single outliers do not change."""
    finite = np.abs(values[np.isfinite(values)])
    return float(np.percentile(finite, 99)) if finite.size else 1.0


def draw_map(axis: Any, result: Field, values: Float, title: str, unit: str, **options: Any) -> None:
    """Draw values (r, c) at their points' positions in camera 1's image."""
    half_x = 0.5 * (result.x_px[0, 1] - result.x_px[0, 0])
    half_y = 0.5 * (result.y_px[1, 0] - result.y_px[0, 0])
    extent = (
        result.x_px[0, 0] - half_x,
        result.x_px[0, -1] + half_x,
        result.y_px[-1, 0] + half_y,
        result.y_px[0, 0] - half_y,
    )
    drawn = axis.imshow(values, extent=extent, **options)
    _draw_cuts(axis, result)
    axis.set_title(title)
    axis.set_xticks([])
    axis.set_yticks([])
    rows, columns = values.shape
    bar = axis.figure.colorbar(drawn, ax=axis, fraction=0.046 * min(1.0, rows / columns), pad=0.03)
    bar.set_label(unit)
    bar.outline.set_visible(False)


def draw_difference(axis: Any, result: Field, values: Float, title: str, unit: str, limit: float | None = None) -> None:
    """Draw values about zero in two colours, up to ``limit``; without one, up to their own."""
    limit = colour_limit(values) if limit is None else limit
    draw_map(axis, result, values, title, unit, cmap="RdBu_r", vmin=-limit, vmax=limit)


def _draw_cuts(axis: Any, result: Field, colour: str = "black") -> None:
    """Draw cracks and the borders of holes."""
    for line in result.cuts.lines_px if result.cuts else ():
        axis.plot(line[:, 0], line[:, 1], "-", color=colour, linewidth=1.2)


def region(out: Path, image: NDArray[Any], roi_px: Sequence[float], result: Field, title: str) -> dict[str, str]:
    """Draw camera 1's reference image with the region and the points that were measured."""
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(6.4, 6.0))
        axis.imshow(image, cmap="gray")
        x0, y0, x1, y1 = roi_px
        axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color="#ffb000", linewidth=1.5))
        ok = result.valid
        axis.plot(result.x_px[ok], result.y_px[ok], ".", color="#00ffb0", markersize=3.0)
        axis.plot(result.x_px[~ok], result.y_px[~ok], "x", color="#ff4060", markersize=4.0)
        _draw_cuts(axis, result, "#ff00ff")
        axis.set_title(f"{title}: camera 1, step 0. Green: measured ({int(ok.sum())}), red: not ({int((~ok).sum())})")
        axis.set_xlabel("x, px")
        axis.set_ylabel("y, px")
        save(figure, out / "region.png")
    return {"region.png": "camera 1's reference image with the region and its points"}


def calibration(out: Path, views: Sequence[ViewIntersections]) -> dict[str, str]:
    """Draw the residuals of every view as arrows.

    Parameters
    ----------
    out
        Folder.
    views
        The residuals of each view.
    """
    if not views:
        return {}
    columns = min(4, len(views))
    rows = -(-len(views) // columns)
    scale = max(colour_limit(np.concatenate([np.ravel(v.residual_px) for v in views])), 1e-6)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(rows, columns, figsize=(3.0 * columns, 3.1 * rows), squeeze=False)
        for axis in axes.flat[len(views) :]:
            axis.set_visible(False)
        for axis, view in zip(axes.flat, views, strict=False):
            xy, residual = view.xy_px, view.residual_px
            colour = "#c04020" if view.held_out else "#2060a0"
            arrows = axis.quiver(
                xy[:, 0],
                xy[:, 1],
                residual[:, 0],
                residual[:, 1],
                angles="xy",
                scale_units="xy",
                scale=scale / 35.0,
                color=colour,
                width=0.005,
            )
            axis.invert_yaxis()
            axis.set_aspect("equal")
            axis.set_title(f"{view.title}\nRBE {view.rbe_px:.4f} px{', held out' if view.held_out else ''}")
            axis.tick_params(labelsize=7)
        figure.suptitle("Grid intersections: measured minus projected (blue fitted, red held out)", x=0.02, ha="left")
        figure.tight_layout()
        axes[0, 0].quiverkey(arrows, 0.85, 0.975, scale, f"{scale:.3f} px", coordinates="figure", labelpos="E")
        save(figure, out / "calibration_residuals.png")
    return {"calibration_residuals.png": "residuals of the calibration at every grid intersection"}


def plate(
    out: Path,
    image: NDArray[Any],
    roi_px: Sequence[float],
    fields: Sequence[Field],
    comparisons: Sequence[MotionComparison],
    pressures_kpa: Sequence[float],
    theory: CircularPlate,
    fit: Any,
) -> dict[str, str]:
    """Draw the plate's region, profiles against theory at every pressure, and maps at the highest."""
    found = region(out, image, roi_px, fields[0], "Clamped plate")
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(7.0, 5.0))
        radius = np.linspace(0.0, theory.radius_mm, 200)
        colours = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(fields)))
        for result, pressure, colour in zip(fields, pressures_kpa, colours, strict=True):
            r = np.hypot(result.xyz_mm[..., 0] - fit.centre_mm[0], result.xyz_mm[..., 1] - fit.centre_mm[1])
            axis.plot(r[result.valid], -1e3 * result.uvw_mm[result.valid, 2], ".", color=colour, markersize=1.6)  # type: ignore[index]
            axis.plot(radius, 1e3 * theory.deflection_mm(radius, pressure), "-", color="black", linewidth=0.7)
            axis.annotate(
                f"{pressure:.0f} kPa",
                (0.0, 1e3 * theory.centre_deflection_mm(pressure)),
                xytext=(-4, 0),
                textcoords="offset points",
                ha="right",
                va="center",
                fontsize=7,
            )
        axis.set_xlim(-1.6, theory.radius_mm)
        axis.set_xlabel("distance from the centre, mm")
        axis.set_ylabel("deflection towards the cameras, um")
        axis.set_title(f"Clamped plate: measured points and Eq. (18) (lines); fitted radius {fit.radius_mm:.3f} mm")
        save(figure, out / "plate_profiles.png")

        figure, axes = plt.subplots(2, 3, figsize=(11.0, 6.6))
        last, comparison = fields[-1], comparisons[-1]
        for k, name in enumerate("uvw"):
            values = 1e3 * last.uvw_mm[..., k]  # type: ignore[index]
            error = 1e3 * comparison.error_mm[..., k]
            draw_map(axes[0, k], last, values, f"{name} measured at {pressures_kpa[-1]:.0f} kPa", "um", cmap=HEIGHT)
            draw_difference(
                axes[1, k], last, error, f"{name} measured minus true, rms {np.sqrt(np.nanmean(error**2)):.2f} um", "um"
            )
        figure.tight_layout()
        save(figure, out / "plate_maps.png")

        figure, axes = plt.subplots(2, 5, figsize=(13.0, 4.8))
        low = min(1e3 * float(np.nanmin(f.uvw_mm[..., 2])) for f in fields)  # type: ignore[index]
        for axis, result, pressure in zip(axes.flat, fields, pressures_kpa, strict=False):
            draw_map(
                axis,
                result,
                1e3 * result.uvw_mm[..., 2],  # type: ignore[index]
                f"w at {pressure:.1f} kPa",
                "um",
                cmap=HEIGHT,
                vmin=low,
                vmax=0.0,
            )
        figure.tight_layout()
        save(figure, out / "plate_w.png")
    return found | {
        "plate_profiles.png": "deflection over the radius at every pressure, with Eq. (18)",
        "plate_maps.png": "u, v, w at the highest pressure, and their errors",
        "plate_w.png": "out-of-plane displacement at every pressure",
    }


def steel(
    out: Path, image: NDArray[Any], roi_px: Sequence[float], result: Field, found_um: Float, true_um: Float
) -> dict[str, str]:
    """Draw the ground steel's heights as measured and as the subset should see them."""
    pictures = region(out, image, roi_px, result, "Ground steel")
    limit = max(colour_limit(found_um), colour_limit(true_um))
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 3, figsize=(12.5, 3.4))
        draw_difference(axes[0], result, found_um, "height over the best plane, one pair", "um", limit)
        draw_difference(axes[1], result, true_um, "true surface as the subset sees it", "um", limit)
        draw_difference(axes[2], result, found_um - true_um, "difference", "um", limit)
        figure.tight_layout()
        save(figure, out / "steel_heights.png")

        figure, axis = plt.subplots(figsize=(7.0, 3.2))
        row = found_um.shape[0] // 2
        axis.plot(
            result.x_px[row], true_um[row], "-", color="black", linewidth=0.8, label="true, as the subset sees it"
        )
        axis.plot(result.x_px[row], found_um[row], ".-", color="#2060a0", linewidth=0.6, label="measured")
        axis.set_xlabel("x, px")
        axis.set_ylabel("height, um")
        axis.legend(frameon=False)
        axis.set_title(f"Ground steel: one line, y = {result.y_px[row, 0]:.0f} px")
        save(figure, out / "steel_line.png")
    return pictures | {"steel_heights.png": "height map, measured and true", "steel_line.png": "one line of it"}


def panel(
    out: Path,
    image: NDArray[Any],
    roi_px: Sequence[float],
    fields: Sequence[Field],
    comparisons: Sequence[MotionComparison],
    loads_kn: Sequence[float],
) -> dict[str, str]:
    """Draw the panel's out-of-plane displacement at every load, as in the paper's Fig. 10, and its error."""
    found = region(out, image, roi_px, fields[0], "Cracked panel")
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 2, figsize=(9.4, 6.8), layout="constrained")
        for axis, result, load, letter in zip(axes.flat, fields, loads_kn, "abcd", strict=False):
            x, y = upright_mm(result.xyz_mm)
            w = -result.uvw_mm[..., 2]  # type: ignore[index]
            surface = Triangulation(
                np.nan_to_num(x).ravel(),
                np.nan_to_num(y).ravel(),
                triangles_of(result.x_px, result.y_px, result.valid, result.cuts),
            )
            drawn = axis.tricontourf(surface, np.nan_to_num(w).ravel(), levels=14, cmap=HEIGHT)
            axis.tricontour(surface, np.nan_to_num(w).ravel(), levels=14, colors="black", linewidths=0.3)
            axis.invert_yaxis()
            axis.set_aspect("equal")
            axis.set_title(f"({letter}) {load:g} kN")
            axis.set_xlabel("along the crack, mm")
            axis.set_ylabel("along the load, mm")
            bar = figure.colorbar(drawn, ax=axis, shrink=0.85, pad=0.03)
            bar.set_label("towards the cameras, mm")
        save(figure, out / "panel_w.png")

        figure, axes = plt.subplots(2, len(fields), figsize=(3.4 * len(fields), 5.6), squeeze=False)
        for k, (result, comparison, load) in enumerate(zip(fields, comparisons, loads_kn, strict=True)):
            opening = result.uvw_mm @ np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0])
            draw_map(axes[0, k], result, opening, f"along the load, {load:g} kN", "mm", cmap=HEIGHT)
            error = 1e3 * comparison.error_mm[..., 2]
            draw_difference(
                axes[1, k], result, error, f"w minus true, rms {np.sqrt(np.nanmean(error**2)):.1f} um", "um"
            )
        figure.tight_layout()
        save(figure, out / "panel_maps.png")
    return found | {
        "panel_w.png": "out-of-plane displacement at the four loads, as the paper's Fig. 10",
        "panel_maps.png": "displacement along the load (the crack opens) and the error of w",
    }
