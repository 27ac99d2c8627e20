"""The axes of a field's numbers in a figure: where X and Y point in the picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from core.arrays import Float

_LONG_PT, _MIDDLE_PT = 14.0, 27.0
_COLOURS = {"X": "#c0392b", "Y": "#1e8449"}
Directions = tuple[tuple[float, float], tuple[float, float]]


def directions_of(x_px: Float, y_px: Float, x_mm: Float, y_mm: Float) -> Directions | None:
    """Return where X and Y point in the image, right and down, the longer of length 1; None where too few points tell.

    Parameters
    ----------
    x_px, y_px
        (r, c) in camera 1's reference image.
    x_mm, y_mm
        (r, c) reference positions, NaN where there are none.
    """
    known = np.isfinite(x_mm) & np.isfinite(y_mm)
    mm = np.stack([x_mm[known], y_mm[known]], axis=-1).astype(np.float64)
    px = np.stack([x_px[known], y_px[known]], axis=-1).astype(np.float64)
    if len(mm) < 3:
        return None
    arm = mm - mm.mean(axis=0)
    if np.linalg.matrix_rank(arm, tol=1e-9 * float(np.abs(arm).max())) < 2:
        return None
    along = np.linalg.lstsq(arm, px - px.mean(axis=0), rcond=None)[0]
    along /= np.linalg.norm(along, axis=1).max()
    return (float(along[0, 0]), float(along[0, 1])), (float(along[1, 0]), float(along[1, 1]))


def draw_axes(axis: Any, directions: Directions) -> None:
    """Draw X, Y and Z into the lower left corner of a map whose rows run downwards."""
    corner = {"xycoords": "axes fraction", "textcoords": "offset points", "zorder": 5}
    (xx, xy), (yx, yy) = directions
    middle = (_MIDDLE_PT, _MIDDLE_PT)
    away = xx * yy - xy * yx > 0.0  # X to the right and Y down: Z points into the picture
    ring = {"boxstyle": "circle,pad=2.6", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
    axis.annotate("   ", (0, 0), middle, ha="center", va="center", fontsize=7, bbox=ring, **(corner | {"zorder": 3}))
    for name, (dx, dy) in (("X", (xx, xy)), ("Y", (yx, yy))):
        tip = (_MIDDLE_PT + _LONG_PT * dx, _MIDDLE_PT - _LONG_PT * dy)
        size = max(float(np.hypot(dx, dy)), 1e-9)
        text = (tip[0] + 5.0 * dx / size, tip[1] - 5.0 * dy / size)
        axis.annotate(name, (0, 0), text, ha="center", va="center", fontsize=7, color=_COLOURS[name], **corner)
        _line(axis, middle, tip, _COLOURS[name])
    sign = "\u2297" if away else "\u2299"
    axis.annotate(sign, (0, 0), middle, ha="center", va="center", fontsize=7, color="#1f5fa8", **corner)
    aside = (_MIDDLE_PT - 5.5 * (xx + yx), _MIDDLE_PT + 5.5 * (xy + yy))
    axis.annotate("Z", (0, 0), aside, ha="center", va="center", fontsize=6, color="#1f5fa8", **corner)


def _line(axis: Any, begin: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    """Draw a line between two positions, points from the axes' lower left corner."""
    inch = np.array([begin, end]) / 72.0
    place = axis.figure.dpi_scale_trans + ScaledTranslation(0.0, 0.0, axis.transAxes)
    axis.add_artist(Line2D(inch[:, 0], inch[:, 1], color=colour, linewidth=1.3, transform=place, zorder=4))
