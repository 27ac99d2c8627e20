"""Textures of calibration boards: checkerboards, ChArUco boards and grids of dots.

A printed pattern is ink on a white plate of finite size. Ink of squares and markers is piecewise constant on a lattice;
softened by a Gaussian of ``edge_mm`` it is, exactly, the sum of the cells weighted with the Gaussian's share in each,
of which only those next to the point count. A dot's rim is the same edge along its radius. So the textures have no
resolution, and their finest features are known.

Material coordinates: s along a row, t down the columns as printed, origin in the centre of the field of points.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.arrays import Float
from sim.boards.markers import Squares
from sim.texture import Texture

BOARD: Final = 3
INK, PAPER, BEHIND = 0.06, 0.80, 0.25  # brightness of ink, plate and what is behind it
_REACH_SD: Final = 5.0  # a soft edge ends here, with 3e-7 left
_FAR_MM: Final = 1e9
_ROOT_HALF: Final = 0.7071067811865476
_NO_SQUARES: Final = np.zeros((1, 1), dtype=np.int64)
_NO_MARKERS: Final = np.zeros((1, 1, 1), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class BoardTexture(Texture):
    """A board's print, in the flat form that the kernels take.

    Attributes
    ----------
    squares, markers
        See :class:`sim.boards.markers.Squares`; empty for dots.
    hollow
        (rows, columns) 1 where a dot is a ring.
    round_dots
        Dots in place of squares.
    """

    squares: NDArray[np.int64]
    markers: NDArray[np.int64]
    hollow: NDArray[np.int64]
    round_dots: bool

    def paint(self, s_mm: Float, t_mm: Float, out: Float) -> None:
        """Write the brightness of material points into ``out`` (n,), which stays as it is where they are NaN."""
        if self.round_dots:
            _dots(self.parameters, self.nodes_mm, self.hollow, s_mm, t_mm, out)
        else:
            _squares(self.parameters, self.nodes_mm, self.squares, self.markers, s_mm, t_mm, out)


def field_points(kind: str, size: tuple[int, int], pitch_mm: float) -> Float:
    """Exact positions (rows, columns, 2) of a board's corners or dots, origin in the centre of the field."""
    row, column = np.indices((size[1], size[0])).astype(np.float64)
    if kind == "circles_asymmetric":
        column = 2.0 * column + row % 2.0
    points = pitch_mm * np.stack([column, row], axis=-1)
    return np.asarray(points - 0.5 * (points.min(axis=(0, 1)) + points.max(axis=(0, 1))))


def squares_board(
    squares: Squares,
    *,
    pitch_mm: float,
    errors_mm: Float,
    margin_mm: float,
    marker_mm: float = 0.0,
    edge_mm: float | None = None,
) -> BoardTexture:
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
        Softness of the edges (sd of the Gaussian); by default a 150th of the pitch, less where markers are fine.
    """
    rows, columns = errors_mm.shape[:2]
    cell = marker_mm / squares.markers.shape[1] if marker_mm else pitch_mm
    edge = min(pitch_mm / 150.0, cell / 13.0) if edge_mm is None else edge_mm
    if not 0.0 < edge <= cell / (2.0 * _REACH_SD):
        raise ValueError(f"edge_mm must lie in (0, {cell / (2.0 * _REACH_SD):g}], got {edge:g}")
    _check_margin(margin_mm)
    half = (0.5 * (columns + 1) * pitch_mm + margin_mm, 0.5 * (rows + 1) * pitch_mm + margin_mm)
    worst = float(np.abs(errors_mm).max())
    par = np.array([pitch_mm, edge, INK, PAPER, BEHIND, *half, marker_mm, worst])
    return BoardTexture(
        kind=BOARD,
        parameters=par,
        nodes_mm=np.ascontiguousarray(errors_mm),
        finest_mm=edge,
        squares=squares.squares,
        markers=squares.markers,
        hollow=_NO_SQUARES,
        round_dots=False,
    )


def dots_board(
    *,
    pitch_mm: float,
    errors_mm: Float,
    margin_mm: float,
    dot_mm: float,
    asymmetric: bool,
    marks: bool = False,
    edge_mm: float | None = None,
) -> BoardTexture:
    """Return a grid of round dots.

    Parameters
    ----------
    pitch_mm, errors_mm, margin_mm
        As of :func:`squares_board`; ``errors_mm`` moves whole dots, the margin lies about the outermost dots.
    dot_mm
        Diameter of a dot.
    asymmetric
        Rows lie a pitch apart, dots of one row two pitches, odd rows are shifted by one.
    marks
        Three dots are rings of half the inner diameter: three corners of a rectangle about the centre, which tell how
        the board is turned.
    edge_mm
        Softness of the edges (sd of the Gaussian); a 150th of the pitch by default.
    """
    rows, columns = errors_mm.shape[:2]
    edge = pitch_mm / 150.0 if edge_mm is None else edge_mm
    radius, worst = 0.5 * dot_mm, float(np.abs(errors_mm).max())
    room = pitch_mm * (_ROOT_HALF if asymmetric else 0.5)
    if not (edge > 0.0 and radius > 2.0 * _REACH_SD * edge and radius + _REACH_SD * edge + worst < room):
        raise ValueError(f"dots of {dot_mm:g} mm with edges of {edge:g} mm do not fit a pitch of {pitch_mm:g} mm")
    _check_margin(margin_mm)
    wide = 2 * columns - 1 if asymmetric else columns - 1
    half = (0.5 * wide * pitch_mm + radius + margin_mm, 0.5 * (rows - 1) * pitch_mm + radius + margin_mm)
    hollow = np.zeros((rows, columns), dtype=np.int64)
    if marks:
        i, j = max(columns // 4, 1 if columns > 3 else 0), max(rows // 4, 1 if rows > 3 else 0)
        hollow[[j, j, rows - 1 - j], [i, columns - 1 - i, i]] = 1
    par = np.array([pitch_mm, edge, INK, PAPER, BEHIND, *half, radius, worst, 1.0 if asymmetric else 0.0])
    return BoardTexture(
        kind=BOARD,
        parameters=par,
        nodes_mm=np.ascontiguousarray(errors_mm),
        finest_mm=edge,
        squares=_NO_SQUARES,
        markers=_NO_MARKERS,
        hollow=hollow,
        round_dots=True,
    )


def _check_margin(margin_mm: float) -> None:
    if not 0.0 <= margin_mm < 1e4:
        raise ValueError(f"margin_mm must lie between 0 and 10000, got {margin_mm:g}")


@njit(cache=True, nogil=True, error_model="numpy")
def _step(distance: float, per_edge: float) -> float:
    """Gaussian's share beyond an edge: 0 far before it, 1 far behind; ``per_edge`` = 1 / (sqrt(2) sd)."""
    return float(0.5 * (1.0 + erf(distance * per_edge)))


