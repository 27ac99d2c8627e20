"""The axes of a field's numbers in a figure: where X and Y point in the picture."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from stereorig.core.arrays import Float

_LONG_PT, _MIDDLE_PT = 14.0, 27.0
COLOURS = {"X": "#c0392b", "Y": "#1e8449", "Z": "#1f5fa8"}
Directions = tuple[tuple[float, float], tuple[float, float]]


def directions_of(x_px: Float, y_px: Float, x_mm: Float, y_mm: Float) -> Directions | None:
    """Return the image directions (right, down) of X and Y, the longer of length 1; None if there are too few points.

    Parameters
    ----------
    x_px, y_px
        (r, c) in camera 1's reference image.
    x_mm, y_mm
        (r, c) reference positions, NaN for missing points.
    """
    along = _px_per_mm(x_px, y_px, x_mm, y_mm)
    if along is None:
        return None
    along = along / np.linalg.norm(along, axis=1).max()
    return (float(along[0, 0]), float(along[0, 1])), (float(along[1, 0]), float(along[1, 1]))


def scale_of_image(x_px: Float, y_px: Float, x_mm: Float, y_mm: Float) -> float | None:
    """Return image px per millimetre of the surface, along its rows; None if there are too few points."""
    along = _px_per_mm(x_px, y_px, x_mm, y_mm)
    if along is None:
        return None
    length_mm = float(np.linalg.norm(np.linalg.solve(along.T, np.array([1.0, 0.0]))))
    return 1.0 / length_mm if length_mm > 0.0 else None


def _px_per_mm(x_px: Float, y_px: Float, x_mm: Float, y_mm: Float) -> Float | None:
    """Return (2, 2) steps in the image, right and down, for a millimetre along X and along Y."""
    known = np.isfinite(x_mm) & np.isfinite(y_mm)
    mm = np.stack([x_mm[known], y_mm[known]], axis=-1).astype(np.float64)
    px = np.stack([x_px[known], y_px[known]], axis=-1).astype(np.float64)
    if len(mm) < 3:
        return None
    arm = mm - mm.mean(axis=0)
    if np.linalg.matrix_rank(arm, tol=1e-9 * float(np.abs(arm).max())) < 2:
        return None
    return np.asarray(np.linalg.lstsq(arm, px - px.mean(axis=0), rcond=None)[0])


def draw_axes(axis: Any, directions: Directions) -> list[Any]:
    """Draw X, Y and Z into the lower left corner of a map whose rows run downwards; return the artists."""
    drawn = []
    corner = {"xycoords": "axes fraction", "textcoords": "offset points"}
    (xx, xy), (yx, yy) = directions
    middle = (_MIDDLE_PT, _MIDDLE_PT)
    away = xx * yy - xy * yx > 0.0  # X to the right and Y down: Z points into the picture
    ring = {"boxstyle": "circle,pad=2.6", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
    text = functools.partial(axis.annotate, xy=(0, 0), ha="center", va="center", fontsize=7, zorder=5, **corner)
    drawn.append(text("   ", xytext=middle, bbox=ring, zorder=3))
    for name, (dx, dy) in (("X", (xx, xy)), ("Y", (yx, yy))):
        tip = (_MIDDLE_PT + _LONG_PT * dx, _MIDDLE_PT - _LONG_PT * dy)
        size = max(float(np.hypot(dx, dy)), 1e-9)
        beside = (tip[0] + 5.0 * dx / size, tip[1] - 5.0 * dy / size)
        drawn += [text(name, xytext=beside, color=COLOURS[name]), _line(axis, middle, tip, COLOURS[name])]
    drawn.append(text("\u2297" if away else "\u2299", xytext=middle, color=COLOURS["Z"]))
    aside = (_MIDDLE_PT - 5.5 * (xx + yx), _MIDDLE_PT + 5.5 * (xy + yy))
    drawn.append(text("Z", xytext=aside, fontsize=6, color=COLOURS["Z"]))
    return drawn


def draw_scale(axis: Any, px_per_mm: float) -> list[Any]:
    """Draw a bar of a round length into the lower right corner of a map; return the artists."""
    left, right = sorted(axis.get_xlim())
    bottom, top = sorted(axis.get_ylim(), reverse=True)
    room_mm = 0.3 * (right - left) / px_per_mm
    decade = 10.0 ** np.floor(np.log10(room_mm))
    length_mm = float(max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= room_mm))
    width, end = length_mm * px_per_mm, right - 0.03 * (right - left)
    at = bottom - 0.035 * (bottom - top)
    white = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "boxstyle": "square,pad=0.15"}
    text = axis.text(
        end - 0.5 * width,
        at - 0.012 * (bottom - top),
        f"{length_mm:g} mm",
        ha="center",
        va="bottom",
        fontsize=7,
        bbox=white,
        zorder=4,
    )
    halo, bar = (
        Line2D([end - width, end], [at, at], color=colour, linewidth=thick, solid_capstyle="butt", zorder=zorder)
        for colour, thick, zorder in (("white", 5.0, 4), ("black", 2.2, 5))
    )
    axis.add_artist(halo)
    axis.add_artist(bar)
    return [halo, text, bar]


def _line(axis: Any, begin: tuple[float, float], end: tuple[float, float], colour: str) -> Any:
    """Draw a line between two positions, points from the axes' lower left corner."""
    inch = np.array([begin, end]) / 72.0
    place = axis.figure.dpi_scale_trans + ScaledTranslation(0.0, 0.0, axis.transAxes)
    return axis.add_artist(Line2D(inch[:, 0], inch[:, 1], color=colour, linewidth=1.3, transform=place, zorder=4))
