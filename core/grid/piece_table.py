"""The pieces of lines between crossings: their search areas, and line points from their fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.grid.lattice import apply_homography, homography
from stereorig.core.grid.lines import LinePoints
from stereorig.core.grid.profile import OUT
from stereorig.core.grid.strip import IN, INPUTS
from stereorig.core.target import GridTarget

_FIRST_BLUR_PX = 0.7
_SEARCH_SHARE = 0.2  # share of the spacing to the next line
_STRIP_SHARE = 0.45


@dataclass(frozen=True)
class PieceTable:
    """All pieces of a lattice, family a first.

    Attributes
    ----------
    rows
        (n, len(INPUTS)) for :func:`stereorig.core.grid.profile.fit_pieces`.
    family, line, crossing
        (n,) family, number of the line, and number of the crossing at which the piece begins.
    counts
        (n_a, n_b) lines.
    """

    rows: Float
    family: NDArray[np.intp]
    line: NDArray[np.intp]
    crossing: NDArray[np.intp]
    counts: tuple[int, int]

    def ends_px(self) -> Float:
        """Return both ends of each piece, (n, 2, 2)."""
        columns = (IN["start_x"], IN["start_y"]), (IN["end_x"], IN["end_y"])
        return np.stack([self.rows[:, list(c)] for c in columns], axis=1)

    def line_index(self) -> NDArray[np.intp]:
        """Number of the line over both families, (n,)."""
        return self.line + np.where(self.family == 0, 0, self.counts[0])

    def of_lines(self, kept: Kept) -> tuple[PieceTable, NDArray[np.intp]]:
        """Return the pieces of some lines only, these numbered in turn, and their places in this table."""
        number = _renumbered(kept, self.counts)
        line = number[self.line_index()]
        own = np.flatnonzero(line >= 0)
        part = PieceTable(self.rows[own], self.family[own], line[own], self.crossing[own], (len(kept[0]), len(kept[1])))
        return part, own


Kept = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Numbers of the lines of either family that are measured."""


def _renumbered(kept: Kept, counts: tuple[int, int]) -> NDArray[np.intp]:
    """New number of each line within its family, over both families; -1 for those left out."""
    number = np.full(sum(counts), -1, dtype=np.intp)
    for start, own in zip((0, counts[0]), kept, strict=True):
        number[start + own] = np.arange(len(own))
    return number


def piece_table(nodes_px: Float, target: GridTarget, *, blur_px: float | None) -> PieceTable:
    """Define the pieces between the intersections (n_a, n_b, 2).

    Parameters
    ----------
    nodes_px
        Intersections, to a fraction of the spacing when ``blur_px`` is None, else to a fraction of a pixel.
    target
        For the line's width.
    blur_px
        Known blur; None searches across the line first.
    """
    tables = [_family(nodes_px, 0), _family(np.swapaxes(nodes_px, 0, 1), 1)]
    rows, spacing, family, line, crossing = (np.concatenate(columns) for columns in zip(*tables, strict=True))
    rows[:, IN["width"]] = np.maximum(spacing * target.line_width_mm / target.pitch_mm, 0.05)
    rows[:, IN["blur"]] = _FIRST_BLUR_PX if blur_px is None else blur_px
    rows[:, IN["search"]] = _SEARCH_SHARE * spacing if blur_px is None else 0.0
    rows[:, IN["room"]] = _STRIP_SHARE * spacing
    return PieceTable(rows, family, line, crossing, (nodes_px.shape[0], nodes_px.shape[1]))


class _Family(NamedTuple):
    """Pieces of one family's lines: rows of the table, the lines' spacing there, and the pieces' numbers."""

    rows: Float
    spacing: Float
    family: NDArray[np.intp]
    line: NDArray[np.intp]
    crossing: NDArray[np.intp]


def _family(nodes: Float, family: int) -> _Family:
    """Pieces of the lines along axis 1 of ``nodes`` (lines, crossings, 2)."""
    n_line, n_cross = nodes.shape[:2]
    start, end = nodes[:, :-1], nodes[:, 1:]
    chord = end - start
    length = np.linalg.norm(chord, axis=-1)
    direction = chord / length[..., None]
    normal = np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
    bend = _bends(nodes)
    middle = 0.5 * (start + end) - normal * (bend * length**2 / 4.0)[..., None]
    # the crossing lines' directions at the intersections, and the distance to the next line
    step = np.gradient(nodes, axis=0)
    cross = np.stack([-step[..., 1], step[..., 0]], axis=-1)
    cross /= np.linalg.norm(cross, axis=-1, keepdims=True)
    gap = 0.5 * (step[:, :-1] + step[:, 1:])
    spacing = np.abs(np.sum(gap * normal, axis=-1))
    rows = np.zeros((n_line, n_cross - 1, len(INPUTS)))
    for names, value in (
        (("x", "y"), middle),
        (("dir_x", "dir_y"), direction),
        (("start_x", "start_y"), start),
        (("end_x", "end_y"), end),
        (("start_nx", "start_ny"), cross[:, :-1]),
        (("end_nx", "end_ny"), cross[:, 1:]),
    ):
        for k, name in enumerate(names):
            rows[..., IN[name]] = value[..., k]
    rows[..., IN["half_length"]] = 0.5 * length
    rows[..., IN["bend"]] = bend
    number = np.broadcast_to(np.arange(n_line)[:, None], length.shape).ravel()
    crossing = np.broadcast_to(np.arange(n_cross - 1)[None], length.shape).ravel()
    return _Family(rows.reshape(-1, len(INPUTS)), spacing.ravel(), np.full(number.size, family), number, crossing)