@njit(cache=True, nogil=True, error_model="numpy")
def _plate(par: Float, s: float, t: float) -> float:
    """Share of the plate, 1 on it and 0 beyond its rim."""
    reach = _REACH_SD * par[1]
    in_s, in_t = par[5] - abs(s), par[6] - abs(t)
    if in_s > reach and in_t > reach:
        return 1.0
    if in_s < -reach or in_t < -reach:
        return 0.0
    root = _ROOT_HALF / par[1]
    return float(_step(in_s, root) * _step(in_t, root))


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
        return int(edge) - 1, _step(off, _ROOT_HALF / sd)
    return int(np.floor(at)), 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _marker_ink(markers: NDArray[np.int64], n: int, x: float, y: float, sd: float) -> float:
    """Ink of marker n at a place in units of its cells."""
    near = _REACH_SD * sd
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
    near = _REACH_SD * sd
    far = near + par[8] * per_mm  # from the nominal edge no point beyond is touched by the true one
    m = markers.shape[1]
    scale = par[0] * m / par[7] if par[7] > 0.0 else 0.0
    for k in range(s.size):
        sk, tk = s[k], t[k]
        if not (abs(sk) < _FAR_MM and abs(tk) < _FAR_MM):
            continue
        plate = _plate(par, sk, tk)
        if plate == 0.0:
            out[k] = behind
            continue
        a, b = sk * per_mm + centre_a, tk * per_mm + centre_b
        if scale == 0.0 and abs(a - np.floor(a + 0.5)) > far and abs(b - np.floor(b + 0.5)) > far:
            v = _black(squares, int(np.floor(a)), int(np.floor(b)))
            out[k] = behind + (paper + (ink - paper) * v - behind) * plate
            continue
        if par[8] > 0.0:
            # the exact place of what the maker printed here: a fixed point, as errors are small against the pitch
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


@njit(cache=True, nogil=True, error_model="numpy")
def _dots(par: Float, errors: Float, hollow: NDArray[np.int64], s: Float, t: Float, out: Float) -> None:
    pitch, per_mm, root = par[0], 1.0 / par[0], _ROOT_HALF / par[1]
    ink, paper, behind, radius = par[2], par[3], par[4], par[7]
    n_j, n_i = hollow.shape
    asymmetric = par[9] > 0.0
    centre_b = 0.5 * (n_j - 1)
    centre_a = 0.5 * (2.0 * n_i - 1.0) if asymmetric else 0.5 * (n_i - 1)
    outer = radius + _REACH_SD * par[1] + 2.0 * par[8]
    for k in range(s.size):
        sk, tk = s[k], t[k]
        if not (abs(sk) < _FAR_MM and abs(tk) < _FAR_MM):
            continue
        plate = _plate(par, sk, tk)
        if plate == 0.0:
            out[k] = behind
            continue
        a, b = sk * per_mm + centre_a, tk * per_mm + centre_b
        cover = 0.0
        # an asymmetric grid's nearest dot may lie in either of the two rows about the point
        first = int(np.floor(b)) if asymmetric else int(np.floor(b + 0.5))
        for j in range(first, first + (2 if asymmetric else 1)):
            shift = float(j % 2) if asymmetric else 0.0
            i = int(np.floor(0.5 * (a - shift) + 0.5)) if asymmetric else int(np.floor(a + 0.5))
            if not (0 <= j < n_j and 0 <= i < n_i):
                continue
            x = (2.0 * i + shift if asymmetric else float(i)) - centre_a
            dx, dy = sk - pitch * x - errors[j, i, 0], tk - pitch * (j - centre_b) - errors[j, i, 1]
            r2 = dx * dx + dy * dy
            if r2 < outer * outer:
                r = np.sqrt(r2)
                cover += _step(radius - r, root)
                if hollow[j, i] == 1:
                    cover -= _step(0.5 * radius - r, root)
        v = paper + (ink - paper) * cover
        out[k] = behind + (v - behind) * plate
