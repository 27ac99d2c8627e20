"""The report's pictures: the cameras' images, the fields, the course of the test."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageChops

from stereorig.core.arrays import Float
from stereorig.core.field.points.result import Field
from stereorig.core.field.region.cuts import Cuts
from stereorig.core.status import PointStatus
from stereorig.core.strain import StrainField
from stereorig.server.formats.figures.axes import directions_of, scale_of_image
from stereorig.server.formats.figures.figure import FigureData, draw
from stereorig.server.formats.figures.options import FigureStyle
from stereorig.server.report.items import shown_unit

#: by name, values and their standard deviations
Lines = dict[str, tuple[Sequence[float | None], Sequence[float | None] | None]]
_HALF = FigureStyle(width_px=960, dots_per_inch=210)
_MAX_PX = 900
_LITTLE = 1  # compression of a PNG that is cropped and compressed again
_COLOURS = ("#1b4f72", "#b9770e", "#7d3c98", "#1e8449", "#a93226", "#5d6d7e", "#2e86c1", "#6e2c00")
_VALID, _INVALID = "#00d9a0", "#ff4060"


def _cropped(data: bytes) -> bytes:
    """Crop the white border of a PNG to a few pixels."""
    with Image.open(io.BytesIO(data)) as image:
        plain = image.convert("RGB")
    box = ImageChops.difference(plain, Image.new("RGB", plain.size, "white")).getbbox()
    if box is None:
        return data
    left, top, right, bottom = box
    out = io.BytesIO()
    kept = plain.crop((max(left - 8, 0), max(top - 8, 0), right + 8, bottom + 8))
    kept.save(out, format="png")
    return out.getvalue()


def unit_for(values: Float, *, strain: bool = False) -> tuple[float, str]:
    """Factor and unit in which a length (mm) or a strain reads well."""
    finite = np.abs(values[np.isfinite(values)])
    max_value = float(np.percentile(finite, 99)) if finite.size else 0.0
    return shown_unit("mm", max_value, strain=strain)


def field_map(
    field: Field, values: Float, name: str, title: str, *, strain: bool = False, unit: tuple[float, str] | None = None
) -> bytes:
    """Draw a length or strain over the points; PNG."""
    factor, units = unit or unit_for(values, strain=strain)
    shown = np.where(field.valid, factor * values, np.nan)
    places = (field.x_px, field.y_px, field.xyz_mm[..., 0], field.xyz_mm[..., 1])
    scale = scale_of_image(*places)
    axes = directions_of(*places)
    picture = FigureData(shown, field.x_px, field.y_px, name, units, title, cuts=field.cuts, axes=axes, px_per_mm=scale)
    return _cropped(draw(picture, _HALF, "png", compression=_LITTLE))


def status_map(field: Field, title: str) -> bytes:
    """Draw the state of each point; PNG."""
    names = {s.value: s.name.lower().replace("_", " ") for s in PointStatus}
    drawn = FigureData(field.status, field.x_px, field.y_px, "status", "1", title, cuts=field.cuts, flags=names)
    return _cropped(draw(drawn, _HALF, "png", compression=_LITTLE))


def strain_values(strain: StrainField, k: int) -> Float:
    """One component of a strain, NaN at points without strain."""
    return np.where(strain.valid, strain.strain[..., k], np.nan)


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=210)
    return out.getvalue()


def region(
    image: NDArray[Any],
    positions_px: Float,
    valid: NDArray[np.bool_],
    title: str,
    cuts: Cuts | None = None,
    outlines_px: Sequence[Float] = (),
) -> bytes:
    """Draw a camera's reference image with the points that were measured; PNG.

    Parameters
    ----------
    positions_px
        (n, 2) positions of the points in the image, px; NaN for points without one.
    valid
        (n,) True at measured points.
    outlines_px
        (m, 2) corners of each outline of the region that was asked for.
    """
    rows, cols = image.shape[:2]
    shrink = max(1.0, cols / _MAX_PX)
    small = (
        image
        if shrink == 1.0
        else cv2.resize(image, (round(cols / shrink), max(1, round(rows / shrink))), interpolation=cv2.INTER_AREA)
    )
    low, high = np.percentile(small, (0.5, 99.5))
    width = 4.5
    figure = Figure(figsize=(width, width * min(max(rows / cols, 0.2), 1.6) + 0.35), layout="constrained")
    axis = figure.add_subplot()
    axis.imshow(small, cmap="gray", vmin=low, vmax=max(high, low + 1.0), extent=(-0.5, cols - 0.5, rows - 0.5, -0.5))
    size = float(np.clip(80.0 / np.sqrt(max(len(positions_px), 1)), 0.5, 3.5))
    for chosen, colour in ((valid, _VALID), (~valid, _INVALID)):
        axis.plot(*positions_px[chosen].T, ".", color=colour, markersize=size, markeredgewidth=0.0)
    for outline in outlines_px:
        closed = np.concatenate([outline, outline[:1]])
        axis.plot(closed[:, 0], closed[:, 1], "-", color="#ffb000", linewidth=1.2)
    for line in cuts.lines_px if cuts else ():
        axis.plot(line[:, 0], line[:, 1], "-", color="#ff00ff", linewidth=1.0)
    axis.set_xlim(-0.5, cols - 0.5)
    axis.set_ylim(rows - 0.5, -0.5)
    axis.set_xlabel("x, px", fontsize=8)
    axis.set_ylabel("y, px", fontsize=8)
    axis.tick_params(labelsize=7)
    axis.set_title(title, fontsize=9, loc="left", parse_math=False)
    return _png(figure)


def course(
    x: Sequence[float], lines: Lines, *, x_label: str, y_label: str, title: str, as_given: bool = False
) -> bytes:
    """Draw values over the steps; SVG.

    Parameters
    ----------
    as_given
        Join the points in their order, as a load goes up and down; else by x.
    lines
        By name, the values and their standard deviations (or None), which are drawn as bars of +- 1 sd.
    """
    figure = Figure(figsize=(4.5, 2.6), layout="constrained")
    axis = figure.add_subplot()
    order = np.arange(len(x)) if as_given else np.argsort(np.asarray(x, dtype=np.float64), kind="stable")
    for k, (name, (values, sigma)) in enumerate(lines.items()):
        y = np.array([np.nan if v is None else v for v in values])[order]
        bars = None if sigma is None else np.array([np.nan if s is None else s for s in sigma])[order]
        axis.errorbar(
            np.asarray(x)[order],
            y,
            yerr=bars,
            color=_COLOURS[k % len(_COLOURS)],
            marker="o",
            markersize=3,
            linewidth=1.0,
            elinewidth=0.7,
            capsize=1.5,
            label=_plain(name),
        )
    axis.grid(visible=True, color="0.9", linewidth=0.6)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=7)
    axis.set_xlabel(_plain(x_label), fontsize=8, parse_math=False)
    axis.set_ylabel(_plain(y_label), fontsize=8, parse_math=False)
    axis.set_title(_plain(title), fontsize=9, loc="left", parse_math=False)
    if len(lines) > 1:
        legend = axis.legend(frameon=False, fontsize=7, ncols=min(len(lines), 4))
        for text in legend.get_texts():
            text.set_parse_math(False)
    out = io.BytesIO()
    with mpl.rc_context({"svg.fonttype": "path"}):
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()


def _plain(text: str) -> str:
    """Return a text as a legend takes it: printable, and no underscore in front, which would hide it."""
    return "".join(c if c.isprintable() else " " for c in text)[:60].lstrip("_") or "-"
