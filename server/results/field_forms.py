"""One variable of a result in the forms that programs read: a part of the grid, as text, as bytes, as a picture."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from stereorig.core.errors import InputError
from stereorig.server.formats import csv_cells
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.results.netcdf import dataset_bytes
from stereorig.server.results.reader import FileVariable, read_point_positions

FieldForm = Literal["json", "npy", "csv", "nc", "f32", "png"]
MEDIA_TYPES: dict[FieldForm, str] = {
    "json": "application/json",
    "npy": "application/x-npy",
    "csv": "text/csv",
    "nc": "application/x-netcdf",
    "f32": "application/octet-stream",
    "png": "image/png",
}
RANGE_PATTERN = r"^[0-9]{0,6}:[0-9]{0,6}$"
_MAX_PX = 1200
_BAR_PX, _TEXT_PX, _MARGIN_PX, _TITLE_PX = 22, 130, 12, 34
_LETTER_PX, _LINE_PX = 8, 16  # of the foot
_BLANK = (255, 255, 255)


@dataclass(frozen=True)
class Part:
    """Rows and columns of the grid.

    Parameters
    ----------
    rows, cols
        ``start:stop`` as in Python, either of them left out for the grid's edge; None: all.
    stride
        Each so many-th row and column.
    """

    rows: str | None = None
    cols: str | None = None
    stride: int = 1

    def slices(self, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """Return the indices that it takes of a grid.

        Raises
        ------
        InputError
            ``range_empty``.
        """
        return self._slice("rows", self.rows, shape[0]), self._slice("cols", self.cols, shape[1])

    def _slice(self, name: str, text: str | None, size: int) -> slice:
        first, last = 0, size
        if text is not None:
            if re.fullmatch(RANGE_PATTERN, text) is None:
                raise InputError(f"{name} is {text[:40]!r}.", code="range_empty", remedy="Give start:stop, as 10:50.")
            start, _, stop = text.partition(":")
            first = int(start) if start else 0
            last = min(int(stop), size) if stop else size
        if first >= last:
            raise InputError(
                f"{name} {text} holds nothing of the grid's {size}.",
                code="range_empty",
                remedy=f"Give start:stop with start below stop and below {size}.",
            )
        return slice(first, last, self.stride)


@dataclass(frozen=True)
class FieldPart:
    """A variable over a part of the grid.

    Parameters
    ----------
    values
        (r, c) or (r, c, ...); NaN for missing values.
    rows, cols
        Indices of its rows and columns in the whole grid.
    position
        Gives (r, c) of ``x_px`` or ``y_px``: the points' positions in camera 1's reference image.
    note
        Statement about the uncertainties: under a picture, and in a file.
    frame
        Frame of the values, in a file; empty if they are the same in every frame.
    """

    name: str
    variable: FileVariable
    values: NDArray[Any]
    rows: NDArray[np.intp]
    cols: NDArray[np.intp]
    position: Callable[[str], NDArray[np.float64]]
    note: str = ""
    frame: str = ""

    @property
    def headers(self) -> dict[str, str]:
        """Headers that describe the plain bytes."""
        return {
            "X-Shape": ",".join(str(n) for n in self.values.shape),
            "X-Units": self.variable.units,
            "X-Rows": _range(self.rows),
            "X-Cols": _range(self.cols),
        }


def _range(indices: NDArray[np.intp]) -> str:
    step = int(indices[1] - indices[0]) if len(indices) > 1 else 1
    return f"{int(indices[0])}:{int(indices[-1]) + 1}:{step}"


def take(name: str, read: Callable[[str], FileVariable], part: Part, note: str = "", frame: str = "") -> FieldPart:
    """Take a part of a variable; ``note`` and ``frame`` as in :class:`FieldPart`.

    Raises
    ------
    InputError
        ``range_empty``; ``field_not_scalar`` if the variable is not over the grid.
    """
    variable = read(name)
    shape = variable.values.shape
    if variable.dimensions[:2] != ("row", "col"):
        raise InputError(
            f"{name} has the shape {list(shape)}, not one value for each point of the grid.",
            code="field_not_scalar",
            remedy="Take the result file for a variable that is not over the grid.",
        )
    rows, cols = part.slices(shape)
    return FieldPart(
        name,
        variable,
        variable.values[rows, cols],
        np.arange(shape[0])[rows],
        np.arange(shape[1])[cols],
        lambda of: read(of).values[rows, cols],
        note,
        frame,
    )


def nested(values: NDArray[Any]) -> list[Any]:
    """Return nested lists with None for NaN."""
    if np.issubdtype(values.dtype, np.floating):
        held = values.astype(object)
        held[~np.isfinite(values)] = None
        return list(held.tolist())
    return list(values.tolist())


def encode(part: FieldPart, form: FieldForm) -> bytes:
    """Return the part in one of the binary or text forms (all but JSON)."""
    if form == "npy":
        buffer = io.BytesIO()
        np.save(buffer, part.values, allow_pickle=False)
        return buffer.getvalue()
    if form == "f32":
        return np.ascontiguousarray(part.values, dtype="<f4").tobytes()
    if form == "csv":
        return _csv(part)
    if form == "nc":
        return _netcdf(part)
    if form == "png":
        return _png(part)
    raise ValueError(form)


def _csv(part: FieldPart) -> bytes:
    """One line a point: row, col, x_px, y_px, then the value or values; empty if it has none."""
    count = int(np.prod(part.values.shape[2:], dtype=int))
    flat = part.values.reshape(-1, count)
    names = [part.name] if part.values.ndim == 2 else [f"{part.name}_{k}" for k in range(count)]
    rows, cols = (grid.ravel() for grid in np.meshgrid(part.rows, part.cols, indexing="ij"))
    whole = not np.issubdtype(part.values.dtype, np.floating)
    lines = [csv_cells.row(["row", "col", "x_px", "y_px", *names]).rstrip("\n")]
    positions = (part.position(of).ravel() for of in ("x_px", "y_px"))
    for row, col, x, y, values in zip(rows, cols, *positions, flat, strict=True):
        texts = [str(int(v)) if whole else (repr(float(v)) if np.isfinite(v) else "") for v in values]
        lines.append(",".join([str(row), str(col), f"{x:g}", f"{y:g}", *texts]))
    return ("\n".join(lines) + "\n").encode()


def _netcdf(part: FieldPart) -> bytes:
    """Return a NetCDF-4 file with the variable, its indices in the grid and its positions in the image."""
    pixels = {of: part.position(of) for of in ("x_px", "y_px")}

    def fill(data: Any) -> None:
        data.setncattr("Conventions", "CF-1.8")
        for attribute, text in (("uncertainty", part.note), ("frame", part.frame)):
            if text:
                data.setncattr(attribute, text)
        for name, indices in (("row", part.rows), ("col", part.cols)):
            data.createDimension(name, len(indices))
            data.put(data.createVariable(name, "i4", (name,)), indices)
        for name, values in pixels.items():
            position = data.createVariable(name, "f8", ("row", "col"))
            data.put(position, values)
            position.units = "pixel"
        if part.name not in ("x_px", "y_px"):
            more = tuple(f"component_{k}" for k in range(part.values.ndim - 2))
            for name, size in zip(more, part.values.shape[2:], strict=True):
                data.createDimension(name, size)
            kind = {"b": "i1", "i": "i4", "u": "i4"}.get(part.values.dtype.kind, part.values.dtype.str[1:])
            missing = np.nan if kind.startswith("f") else None
            variable = data.createVariable(part.name, kind, ("row", "col", *more), fill_value=missing)
            data.put(variable, part.values)
            variable.units, variable.long_name = part.variable.units, part.variable.long_name

    return dataset_bytes(fill)


def _png(part: FieldPart) -> bytes:
    """Return a colour map with its colour bar, drawn fast; white at points without a value."""
    values = part.values.astype(float)
    if values.ndim > 2:
        raise InputError(
            f"{part.name} has more than one number a point.",
            code="field_not_scalar",
            remedy="Take another form, or one of its sigma_ variables.",
        )
    finite = np.isfinite(values)
    low, high = (float(v) for v in np.percentile(values[finite], (1.0, 99.0))) if finite.any() else (0.0, 0.0)
    span = high - low if high > low else max(abs(low), 1e-12)
    grey = np.where(finite, np.clip((values - low) / span, 0.0, 1.0) * 255.0, 0.0).astype(np.uint8)
    colours = cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)
    colours[~finite] = _BLANK
    factor = max(1, min(32, _MAX_PX // max(values.shape)))
    shrunk = max(values.shape) / _MAX_PX
    if shrunk > 1.0:
        size = (max(1, round(values.shape[1] / shrunk)), max(1, round(values.shape[0] / shrunk)))
        colours = cv2.resize(colours, size, interpolation=cv2.INTER_NEAREST)
    else:
        colours = np.repeat(np.repeat(colours, factor, 0), factor, 1)
    height, width = max(colours.shape[0], 160), max(colours.shape[1], 160)
    whole = width + 2 * _MARGIN_PX + _BAR_PX + _TEXT_PX
    foot = textwrap.wrap(part.note, (whole - 2 * _MARGIN_PX) // _LETTER_PX)
    below = _TITLE_PX + height + _MARGIN_PX
    picture = np.full((below + _LINE_PX * len(foot), whole, 3), 255, np.uint8)
    for k, line in enumerate(foot):
        _write(picture, line, _MARGIN_PX, below + _LINE_PX * k + 6, 0.4)
    picture[_TITLE_PX : _TITLE_PX + colours.shape[0], _MARGIN_PX : _MARGIN_PX + colours.shape[1]] = colours
    ramp = np.linspace(255, 0, height).astype(np.uint8)[:, None].repeat(_BAR_PX, 1)
    left = 2 * _MARGIN_PX + width
    picture[_TITLE_PX : _TITLE_PX + height, left : left + _BAR_PX] = cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS)
    title = f"{part.name} [{part.variable.units}]".encode("ascii", "replace").decode()
    _write(picture, title, _MARGIN_PX, _TITLE_PX - 12, 0.55)
    for share in np.linspace(0.0, 1.0, 5):
        y = _TITLE_PX + round((1.0 - share) * (height - 1))
        text = f"{low + share * span:.4g}" if finite.any() else "no value"
        _write(picture, text, left + _BAR_PX + 6, min(max(y + 5, _TITLE_PX + 10), _TITLE_PX + height), 0.45)
    encoded = cv2.imencode(".png", picture)[1]
    return bytes(encoded.tobytes())


def _write(picture: NDArray[np.uint8], text: str, x: int, y: int, size: float) -> None:
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 1, cv2.LINE_AA)


# Positions of a result's points in a step's own image.


def image_positions(result: Path, calibration: Path, cam: str) -> NDArray[np.float64]:
    """Project each point at its position in that step into one camera's image.

    Parameters
    ----------
    result
        Result file of the step.
    calibration
        The test's calibration.
    cam
        ``cam1`` or ``cam2``.

    Returns
    -------
    NDArray
        (rows, cols, 2) column and row in px; NaN where the point was not measured or has no image.
    """
    pair = load_calibration(calibration).pair
    positions = read_point_positions(result)
    camera = pair.cam1 if cam == "cam1" else pair.cam2
    found: NDArray[Any] = np.full((*positions.shape[:-1], 2), np.nan)
    there = np.isfinite(positions).all(axis=-1)
    if there.any():
        mapped = camera.project(positions[there])
        found[there] = np.where(mapped.valid[:, None], mapped.xy, np.nan)
    return found
