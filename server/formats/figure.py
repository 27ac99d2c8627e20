"""A field as a picture: a colour map over camera 1's image or alone, with its colour bar, units and origin.

Drawn without pyplot, one picture at a time: nothing here is shared with other threads.
"""

from __future__ import annotations

import functools
import io
import json
import textwrap
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from core.arrays import Float
from core.field.region.cuts import Cuts
from server.formats.figure_axes import Directions, draw_axes
from server.formats.figure_options import FigureStyle

PictureForm = Literal["png", "svg"]

MEDIA_TYPES: dict[PictureForm, str] = {"png": "image/png", "svg": "image/svg+xml"}
_MAP_SHARE = 0.84  # of the width; the rest is the colour bar
_TEXT_IN = 1.05  # height of title and notes, inch
_TALLEST = 1.6  # of the width
_SMALL, _TINY = 9.0, 6.5
_drawing = threading.Lock()


@dataclass(frozen=True)
class Picture:
    """Content of a picture.

    Attributes
    ----------
    values
        (r, c) float, NaN where there is nothing; or integers with ``flags``.
    x_px, y_px
        (r, c) where the points lie in camera 1's reference image.
    label
        Of the colour bar: name and meaning; the unit is added.
    units
        Of the values; ``1`` is a pure number.
    title
        Test, step, load.
    notes
        Lines under the map: frame, settings, calibration, version.
    metadata
        Written into the file: PNG text chunks, SVG description.
    image
        Camera 1's reference image (8 or 16 bit), drawn beneath; None: the map alone.
    cuts
        Cracks and borders of holes.
    flags
        Name of each value, for a map of states.
    axes
        Where X and Y point in the image; drawn into a corner.
    """

    values: NDArray[Any]
    x_px: Float
    y_px: Float
    label: str
    units: str
    title: str
    notes: Sequence[str] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)
    image: NDArray[Any] | None = None
    cuts: Cuts | None = None
    flags: Mapping[int, str] | None = None
    axes: Directions | None = None


def scale_of(values: NDArray[Any], style: FigureStyle) -> tuple[float, float] | None:
    """Return the ends of the colour scale; None where there are no values and no limits."""
    if style.limits is not None:
        return style.limits
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return None
    low, high = (float(v) for v in np.percentile(finite, style.percentiles))
    if low == high:  # one value: a scale about it
        half = 0.5 * max(abs(low), 1e-12)
        return low - half, high + half
    return low, high


def extent_of(x_px: Float, y_px: Float) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top of a regular grid of points, each in the middle of its cell."""
    half_x, half_y = 0.5 * _pitch(x_px[0], y_px[:, 0]), 0.5 * _pitch(y_px[:, 0], x_px[0])
    return (
        float(x_px[0, 0] - half_x),
        float(x_px[0, -1] + half_x),
        float(y_px[-1, 0] + half_y),
        float(y_px[0, 0] - half_y),
    )


def _pitch(along: Float, other: Float) -> float:
    for line in (along, other):  # one row or column alone has no pitch of its own
        if len(line) > 1:
            return float(line[1] - line[0])
    return 1.0


def draw(picture: Picture, style: FigureStyle, form: PictureForm) -> bytes:
    """Draw a picture; return the file's bytes."""
    with _drawing, mpl.rc_context({"svg.fonttype": "none"}):
        figure = _figure(picture, style)
        out = io.BytesIO()
        figure.savefig(out, format=form, metadata=_metadata(picture, form))
    return out.getvalue()


def draw_pixels(picture: Picture, style: FigureStyle) -> NDArray[np.uint8]:
    """Draw a picture; return its pixels (h, w, 3), red green blue, of even height and width."""
    with _drawing:
        canvas: Any = FigureCanvasAgg(_figure(picture, style))
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3]
        height, width = (n - n % 2 for n in pixels.shape[:2])
        return np.ascontiguousarray(pixels[:height, :width])


def _metadata(picture: Picture, form: PictureForm) -> dict[str, str]:
    texts = {"Title": picture.title, **picture.metadata}
    if form == "png":
        return texts
    # SVG takes the terms of Dublin Core alone
    known = {"Title": picture.title, "Creator": picture.metadata.get("Software", "stereorig")}
    return {**known, "Description": json.dumps(texts, ensure_ascii=False, sort_keys=True)}


