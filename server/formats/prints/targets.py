"""Every kind of calibration target as a drawing, and the ``target.toml`` beside it."""

from __future__ import annotations

from dataclasses import fields, replace

import cv2
import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.boards.board import BoardTarget, dictionary_id
from stereorig.core.target import LINE_GRID, GridTarget, invalid
from stereorig.server.formats.prints.drawing import Discs, PrintedPage
from stereorig.server.formats.prints.page import laid_out

#: standard uncertainty of a print's scale until its rulers are measured: printers and paper change it by thousandths
UNMEASURED_SCALE_SIGMA = 5e-3
_DOT_SHARE = 0.5  # of the pitch, for a dot whose diameter is not stated


def target_drawing(
    target: GridTarget | BoardTarget, *, paper: str = "A4", margin_mm: float = 10.0, marks: bool = False
) -> PrintedPage:
    """Draw a target.

    Parameters
    ----------
    target
        Its description.
    paper, margin_mm
        See :func:`stereorig.server.formats.prints.page.laid_out`.
    marks
        Three dots of a grid in rows and columns are rings, which show the directions of its axes.

    Raises
    ------
    InputError
        ``print_page``, ``print_too_large``.
    TargetError
        ``target_invalid``, if the dictionary has too few markers, or the target no dots to be marks.
    """
    if marks and not (isinstance(target, BoardTarget) and target.kind == "circles"):
        raise invalid("only dots in rows and columns (kind = 'circles') have marks")
    rectangles, discs = np.zeros((0, 4)), []
    if isinstance(target, GridTarget):
        rectangles = _lines(target)
    elif target.kind in ("circles", "circles_asymmetric"):
        discs = _dots(target, marks)
    else:
        rectangles = _squares(target)
    low, high = _bounds(rectangles, discs)
    extent = (float(high[0] - low[0]), float(high[1] - low[1]))
    drawing, middle = laid_out(extent, paper, margin_mm, target.pitch_mm, title_of(target))
    to = middle - 0.5 * (low + high)
    if len(rectangles):
        drawing.rectangles.append(rectangles + np.tile(to, 2))
    drawing.discs += [Discs(one.centres + to, one.diameter_mm, one.white) for one in discs]
    return drawing


def title_of(target: GridTarget | BoardTarget) -> str:
    """Return a target in a few words."""
    if isinstance(target, GridTarget):
        return f"line grid, {target.lines[0]} x {target.lines[1]} lines, pitch {target.pitch_mm:.6g} mm"
    of = f", markers {target.marker_mm:.6g} mm of {target.dictionary}" if target.kind == "charuco" else ""
    points = "dots" if target.kind.startswith("circles") else "inner corners"
    kind = target.kind.replace("_", " ")
    return f"{kind}, {target.size[0]} x {target.size[1]} {points}, pitch {target.pitch_mm:.6g} mm{of}"


def dot_mm(target: BoardTarget) -> float:
    """Return the diameter of a dot: the one described, else half of the pitch."""
    return _DOT_SHARE * target.pitch_mm if target.dot_diameter_mm is None else target.dot_diameter_mm


def _bounds(rectangles: Float, discs: list[Discs]) -> tuple[Float, Float]:
    corners = [rectangles[:, :2], rectangles[:, 2:]]
    for one in discs:
        corners += [one.centres - 0.5 * one.diameter_mm, one.centres + 0.5 * one.diameter_mm]
    points = np.concatenate(corners)
    return points.min(axis=0), points.max(axis=0)


def _lines(target: GridTarget) -> Float:
    half = 0.5 * target.line_width_mm
    x, y = (target.pitch_mm * np.asarray(own, dtype=np.float64) for own in target.present_lines)
    if target.dark_lines:
        ends = np.array([x[0] - half, y[0] - half, x[-1] + half, y[-1] + half])
        down = [[at - half, ends[1], at + half, ends[3]] for at in x]
        return np.array(down + [[ends[0], at - half, ends[2], at + half] for at in y])
    # bright lines are what the black between and about them leaves
    (left, right), (top, bottom) = (_between(own, half, target.pitch_mm) for own in (x, y))
    inner = [[left[i], top[j], right[i], bottom[j]] for i in range(1, len(x)) for j in range(1, len(y))]
    within = [left[0], x[0] - half, right[-1], y[-1] + half]
    frame = [
        [left[0], top[0], right[-1], within[1]],
        [left[0], within[3], right[-1], bottom[-1]],
        [left[0], within[1], x[0] - half, within[3]],
        [x[-1] + half, within[1], right[-1], within[3]],
    ]
    return np.array(frame + inner)


