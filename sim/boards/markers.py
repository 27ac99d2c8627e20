"""Squares and markers of a printed checkerboard or ChArUco board: which cells of its plane are black."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

WHITE, BLACK, FIRST_MARKER = -1, -2, 0


@dataclass(frozen=True)
class Squares:
    """Cells of a board.

    Attributes
    ----------
    squares
        (rows + 1, columns + 1) ``WHITE``, ``BLACK``, or the number of the marker in a white square.
    markers
        (n, m, m) cells of the markers with their black borders, 1 is black; m is 1 without markers.
    """

    squares: NDArray[np.int64]
    markers: NDArray[np.int64]


def checkerboard_squares(size: tuple[int, int]) -> Squares:
    """Squares about ``size = (columns, rows)`` inner corners; the first is black."""
    row, column = np.indices((size[1] + 1, size[0] + 1))
    squares = np.where((row + column) % 2 == 0, BLACK, WHITE)
    return Squares(squares.astype(np.int64), np.zeros((1, 1, 1), dtype=np.int64))


def charuco_squares(size: tuple[int, int], dictionary: str) -> Squares:
    """Squares of OpenCV's ``CharucoBoard((columns + 1, rows + 1), ...)``: markers numbered along the rows.

    Raises
    ------
    ValueError
        There is no such dictionary, or it has fewer markers than the board has white squares.
    """
    code = getattr(cv2.aruco, dictionary, None) if dictionary.startswith("DICT_") else None
    if not isinstance(code, int):
        raise ValueError(f"OpenCV has no dictionary {dictionary!r} of markers")
    book = cv2.aruco.getPredefinedDictionary(code)
    squares = checkerboard_squares(size).squares
    white = squares == WHITE
    n = int(white.sum())
    if n > len(book.bytesList):
        raise ValueError(f"{dictionary} has {len(book.bytesList)} markers, the board needs {n}")
    squares[white] = FIRST_MARKER + np.arange(n)
    side = book.markerSize + 2
    markers = np.stack([cv2.aruco.generateImageMarker(book, k, side, borderBits=1) < 128 for k in range(n)])
    return Squares(squares, markers.astype(np.int64))
