"""Joining of pieces to whole lines of one family, and their order.

Pieces on each other's prolongation form a line. Lines of one family cross any other line at positions that are a
projective function of their number, so neighbouring gaps differ little: following the gaps numbers the lines, passes
over a line that is missing and leaves out other structures (scratches, frames, edges).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.grid.directions import Pieces

_STEP_CHANGE = 0.22  # neighbouring gaps of a grid differ by at most this part, even at 35 degrees through a wide lens
_MAX_ROUNDS = 40
_MAX_LINES = 150
_MAX_TURN = 0.15  # rad between a piece and its line
_MIN_SHARE = 0.25  # share of the longest line's seen length; shorter ones are clutter
# where lines are broken: two pieces of eleven are no clutter, and a piece of another line is further off than this part
# of a piece's length
_BROKEN_SHARE, _BROKEN_OFF = 0.12, 0.25
_PASSED_OVER, _BROKEN_PASSED_OVER = 1, 3  # neighbouring lines that may be missing
_MAX_STEP_ERROR = 0.45  # share of a gap, for any number of missing lines


@dataclass(frozen=True)
class CoarseLine:
    """One line: parabola across its mean direction.

    Attributes
    ----------
    centre_px, direction
        (2,) reference point and unit vector.
    bend
        (3,) offset along the normal (-dy, dx) as a polynomial in the distance along the direction, lowest power
        first.
    span_px
        (2,) where its first piece begins and its last one ends, along the direction.
    seen_px
        Length of all its pieces.
    """

    centre_px: Float
    direction: Float
    bend: Float
    span_px: Float
    seen_px: float

    def point(self, along_px: Float | float) -> Float:
        """Return points (..., 2) at distances (...) along the line."""
        t = np.asarray(along_px, dtype=np.float64)
        off = self.bend[0] + t * (self.bend[1] + t * self.bend[2])
        normal = np.array([-self.direction[1], self.direction[0]])
        return np.asarray(self.centre_px + t[..., None] * self.direction + off[..., None] * normal)


def link(pieces: Pieces, *, broken: bool = False) -> list[CoarseLine]:
    """Join pieces that prolong each other: a line grows from its heaviest piece outwards.

    ``broken``: the pieces of one line may be far apart.
    """
    n = len(pieces)
    if n < 3:
        return []
    free = np.ones(n, dtype=bool)
    typical = float(np.median(pieces.length_px))
    lines: list[CoarseLine] = []
    for seed in np.argsort(-pieces.weight):
        if free[seed] and len(lines) < _MAX_LINES:
            members = _grow(pieces, np.array([seed]), free, typical)
            if broken:
                members = _grow(pieces, members, free, typical, broken=True)
            free[members] = False
            lines.append(_fit(pieces.take(members)))
    longest = max(line.seen_px for line in lines)
    least = _BROKEN_SHARE if broken else _MIN_SHARE
    return [line for line in lines if line.seen_px >= least * longest]


def _grow(
    pieces: Pieces, seed: NDArray[np.intp], free: Bool, typical: float, *, broken: bool = False
) -> NDArray[np.intp]:
    members, reach, most = (seed, np.inf, _BROKEN_OFF * typical) if broken else (seed, 2.0 * typical, np.inf)
    for _ in range(_MAX_ROUNDS):
        line = _fit(pieces.take(members))
        t, off, turn = _against(line, pieces)
        beyond = np.maximum(np.maximum(t - line.span_px[1], line.span_px[0] - t), 0.0)
        on_line = (
            free
            & (beyond - 0.5 * pieces.length_px < reach)
            & (np.abs(off) < np.minimum(1.2 + 0.07 * beyond, most))
            & (np.abs(turn) < _MAX_TURN)
        )
        on_line[seed] = True
        grown = np.flatnonzero(on_line)
        if np.array_equal(grown, members):
            break
        members = grown
    return members


def _against(line: CoarseLine, pieces: Pieces) -> tuple[Float, Float, Float]:
    """Distance along a line, offset from it and turn against it, of each piece, (n,) each."""
    d = pieces.centre_px - line.centre_px
    t = d @ line.direction
    normal = np.array([-line.direction[1], line.direction[0]])
    # a parabola is not extrapolated far beyond its own points
    inside = np.clip(t, line.span_px[0], line.span_px[1])
    slope = line.bend[1] + 2.0 * line.bend[2] * inside
    expected = line.bend[0] + inside * (line.bend[1] + inside * line.bend[2]) + slope * (t - inside)
    across, along = pieces.direction @ normal, pieces.direction @ line.direction
    return t, d @ normal - expected, across / np.maximum(np.abs(along), 0.1) * np.sign(along) - slope


def _fit(pieces: Pieces) -> CoarseLine:
    ends = np.concatenate(
        [pieces.centre_px + s * (0.4 * pieces.length_px)[:, None] * pieces.direction for s in (-1.0, 1.0)]
    )
    weight = np.tile(pieces.length_px, 2)
    centre = np.average(ends, axis=0, weights=weight)
    d = ends - centre
    _, vectors = np.linalg.eigh(np.einsum("ni,nj->ij", d * weight[:, None], d))
    direction = vectors[:, 1]
    if direction @ pieces.direction.sum(axis=0) < 0.0:
        direction = -direction
    t = d @ direction
    off = d @ np.array([-direction[1], direction[0]])
    bend = np.zeros(3)
    degree = 2 if len(pieces) >= 5 else 1
    bend[: degree + 1] = np.polynomial.polynomial.polyfit(t, off, degree, w=np.sqrt(weight))
    half = 0.1 * pieces.length_px.max()
    return CoarseLine(
        centre, direction, bend, np.array([t.min() - half, t.max() + half]), float(pieces.length_px.sum())
    )


@dataclass(frozen=True)
class Chain:
    """Lines of one family in order.

    Attributes
    ----------
    lines, number
        The lines, and (n,) their numbers from 0; a number may be missing.
    strays
        Lines that do not fit into the sequence.
    """

    lines: tuple[CoarseLine, ...]
    number: NDArray[np.intp]
    strays: tuple[CoarseLine, ...]

    @property
    def count(self) -> int:
        """Numbers spanned, missing ones included."""
        return int(self.number[-1]) + 1 if len(self.number) else 0


def order(
    lines: list[CoarseLine], transversal_point: Float, transversal_direction: Float, *, broken: bool = False
) -> Chain:
    """Number the lines by their crossings with a transversal, growing along its direction.

    ``broken``: several neighbouring lines may be missing.
    """
    if not lines:
        return Chain((), np.zeros(0, dtype=np.intp), ())
    u = np.array([_crossing(line, transversal_point, transversal_direction) for line in lines])
    by_u = np.argsort(u)
    u = u[by_u]
    ordered = [lines[k] for k in by_u]
    best: tuple[float, list[tuple[int, int]]] = (-1.0, [])
    n = len(u)
    for a in range(n - 1):
        for b in range(a + 1, min(a + 4, n)):
            if u[b] - u[a] < 4.0:  # two halves of one line
                continue
            members = _follow(u, a, b, _BROKEN_PASSED_OVER if broken else _PASSED_OVER)
            seen = [ordered[k].seen_px for _, k in members]
            numbers = [i for i, _ in members]
            missing = max(numbers) - min(numbers) + 1 - len(members)
            # without the penalty, counting in half steps would take in a scratch between two lines
            score = sum(seen) - 0.5 * missing * float(np.median(seen))
            if score > best[0]:
                best = (score, members)
    members = sorted(best[1])
    first = members[0][0] if members else 0
    used = {k for _, k in members}
    return Chain(
        tuple(ordered[k] for _, k in members),
        np.array([i - first for i, _ in members], dtype=np.intp),
        tuple(ordered[k] for k in range(n) if k not in used),
    )


def _crossing(line: CoarseLine, point: Float, direction: Float) -> float:
    normal = np.array([-line.direction[1], line.direction[0]])
    return float(((line.centre_px + line.bend[0] * normal - point) @ normal) / (direction @ normal))


def _follow(u: Float, a: int, b: int, passed_over: int) -> list[tuple[int, int]]:
    """Walk both ways from two neighbours; return (number, index) of the lines met, passing over missing lines."""
    members = [(0, a), (1, b)]
    for sign, start in ((1, b), (-1, a)):
        number = 1 if sign > 0 else 0
        last, step, growth = float(u[start]), float(u[b] - u[a]), 1.0
        missed = 0
        while missed <= passed_over:
            guess = last + sign * step * growth
            k = int(np.argmin(np.abs(u - guess)))
            number += sign
            if abs(u[k] - guess) < min(_STEP_CHANGE * (1 + missed), _MAX_STEP_ERROR) * step:
                new_step = abs(float(u[k]) - last)
                # half of the last change is carried on: gaps change smoothly, single ones carry errors
                growth = 1.0 + 0.5 * float(np.clip(new_step / step - 1.0, -_STEP_CHANGE, _STEP_CHANGE))
                members.append((number, k))
                last, step, missed = float(u[k]), new_step, 0
            else:
                missed += 1
                last = guess
    return members
