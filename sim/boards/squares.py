"""Textures of checkerboards and ChArUco boards.

Ink of squares and markers is piecewise constant on a lattice. Under a Gaussian it is, exactly, the sum of the cells
weighted with the Gaussian's share in each, of which only those next to the point count.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.sim.boards.pattern import (
    BEHIND,
    BOARD,
    FAR_MM,
    INK,
    PAPER,
    REACH_SD,
    ROOT_HALF,
    check_margin,
    plate_share,
    soft_step,
)
from stereorig.sim.texture import Texture


@dataclass(frozen=True, kw_only=True)
class SquaresTexture(Texture):
    """Print of a checkerboard or ChArUco board, in the flat form that the kernels take.

    Attributes
    ----------
    squares, markers
        See :class:`stereorig.sim.boards.squares.Squares`.
    """

    squares: NDArray[np.int64]
    markers: NDArray[np.int64]

    def paint(self, s_mm: Float, t_mm: Float, out: Float) -> None:
        """Write the brightness of material points into ``out`` (n,); NaN points leave their element as it is."""
        _squares(self.parameters, self.nodes_mm, self.squares, self.markers, s_mm, t_mm, out)


def squares_board(
    squares: Squares,
    *,
    pitch_mm: float,
    errors_mm: Float,
    margin_mm: float,
    marker_mm: float = 0.0,
    edge_mm: float | None = None,
) -> SquaresTexture:
    """Return a checkerboard or a ChArUco board.

    Parameters
    ----------
    squares
        Its squares and markers.
    pitch_mm
        Side of a square.
    errors_mm
        (rows, columns, 2) displacement of each inner corner by the maker; between corners it is bilinear, so that the
        edges run straight from corner to corner.
    margin_mm
        White about the outermost squares.
    marker_mm
        Side of a marker; 0: there are none.
    edge_mm
        Softness of the edges (sd of the Gaussian); by default a 150th of the pitch, less for fine markers.
    """
    rows, columns = errors_mm.shape[:2]
    cell = marker_mm / squares.markers.shape[1] if marker_mm else pitch_mm
    edge = min(pitch_mm / 150.0, cell / 13.0) if edge_mm is None else edge_mm
    if not 0.0 < edge <= cell / (2.0 * REACH_SD):
        raise ValueError(f"edge_mm must lie in (0, {cell / (2.0 * REACH_SD):g}], got {edge:g}")
    check_margin(margin_mm)
    half = (0.5 * (columns + 1) * pitch_mm + margin_mm, 0.5 * (rows + 1) * pitch_mm + margin_mm)
    worst = float(np.abs(errors_mm).max())
    par = np.array([pitch_mm, edge, INK, PAPER, BEHIND, *half, marker_mm, worst])
    return SquaresTexture(
        kind=BOARD,
        parameters=par,
        nodes_mm=np.ascontiguousarray(errors_mm),
        finest_mm=edge,
        squares=squares.squares,
        markers=squares.markers,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _error_at(errors: Float, column: float, row: float) -> tuple[float, float]:
    """Displacement at a place in units of corners, bilinear between them and constant beyond."""
    n_j, n_i = errors.shape[:2]
    u, v = min(max(column, 0.0), n_i - 1.0), min(max(row, 0.0), n_j - 1.0)
    i, j = min(int(u), n_i - 2), min(int(v), n_j - 2)
    a, b = u - i, v - j
    w00, w10, w01, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    return (
        w00 * errors[j, i, 0] + w10 * errors[j, i + 1, 0] + w01 * errors[j + 1, i, 0] + w11 * errors[j + 1, i + 1, 0],
        w00 * errors[j, i, 1] + w10 * errors[j, i + 1, 1] + w01 * errors[j + 1, i, 1] + w11 * errors[j + 1, i + 1, 1],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _black(squares: NDArray[np.int64], i: int, j: int) -> float:
    inside = 0 <= j < squares.shape[0] and 0 <= i < squares.shape[1]
    return 1.0 if inside and squares[j, i] == -2 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _cell(markers: NDArray[np.int64], n: int, i: int, j: int) -> float:
    inside = 0 <= j < markers.shape[1] and 0 <= i < markers.shape[2]
    return 1.0 if inside and markers[n, j, i] == 1 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(at: float, near: float, sd: float) -> tuple[int, float]:
    """Return the first of the two cells at a place in units of cells, and the share of the second, 0 far from edges."""
    edge = np.floor(at + 0.5)
    off = at - edge
    if abs(off) < near:
        return int(edge) - 1, soft_step(off, ROOT_HALF / sd)
    return int(np.floor(at)), 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _marker_ink(markers: NDArray[np.int64], n: int, x: float, y: float, sd: float) -> float:
    """Ink of marker n at a place in units of its cells."""
    near = REACH_SD * sd
    m = markers.shape[1]
    if x < -near or y < -near or x > m + near or y > m + near:
        return 0.0
    i, wx = _nearest(x, near, sd)
    j, wy = _nearest(y, near, sd)
    if wx == 0.0 and wy == 0.0:
        return _cell(markers, n, i, j)
    top = (1.0 - wx) * _cell(markers, n, i, j) + wx * _cell(markers, n, i + 1, j)
    low = (1.0 - wx) * _cell(markers, n, i, j + 1) + wx * _cell(markers, n, i + 1, j + 1)
    return (1.0 - wy) * top + wy * low


@njit(cache=True, nogil=True, error_model="numpy")
def _squares(
    par: Float, errors: Float, squares: NDArray[np.int64], markers: NDArray[np.int64], s: Float, t: Float, out: Float
) -> None:
    per_mm, sd = 1.0 / par[0], par[1] / par[0]
    ink, paper, behind = par[2], par[3], par[4]
    n_j, n_i = squares.shape
    centre_a, centre_b = 0.5 * n_i, 0.5 * n_j
    near = REACH_SD * sd
    far = near + par[8] * per_mm  # from the nominal edge no point beyond is touched by the true one
    m = markers.shape[1]
    scale = par[0] * m / par[7] if par[7] > 0.0 else 0.0
    for k in range(s.size):
        sk, tk = s[k], t[k]
        if not (abs(sk) < FAR_MM and abs(tk) < FAR_MM):
            continue
        plate = plate_share(par, sk, tk)
        if plate == 0.0:
            out[k] = behind
            continue
        a, b = sk * per_mm + centre_a, tk * per_mm + centre_b
        if scale == 0.0 and abs(a - np.floor(a + 0.5)) > far and abs(b - np.floor(b + 0.5)) > far:
            v = _black(squares, int(np.floor(a)), int(np.floor(b)))
            out[k] = behind + (paper + (ink - paper) * v - behind) * plate
            continue
        if par[8] > 0.0:
            # the exact material point that the maker printed here: a fixed point, as errors are small against the pitch
            ex, ey = _error_at(errors, a - 1.0, b - 1.0)
            ex, ey = _error_at(errors, a - 1.0 - ex * per_mm, b - 1.0 - ey * per_mm)
            a -= ex * per_mm
            b -= ey * per_mm
        i, wx = _nearest(a, near, sd)
        j, wy = _nearest(b, near, sd)
        if wx == 0.0 and wy == 0.0:
            v = _black(squares, i, j)
        else:
            top = (1.0 - wx) * _black(squares, i, j) + wx * _black(squares, i + 1, j)
            low = (1.0 - wx) * _black(squares, i, j + 1) + wx * _black(squares, i + 1, j + 1)
            v = (1.0 - wy) * top + wy * low
        if scale > 0.0:
            ci, cj = int(np.floor(a)), int(np.floor(b))
            if 0 <= cj < n_j and 0 <= ci < n_i and squares[cj, ci] >= 0:
                x, y = 0.5 * m + (a - ci - 0.5) * scale, 0.5 * m + (b - cj - 0.5) * scale
                v += _marker_ink(markers, squares[cj, ci], x, y, sd * scale)
        v = paper + (ink - paper) * v
        out[k] = behind + (v - behind) * plate


# Squares and markers of a printed checkerboard or ChArUco board: which cells of its plane are black.

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
