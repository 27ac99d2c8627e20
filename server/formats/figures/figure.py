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

from stereorig.core.arrays import Float
from stereorig.core.field.region.cuts import Cuts
from stereorig.server.formats.figures.axes import Directions, draw_axes, draw_scale
from stereorig.server.formats.figures.colours import colour_map
from stereorig.server.formats.figures.options import FigureStyle
from stereorig.server.formats.figures.smooth import between_points

PictureForm = Literal["png", "svg"]

_MAP_SHARE = 0.84  # of the width; the rest is the colour bar
_TEXT_IN = 1.05  # height of title and notes, inch
_TALLEST = 1.6  # of the width
_SMALL, _TINY = 9.0, 6.5
_SAMPLES_PER_PX = 1.0  # of the map, between its points
_MAX_EACH = 24
_MICROMETRES_BELOW_MM = 0.1
_drawing = threading.Lock()


@dataclass(frozen=True)
class FigureData:
    """Content of a picture.

    Attributes
    ----------
    values
        (r, c) float, NaN for missing points; or integers with ``flags``.
    x_px, y_px
        (r, c) positions of the points in camera 1's reference image.
    label
        Text of the colour bar: name and meaning; the unit is added.
    units
        Unit of the values; ``1`` is a pure number.
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
        Directions of X and Y in the image; drawn into a corner.
    px_per_mm
        Scale for a bar of a round length; None: no bar.
    strain
        True: values are drawn in um/m.
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
    px_per_mm: float | None = None
    strain: bool = False


@dataclass(frozen=True)
class Scale:
    """Ends of a colour scale in the stored unit; True if values are below or above them."""

    low: float
    high: float
    below: bool = False
    above: bool = False

    @property
    def arrows(self) -> str:
        """The ends of the colour bar that get an arrow, as matplotlib names them."""
        return "both" if self.below and self.above else "min" if self.below else "max" if self.above else "neither"


def scale_of(values: NDArray[Any], style: FigureStyle) -> tuple[float, float] | None:
    """Return the ends of the colour scale; None without values and limits."""
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


def extent_of(x_px: Float, y_px: Float, *, margin: bool = True) -> tuple[float, float, float, float]:
    """Return left, right, bottom, top of a regular grid of points; with a margin of half the pitch about them."""
    half = 0.5 if margin else 0.0
    half_x, half_y = half * _pitch(x_px[0], y_px[:, 0]), half * _pitch(y_px[:, 0], x_px[0])
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


def draw(picture: FigureData, style: FigureStyle, form: PictureForm, *, compression: int | None = None) -> bytes:
    """Draw a picture; return the file's bytes, a PNG's compressed by this level (0 to 9; None: as by default)."""
    with _drawing, mpl.rc_context({"svg.fonttype": "none"}):
        figure = Drawing(picture, style).figure
        out = io.BytesIO()
        about = _metadata(picture, form)
        if compression is None:
            figure.savefig(out, format=form, metadata=about)
        else:
            figure.savefig(out, format=form, metadata=about, pil_kwargs={"compress_level": compression})
    return out.getvalue()


class Frames:
    """Pictures of one size on one scale: their common parts are laid out and drawn once.

    Parameters
    ----------
    picture
        The first one; its title and notes have at least as many lines as the others'.
    style
        Style of all pictures.
    scale
        Scale of all pictures; None: the first picture's.
    """

    def __init__(self, picture: FigureData, style: FigureStyle, scale: Scale | None = None) -> None:
        self._style = style
        with _drawing:
            self._drawing = Drawing(picture, style, scale)
            self._canvas = _canvas_of(self._drawing.figure)
            self._canvas.draw()
            self._background: Any = None

    def first(self) -> NDArray[np.uint8]:
        """Return the pixels (h, w, 3), red green blue, of the first picture; height and width are even."""
        return self._pixels()

    def next(self, picture: FigureData) -> NDArray[np.uint8]:
        """Return the pixels of another picture with the same points."""
        if picture.flags is not None:  # whose colour bar names the states that it has
            return Frames(picture, self._style).first()
        with _drawing:
            if self._background is None:
                self._drawing.figure.set_layout_engine("none")
                for artist in self._drawing.moving:
                    artist.set_animated(True)
                self._canvas.draw()
                self._background = self._canvas.copy_from_bbox(self._drawing.figure.bbox)
            self._canvas.restore_region(self._background)
            self._drawing.change(picture)
            for artist in sorted(self._drawing.moving, key=lambda one: one.get_zorder()):
                self._drawing.figure.draw_artist(artist)
            return self._pixels()

    def _pixels(self) -> NDArray[np.uint8]:
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        height, width = (n - n % 2 for n in pixels.shape[:2])
        return np.array(pixels[:height, :width])


def _metadata(picture: FigureData, form: PictureForm) -> dict[str, str]:
    texts = {"Title": picture.title, **picture.metadata}
    if form == "png":
        return texts
    # SVG takes the terms of Dublin Core alone
    known = {"Title": picture.title, "Creator": picture.metadata.get("Software", "stereorig")}
    return {**known, "Description": json.dumps(texts, ensure_ascii=False, sort_keys=True)}


class Drawing:
    """A picture as matplotlib's figure, and the parts of it that differ between the frames of a film."""

    def __init__(self, picture: FigureData, style: FigureStyle, scale: Scale | None = None) -> None:
        self._style, self._beneath = style, picture.image is not None
        width = style.width_px / style.dots_per_inch
        shape: tuple[float, float]
        if picture.image is not None:
            shape = picture.image.shape[0], picture.image.shape[1]
        else:
            left, right, bottom, top = extent_of(picture.x_px, picture.y_px)
            shape = bottom - top, right - left
        height = width * min(max(_MAP_SHARE * shape[0] / shape[1], 0.15), _TALLEST) + _TEXT_IN
        size, dpi = (width, round(height, 2)), style.dots_per_inch
        self.figure = Figure(figsize=size, dpi=dpi, layout="constrained", facecolor="white")
        axis = self.figure.add_subplot()
        if picture.image is not None:
            _draw_image(axis, picture.image, style)
        self._scale = scale or scale_to_draw(picture, style)
        self._factor, self._unit = _shown_unit(picture, self._scale)
        self._characters = max(20, int(12.5 * width))
        self._map, ticks = self._draw_map(axis, picture)
        self._empty = axis.text(0.5, 0.5, "", transform=axis.transAxes, ha="center", va="center", color="0.4", zorder=2)
        over: list[Any] = []
        for line in picture.cuts.lines_px if picture.cuts else ():
            over += axis.plot(line[:, 0], line[:, 1], "-", color="black", linewidth=1.0)
        if picture.axes is not None:
            over += draw_axes(axis, picture.axes)
        if picture.px_per_mm is not None:
            over += draw_scale(axis, picture.px_per_mm)
        axis.set_xlabel("x, px of camera 1", fontsize=_SMALL)
        axis.set_ylabel("y, px", fontsize=_SMALL)
        axis.tick_params(labelsize=_SMALL - 1)
        self._title = axis.set_title("-", fontsize=_SMALL + 1, loc="left", parse_math=False)
        arrows = "neither" if picture.flags is not None else self._scale.arrows
        bar = self.figure.colorbar(self._map, ax=axis, fraction=0.05, pad=0.02, extend=arrows)
        if ticks is not None:
            bar.set_ticks(list(range(len(ticks))), labels=ticks)
            bar.ax.minorticks_off()
        unit = "" if picture.flags is not None else f", {self._unit}"
        bar.ax.set_ylabel(_wrapped(f"{picture.label}{unit}", 60), fontsize=_SMALL - 1, parse_math=False)
        bar.ax.tick_params(labelsize=_SMALL - 1)
        bar.ax.yaxis.get_offset_text().set_fontsize(_SMALL - 1)
        self._notes: Any = None
        if picture.notes:
            place = {"x": 0.01, "ha": "left", "fontsize": _TINY, "color": "0.35"}
            self._notes = self.figure.supxlabel("-", parse_math=False, **place)
        self.moving = [self._map, self._empty, self._title, *over] + ([self._notes] if self._notes else [])
        self.change(picture)

    def change(self, picture: FigureData) -> None:
        """Show another picture's values, title and notes."""
        if picture.flags is None:
            self._map.set_data(np.ma.masked_invalid(self._between(picture)))
            self._empty.set_text("" if np.isfinite(picture.values).any() else "no values")
        self._title.set_text(_wrapped(picture.title, self._characters))
        if self._notes is not None:
            self._notes.set_text("\n".join(_wrapped(line, int(1.55 * self._characters)) for line in picture.notes))

    def _between(self, picture: FigureData) -> Float:
        values = self._factor * np.asarray(picture.values, dtype=np.float64)
        if not _has_cells(picture):
            return values
        each = int(np.ceil(_SAMPLES_PER_PX * _MAP_SHARE * self._style.width_px / values.shape[1]))
        return between_points(values, picture.x_px, picture.y_px, picture.cuts, min(max(each, 1), _MAX_EACH))

    def _draw_map(self, axis: Any, picture: FigureData) -> tuple[Any, list[str] | None]:
        opacity = self._style.opacity if self._beneath else 1.0
        smooth = picture.flags is None and _has_cells(picture)
        extent = extent_of(picture.x_px, picture.y_px, margin=not smooth)
        show = functools.partial(axis.imshow, extent=extent, interpolation="nearest", alpha=opacity)
        ticks = None
        if picture.flags is not None:
            drawn, ticks = _draw_flags(show, picture)
        else:
            colours = colour_map(self._style.colours, self._style.levels, reverse=self._style.reverse)
            low, high = (self._factor * end for end in (self._scale.low, self._scale.high))
            drawn = show(self._between(picture), cmap=colours, vmin=low, vmax=high)
        axis.set_aspect("equal")
        if picture.image is not None:
            rows, cols = picture.image.shape[:2]
            axis.set_xlim(-0.5, cols - 0.5)
            axis.set_ylim(rows - 0.5, -0.5)
        else:
            left, right, bottom, top = extent_of(picture.x_px, picture.y_px)
            axis.set_xlim(left, right)
            axis.set_ylim(bottom, top)
        return drawn, ticks


