"""Calibration boards other than the line grid: checkerboards, ChArUco boards and grids of dots.

Index and frame: a board has ``size = (columns, rows)`` inner corners or dots. X runs along a row, Y down the columns as
the board is printed, Z away from its viewer; the origin is the centre of the field of points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import TargetError
from stereorig.core.target import check_errors, check_pitch, check_tolerance, invalid, two_whole_numbers

BoardKind = Literal["checkerboard", "charuco", "circles", "circles_asymmetric"]
BOARD_KINDS: tuple[BoardKind, ...] = get_args(BoardKind)
DEFAULT_DICTIONARY = "DICT_5X5_100"
_MIN_SIZE, _MAX_SIZE = 3, 200


@dataclass(frozen=True, kw_only=True)
class BoardTarget:
    """Description of a calibration board.

    Attributes
    ----------
    kind
        ``checkerboard``, ``charuco``, ``circles`` (rows and columns) or ``circles_asymmetric`` (every other row shifted
        by one pitch).
    size
        (columns, rows) of inner corners, or dots a row and rows of dots.
    pitch_mm
        Side of a square, or distance of neighbouring dots; of an asymmetric grid, distance of neighbouring rows: dots
        of one row are two pitches apart.
    node_tolerance_mm
        The maker's bound on the error of a corner's or dot's position, per axis; 0 for an exact board.
    marker_mm, dictionary
        ChArUco: side of a marker, and the name of its dictionary.
    dot_diameter_mm
        Diameter of a dot; None if it is not known: it is then measured in the images.
    pitch_scale_sigma
        Relative standard deviation of the pitch as a whole; 0: exact; None: ``node_tolerance_mm`` over the size.
    flatness_mm
        Bound on the board's departure from a plane; None: as ``node_tolerance_mm``. It shows in free poses only.

    Raises
    ------
    TargetError
        Code ``target_invalid``, if a value is out of range.
    """

    kind: BoardKind
    size: tuple[int, int]
    pitch_mm: float
    node_tolerance_mm: float = 0.0
    marker_mm: float | None = None
    dictionary: str = DEFAULT_DICTIONARY
    dot_diameter_mm: float | None = None
    pitch_scale_sigma: float | None = None
    flatness_mm: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in BOARD_KINDS:
            raise invalid(f"kind must be one of {', '.join(BOARD_KINDS)}, got {self.kind!r}")
        object.__setattr__(self, "size", two_whole_numbers("size", self.size))
        if min(self.size) < _MIN_SIZE or max(self.size) > _MAX_SIZE:
            raise invalid(f"size must lie between {_MIN_SIZE} and {_MAX_SIZE} each way, got {list(self.size)}")
        check_pitch(self.pitch_mm)
        check_tolerance(self.node_tolerance_mm, self.pitch_mm)
        check_errors(self.pitch_scale_sigma, self.flatness_mm)
        if self.kind == "charuco" and (self.marker_mm is None or not 0.0 < self.marker_mm < self.pitch_mm):
            raise invalid(f"marker_mm must lie between 0 and the pitch ({self.pitch_mm:g} mm), got {self.marker_mm!r}")
        if self.dot_diameter_mm is not None and not 0.0 < self.dot_diameter_mm < self.nearest_mm:
            raise invalid(
                f"dot_diameter_mm must lie between 0 and the dots' distance ({self.nearest_mm:g} mm),"
                f" got {self.dot_diameter_mm!r}"
            )

    @property
    def nearest_mm(self) -> float:
        """Distance of the nearest two points, mm."""
        return self.pitch_mm * (float(np.sqrt(2.0)) if self.kind == "circles_asymmetric" else 1.0)

    def points_mm(self) -> Float:
        """Return the nominal positions (columns, rows, 2), X and Y in mm, Z is 0."""
        i, j = np.meshgrid(np.arange(self.size[0]), np.arange(self.size[1]), indexing="ij")
        x, y = i.astype(np.float64), j.astype(np.float64)
        if self.kind == "circles_asymmetric":
            x = 2.0 * x + (j % 2)
        points = np.stack([x, y], axis=-1) * self.pitch_mm
        low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
        return np.asarray(points - 0.5 * (low + high))


def dictionary_id(name: str) -> int:
    """Return OpenCV's number of a dictionary of markers.

    Raises
    ------
    TargetError
        Code ``target_invalid`` if OpenCV has no dictionary of that name.
    """
    value = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if not isinstance(value, int):
        raise TargetError(
            f"There is no dictionary {name!r} of markers.",
            code="target_invalid",
            remedy="Name one of OpenCV's, such as DICT_5X5_100.",
        )
    return value