def _between(at: Float, half: float, pitch: float) -> tuple[Float, Float]:
    """Where the gaps about lines begin and end, the outermost a pitch wide."""
    return np.concatenate([[at[0] - pitch], at + half]), np.concatenate([at - half, [at[-1] + pitch]])


def _dots(target: BoardTarget, marks: bool) -> list[Discs]:
    points = target.points_mm()
    dots = [Discs(points.reshape(-1, 2), dot_mm(target))]
    if marks:
        columns, rows = target.size
        i, j = max(columns // 4, int(columns > 3)), max(rows // 4, int(rows > 3))
        at = ([i, columns - 1 - i, i], [j, j, rows - 1 - j])
        dots.append(Discs(points[at], 0.5 * dot_mm(target), white=True))
    return dots


def _squares(target: BoardTarget) -> Float:
    """Black squares of a checkerboard, the first one black; of a ChArUco board also the markers in the white ones."""
    row, column = np.indices((target.size[1] + 1, target.size[0] + 1))
    black = (row + column) % 2 == 0
    parts = [_runs(black, np.zeros(2), target.pitch_mm)]
    if target.kind == "charuco" and target.marker_mm is not None:
        book = cv2.aruco.getPredefinedDictionary(dictionary_id(target.dictionary))
        white = np.argwhere(~black)
        if len(white) > len(book.bytesList):
            raise invalid(f"{target.dictionary} has {len(book.bytesList)} markers, the board needs {len(white)}")
        side = book.markerSize + 2
        rim = 0.5 * (target.pitch_mm - target.marker_mm)
        for k, (j, i) in enumerate(white):
            cells = cv2.aruco.generateImageMarker(book, k, side, borderBits=1) < 128
            corner = target.pitch_mm * np.array([i, j], dtype=np.float64) + rim
            parts.append(_runs(cells, corner, target.marker_mm / side))
    return np.concatenate(parts)


def _runs(cells: Bool, corner: Float, side: float) -> Float:
    """Rectangles of the true cells, neighbours in a row joined."""
    padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1)))
    steps = np.diff(padded, axis=1)
    row, first = np.nonzero(steps == 1)
    last = np.nonzero(steps == -1)[1]
    corners = np.stack([first, row, last, row + 1], axis=-1).astype(np.float64)
    return np.asarray(corners * side + np.tile(corner, 2))


def target_text(target: GridTarget | BoardTarget, *, scale: float | None = None, stretch_mm: float = 0.0) -> str:
    """Return ``target.toml`` of a printed target.

    Parameters
    ----------
    target
        Its description.
    scale
        Measured scale of the print, which the description has already; None: not measured.
    stretch_mm
        Part of the tolerance for directions of different scales.
    """
    kind = LINE_GRID if isinstance(target, GridTarget) else target.kind
    lines = ["[target]", f'kind = "{kind}"']
    for one in fields(target):
        value = getattr(target, one.name)
        unused = one.name == "dictionary" and kind != "charuco"
        if one.name != "kind" and not unused and value is not None and value != ((), ()):
            lines.append(f"{one.name} = {_toml(value)}")
    lines += ["", "[print]"]
    if scale is None:
        lines.append("# not measured: measure its rulers, then stereorig print measured")
    lines += [f"scale = {_toml(1.0 if scale is None else scale)}", f"stretch_mm = {_toml(stretch_mm)}"]
    return "\n".join([*lines, ""])


def unmeasured_text(target: GridTarget | BoardTarget) -> str:
    """Return ``target.toml`` of a print whose rulers are not measured yet: its scale is known as printers keep it."""
    if target.pitch_scale_sigma is None:
        target = replace(target, pitch_scale_sigma=UNMEASURED_SCALE_SIGMA)
    return target_text(target)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.9g}" if value % 1.0 else f"{value:.1f}"
    if isinstance(value, (tuple, list)):
        return f"[{', '.join(_toml(one) for one in value)}]"
    return f'"{value}"' if isinstance(value, str) else f"{value}"