def _figure(picture: Picture, style: FigureStyle) -> Figure:
    width = style.width_px / style.dots_per_inch
    shape: tuple[float, float]
    if picture.image is not None:
        shape = picture.image.shape[0], picture.image.shape[1]
    else:
        left, right, bottom, top = extent_of(picture.x_px, picture.y_px)
        shape = bottom - top, right - left
    height = width * min(max(_MAP_SHARE * shape[0] / shape[1], 0.15), _TALLEST) + _TEXT_IN
    size, dpi = (width, round(height, 2)), style.dots_per_inch
    figure = Figure(figsize=size, dpi=dpi, layout="constrained", facecolor="white")
    axis = figure.add_subplot()
    if picture.image is not None:
        _draw_image(axis, picture.image, style)
    drawn, ticks = _draw_map(axis, picture, style)
    for line in picture.cuts.lines_px if picture.cuts else ():
        axis.plot(line[:, 0], line[:, 1], "-", color="black", linewidth=1.0)
    if picture.axes is not None:
        draw_axes(axis, picture.axes)
    axis.set_xlabel("x, px of camera 1", fontsize=_SMALL)
    axis.set_ylabel("y, px", fontsize=_SMALL)
    axis.tick_params(labelsize=_SMALL - 1)
    characters = max(20, int(12.5 * width))
    axis.set_title(_wrapped(picture.title, characters), fontsize=_SMALL + 1, loc="left", parse_math=False)
    bar = figure.colorbar(drawn, ax=axis, fraction=0.05, pad=0.02, extend=_extend(picture, drawn))
    if ticks is not None:
        bar.set_ticks(list(range(len(ticks))), labels=ticks)
        bar.ax.minorticks_off()
    unit = "" if picture.flags is not None else f", {'dimensionless' if picture.units == '1' else picture.units}"
    bar.ax.set_ylabel(_wrapped(f"{picture.label}{unit}", 60), fontsize=_SMALL - 1, parse_math=False)
    bar.ax.tick_params(labelsize=_SMALL - 1)
    notes = "\n".join(_wrapped(line, int(1.55 * characters)) for line in picture.notes)
    if notes:
        figure.supxlabel(notes, x=0.01, ha="left", fontsize=_TINY, color="0.35", parse_math=False)
    return figure


def _wrapped(text: str, width: int) -> str:
    printable = "".join(c if c.isprintable() else " " for c in text)
    return "\n".join(textwrap.wrap(printable, width)[:4])


def _draw_image(axis: Any, image: NDArray[Any], style: FigureStyle) -> None:
    rows, cols = image.shape[:2]
    shrink = cols / (2.0 * style.width_px)
    if shrink > 1.0:  # the picture is not given more pixels than it can show
        size = (round(cols / shrink), max(1, round(rows / shrink)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    low, high = np.percentile(image, (0.5, 99.5))
    axis.imshow(image, cmap="gray", vmin=low, vmax=max(high, low + 1.0), extent=(-0.5, cols - 0.5, rows - 0.5, -0.5))


def _draw_map(axis: Any, picture: Picture, style: FigureStyle) -> tuple[Any, list[str] | None]:
    opacity = style.opacity if picture.image is not None else 1.0
    extent = extent_of(picture.x_px, picture.y_px)
    show = functools.partial(axis.imshow, extent=extent, interpolation="nearest", alpha=opacity)
    ticks = None
    if picture.flags is not None:
        present = [value for value in picture.flags if (picture.values == value).any()]
        values = np.full(picture.values.shape, np.nan)
        for k, value in enumerate(present):
            values[picture.values == value] = k
        ticks = [picture.flags[value] for value in present]
        palette = [mpl.colormaps["tab20"](2 * value % 20 + value // 10) for value in present]
        norm = BoundaryNorm(np.arange(len(present) + 1) - 0.5, len(present))
        drawn = show(values, cmap=ListedColormap(palette), norm=norm)
    else:
        scale = scale_of(picture.values, style)
        low, high = scale if scale is not None else (0.0, 1.0)
        drawn = show(picture.values, cmap=style.colours, vmin=low, vmax=high)
        if not np.isfinite(picture.values).any():
            axis.text(0.5, 0.5, "no values", transform=axis.transAxes, ha="center", va="center", color="0.4")
    axis.set_aspect("equal")
    if picture.image is not None:
        rows, cols = picture.image.shape[:2]
        axis.set_xlim(-0.5, cols - 0.5)
        axis.set_ylim(rows - 0.5, -0.5)
    else:
        axis.set_xlim(extent[0], extent[1])
        axis.set_ylim(extent[2], extent[3])
    return drawn, ticks


def _extend(picture: Picture, drawn: Any) -> str:
    if picture.flags is not None:
        return "neither"
    finite = picture.values[np.isfinite(picture.values)]
    below = bool((finite < drawn.norm.vmin).any())
    above = bool((finite > drawn.norm.vmax).any())
    return "both" if below and above else "min" if below else "max" if above else "neither"
