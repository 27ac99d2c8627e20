"""The kind of target that an image shows, independent of the declared one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.boards.board import BoardKind, BoardTarget
from stereorig.core.boards.corners import any_checkerboard, squares_hold_markers
from stereorig.core.boards.dot_lattice import arrange, grow
from stereorig.core.boards.dots import find_blobs
from stereorig.core.boards.pictures import FINE_SIDE_PX, Pictures
from stereorig.core.errors import TargetError
from stereorig.core.grid import lines_shown
from stereorig.core.target import GridTarget

ShownKind = Literal["line_grid", "markers"] | BoardKind

# the numbers up to 250 are the same in the larger dictionaries of a family
_DICTIONARIES = (
    "DICT_4X4_250",
    "DICT_5X5_250",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36h11",
)
_LEAST_MARKERS = 4
_LEAST_DOTS = 25
_FULL = 0.9


@dataclass(frozen=True)
class ShownTarget:
    """Target that an image shows.

    Attributes
    ----------
    kind
        ``markers``: a ChArUco board or other markers of ArUco.
    text
        Its name, with its size if that is known: "checkerboard of 9 x 6 inner corners".
    size
        Inner corners, dots or lines each way; None if they cannot be counted.
    outline_px
        (n, 2) its points.
    """

    kind: ShownKind
    text: str
    size: tuple[int, int] | None
    outline_px: Float


def declared_text(target: GridTarget | BoardTarget) -> str:
    """Return a description in words: "line grid of 11 x 11 lines"."""
    if isinstance(target, GridTarget):
        return f"line grid of {target.lines[0]} x {target.lines[1]} lines"
    size = f"{target.size[0]} x {target.size[1]}"
    return {
        "checkerboard": f"checkerboard of {size} inner corners",
        "charuco": f"ChArUco board of {size} inner corners with markers of {target.dictionary}",
        "circles": f"grid of {size} dots",
        "circles_asymmetric": f"asymmetric grid of {size} dots",
    }[target.kind]


def with_article(text: str) -> str:
    """Return a noun with its article."""
    return f"{'an' if text[0] in 'aeiou' else 'a'} {text}"


def shown_target(pictures: Pictures, *, with_lines: bool = True) -> ShownTarget | None:
    """Name the target in an image; None if no target is certain.

    Parameters
    ----------
    pictures
        The image.
    with_lines
        Look for a line grid too.
    """
    markers = _markers(pictures)
    if markers is not None:
        return markers
    dots = _dots(pictures)
    board = any_checkerboard(pictures)
    # the gaps between dots look like a few squares too
    fewer = dots is None or board is None or len(dots.outline_px) < board.shape[0] * board.shape[1]
    if board is not None and fewer and not squares_hold_markers(pictures.grey, board):
        size = board.shape[0], board.shape[1]
        text = f"checkerboard of {size[0]} x {size[1]} inner corners"
        return ShownTarget("checkerboard", text, size, board.reshape(-1, 2))
    if dots is not None:
        return dots
    return _lines(pictures) if with_lines else None


def other_target(shown: ShownTarget, target: GridTarget | BoardTarget) -> TargetError | None:
    """Return the error that names the target in an image, None if it may be the target declared."""
    declared = "line_grid" if isinstance(target, GridTarget) else "markers" if target.kind == "charuco" else target.kind
    if shown.size is None and shown.kind == "circles" and declared.startswith("circles"):
        return None  # dots whose order cannot be determined
    if shown.kind == declared and not (isinstance(target, BoardTarget) and _other_markers(shown, target)):
        return None
    return TargetError(
        f"This is {with_article(shown.text)}, declared is {with_article(declared_text(target))}.",
        code="target_other",
        remedy="Correct kind in the target's description, or use the target declared.",
        shown=shown.kind,
    )


def _other_markers(shown: ShownTarget, target: BoardTarget) -> bool:
    """Return True if the markers seen belong to another family of dictionaries than declared."""
    if shown.kind != "markers":
        return False
    family = _family(target.dictionary)
    return family in map(_family, _DICTIONARIES) and not shown.text.endswith(family)


def _family(dictionary: str) -> str:
    """Return a dictionary's name without its size: dictionaries of one family begin with the same markers."""
    return dictionary.rstrip("0123456789").rstrip("_") if dictionary[5:6] in tuple("0123456789") else dictionary


def _markers(pictures: Pictures) -> ShownTarget | None:
    picture, factor = pictures.reduced(FINE_SIDE_PX)
    best: ShownTarget | None = None
    most = _LEAST_MARKERS - 1
    for name in _DICTIONARIES:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        corners, _, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
        if len(corners) > most:
            most = len(corners)
            outline = np.concatenate([np.asarray(c, dtype=np.float64).reshape(-1, 2) for c in corners]) * factor
            text = f"ChArUco board (or markers of ArUco) with {most} markers of {_family(name)}"
            best = ShownTarget("markers", text, None, outline)
    return best


def _dots(pictures: Pictures) -> ShownTarget | None:
    picture, factor = pictures.reduced(FINE_SIDE_PX)
    best: ShownTarget | None = None
    for dark in (True, False):
        blobs = find_blobs(picture, dark=dark, block=0.05, scale=factor)
        lattice = grow(blobs.centres)
        if lattice is None or len(lattice.member) < max(_LEAST_DOTS, len(best.outline_px) + 1 if best else 0):
            continue
        outline = blobs.centres[lattice.member]
        best = ShownTarget("circles", f"grid of about {len(outline)} dots", None, outline)
        for kind, name in (("circles", "grid"), ("circles_asymmetric", "asymmetric grid")):
            laid = arrange(lattice, BoardTarget(kind=kind, size=(3, 3), pitch_mm=1.0))  # type: ignore[arg-type]
            if laid.fill >= _FULL:
                text = f"{name} of {laid.counts[0]} x {laid.counts[1]} dots"
                best = ShownTarget(kind, text, laid.counts, outline)  # type: ignore[arg-type]
                break
    return best


def _lines(pictures: Pictures) -> ShownTarget | None:
    nodes = lines_shown(pictures.grey)
    if nodes is None:
        return None
    counts = nodes.shape[0], nodes.shape[1]
    return ShownTarget("line_grid", f"line grid of {counts[0]} x {counts[1]} lines", counts, nodes.reshape(-1, 2))