def _canvas_of(figure: Figure) -> Any:
    return FigureCanvasAgg(figure)


def _has_cells(picture: FigureData) -> bool:
    return bool(min(picture.values.shape) > 1)


def scale_to_draw(picture: FigureData, style: FigureStyle) -> Scale:
    """Return the scale of one picture, from 0 to 1 if it has no values and no limits."""
    ends = None if picture.flags is not None else scale_of(picture.values, style)
    if ends is None:
        return Scale(0.0, 1.0)
    finite = picture.values[np.isfinite(picture.values)]
    return Scale(*ends, bool((finite < ends[0]).any()), bool((finite > ends[1]).any()))


def _shown_unit(picture: FigureData, scale: Scale) -> tuple[float, str]:
    """Return the factor and the unit in which values are drawn: those that the page shows them in."""
    if picture.strain:
        return 1e6, "\u00b5m/m"
    if picture.units == "mm" and max(abs(scale.low), abs(scale.high)) < _MICROMETRES_BELOW_MM:
        return 1e3, "\u00b5m"
    return 1.0, "dimensionless" if picture.units == "1" else picture.units


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


def _draw_flags(show: Any, picture: FigureData) -> tuple[Any, list[str]]:
    flags = picture.flags or {}
    present = [value for value in flags if (picture.values == value).any()]
    values = np.full(picture.values.shape, np.nan)
    for k, value in enumerate(present):
        values[picture.values == value] = k
    palette = [mpl.colormaps["tab20"](2 * value % 20 + value // 10) for value in present]
    norm = BoundaryNorm(np.arange(len(present) + 1) - 0.5, len(present))
    return show(values, cmap=ListedColormap(palette), norm=norm), [flags[value] for value in present]