def _bends(nodes: Float) -> Float:
    """Half the second derivative of each line across its chord, at each piece's middle, (lines, crossings - 1)."""
    out = np.zeros((nodes.shape[0], nodes.shape[1] - 1))
    for k, line in enumerate(nodes):
        direction = line[-1] - line[0]
        length = float(np.linalg.norm(direction))
        direction = direction / length
        t = (line - line[0]) @ direction / length
        off = (line - line[0]) @ np.array([-direction[1], direction[0]])
        p = np.polynomial.Polynomial.fit(t, off, min(3, len(t) - 2), domain=[0.0, 1.0], window=[0.0, 1.0])
        out[k] = 0.5 * p.deriv(2)(0.5 * (t[1:] + t[:-1])) / length**2
    return out


@dataclass(frozen=True)
class PiecePoints:
    """Line points and the pieces they come from: two points a piece whose errors are independent."""

    points: LinePoints
    piece: NDArray[np.intp]

    def of_lines(self, kept: Kept, counts: tuple[int, int]) -> PiecePoints:
        """Return the points on some lines only, numbered and measured along by these lines alone."""
        if (len(kept[0]), len(kept[1])) == counts:
            return self
        p = self.points
        line = _renumbered(kept, counts)[p.line + np.where(p.family == 0, 0, counts[0])]
        own = np.flatnonzero(line >= 0)
        along = np.empty(len(own))
        for family in (0, 1):
            mine = p.family[own] == family
            across = kept[1 - family].astype(np.float64)
            at = p.along[own][mine]
            before = np.clip(np.searchsorted(across, at) - 1, 0, len(across) - 2)
            along[mine] = before + (at - across[before]) / (across[before + 1] - across[before])
        part = LinePoints(p.xy_px[own], p.normal[own], p.sigma_px[own], p.family[own], line[own], along)
        return PiecePoints(part, self.piece[own])


def spread(values: Float, kept: Kept, counts: tuple[int, int]) -> Float:
    """Place values (len(kept[0]), len(kept[1]), ...) of the lines measured among all, NaN elsewhere."""
    out = np.full((*counts, *values.shape[2:]), np.nan)
    out[np.ix_(*kept)] = values
    return out


def filled(nodes_px: Float, kept: Kept, counts: tuple[int, int]) -> Float:
    """Return all intersections; those that are not measured are at the places that the others determine."""
    off = spread(nodes_px, kept, counts)
    known = np.isfinite(off).all(axis=-1)
    if known.all():
        return nodes_px
    every = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).astype(np.float64)
    regular = apply_homography(homography(every[known], off[known]), every)
    off -= regular
    for lines in (off, off.swapaxes(0, 1)):  # along each line that is measured, then along all of the others
        for line in lines:
            own = np.flatnonzero(np.isfinite(line[:, 0]))
            for k in range(2) if 0 < len(own) < len(line) else ():
                line[:, k] = np.interp(np.arange(len(line)), own, line[own, k])
    return regular + off


def line_points(table: PieceTable, fits: Float, good: Bool) -> PiecePoints:
    """Turn each good piece's offset and slope into two line points with independent errors.

    The errors of offset and slope make the offset's error smallest at one position; at equal distances on both sides of
    it, where the slope's share equals the offset's own, the two errors are not correlated.
    """
    piece = np.flatnonzero(good)
    f, r = fits[piece], table.rows[piece]
    var0, cov, var1 = f[:, OUT["var_c0"]], f[:, OUT["cov_c01"]], f[:, OUT["var_c1"]]
    at = np.clip(-cov / var1, -r[:, IN["half_length"]], r[:, IN["half_length"]])
    min_variance = np.maximum(var0 - cov**2 / var1, 1e-16)
    distance = np.minimum(np.sqrt(min_variance / var1), r[:, IN["half_length"]])
    direction = r[:, [IN["dir_x"], IN["dir_y"]]]
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    points, along = [], []
    for sign in (-1.0, 1.0):
        t = at + sign * distance
        off = f[:, OUT["c0"]] + f[:, OUT["c1"]] * t + r[:, IN["bend"]] * t**2
        points.append(r[:, [IN["x"], IN["y"]]] + t[:, None] * direction + off[:, None] * normal)
        along.append(table.crossing[piece] + 0.5 + 0.5 * t / r[:, IN["half_length"]])
    return PiecePoints(
        LinePoints(
            np.concatenate(points),
            np.tile(normal, (2, 1)),
            np.tile(np.sqrt(2.0 * min_variance), 2),
            np.tile(table.family[piece], 2),
            np.tile(table.line[piece], 2),
            np.concatenate(along),
        ),
        np.tile(piece, 2),
    )
