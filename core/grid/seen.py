"""Lines of a target that an image shows: covered lines at the ends of a lattice, and lines that are missing.

A piece between two crossings shows a line, clean ground, or neither. A grid ends if all lines across its last line end
with it; it continues under a cover if they run on. A line is missing if all of it is clean ground and the lines across
it run through; a cover that hides a line cuts these, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.errors import TargetError
from stereorig.core.grid.checks import smooth
from stereorig.core.grid.lattice import LineLattice, apply_homography, lattice_rotation, polylines
from stereorig.core.grid.threshold import LinePicture
from stereorig.core.target import GridTarget

# share of a piece's positions that must be on a line; noise puts some pixels beyond the threshold, and off it
_LINE, _GROUND = 0.7, 0.3
_SAME_GROUND = 0.3  # share of the lines' depth
_MIDDLE = np.linspace(0.2, 0.8, 13)
# shares of the distance to the next line: lines that run on do so here, lines that end have done so here
_RUN, _ENDING = np.linspace(0.12, 0.3, 7), np.linspace(0.15, 0.45, 7)
_ENDED = 0.8  # share of the lines across the last one
_RUNNING_ON = 0.3
_LEAST = 2  # pieces that show a line, or lines that run on
_MISSING = 0.8  # share of a line's pieces


@dataclass(frozen=True)
class _Pieces:
    """For pieces (...): True if they show a line, clean ground, or are inside the image at all."""

    line: Bool
    ground: Bool
    inside: Bool


class SeenLines:
    """The lines of one image's lattice, which may be numbered beyond its ends.

    Parameters
    ----------
    picture, grey
        Dark structures at the coarse scale, and the full-size image.
    lattice
        As found.
    dark_lines
        Sign of the contrast.
    """

    def __init__(self, picture: LinePicture, grey: Float32, lattice: LineLattice, *, dark_lines: bool) -> None:
        self._picture, self._sign, self._lattice = picture, 1.0 if dark_lines else -1.0, lattice
        self._grey = grey * np.float32(self._sign)
        nodes = lattice.nodes_px
        cells = 0.25 * (nodes[1:, 1:] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[:-1, :-1])
        self._at, self._cells = cells.reshape(-1, 2), self._levels(cells).ravel()
        middles = np.concatenate([(0.5 * (p[1:] + p[:-1])).reshape(-1, 2) for p in (nodes, nodes.swapaxes(0, 1))])
        self._depth = abs(float(np.nanmedian(self._ground(middles) - self._levels(middles))))

    def nodes(self, i: NDArray[np.intp], j: NDArray[np.intp]) -> Float:
        """Intersections (len(i), len(j), 2) of these numbers, by the lattice's homography beyond it."""
        ij = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1)
        out = apply_homography(self._lattice.plane_to_image, ij.astype(np.float64))
        n_a, n_b = self._lattice.counts
        own_i, own_j = (i >= 0) & (i < n_a), (j >= 0) & (j < n_b)
        out[np.ix_(own_i, own_j)] = self._lattice.nodes_px[np.ix_(i[own_i], j[own_j])]
        return out

    def pieces(self, start: Float, end: Float, along: Float = _MIDDLE) -> _Pieces:
        """Classify pieces from ``start`` to ``end`` (..., 2) by their positions ``along``."""
        chord = end - start
        normal = np.stack([-chord[..., 1], chord[..., 0]], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        at = start[..., None, :] + along[:, None] * chord[..., None, :]
        hit = np.zeros(at.shape[:-1], dtype=bool)
        for step in (-1.0, 0.0, 1.0):  # a coarse line may be a pixel off
            hit |= self._masked(at + step * self._picture.factor * normal[..., None, :])
        level = self._levels(at)
        inside = np.asarray(np.isfinite(level).all(axis=-1))
        share = hit.mean(axis=-1)
        off = np.abs((level - self._ground(at)).mean(axis=-1))
        return _Pieces(
            inside & (share >= _LINE), inside & (share <= _GROUND) & (off < _SAME_GROUND * self._depth), inside
        )

    def _ground(self, at: Float) -> Float:
        """Level of the ground at positions (..., 2), from the cells between the lines."""
        return smooth(self._at, self._cells, at.reshape(-1, 2)).reshape(at.shape[:-1])

    def _masked(self, at: Float) -> Bool:
        xy = np.rint((at + 0.5) / self._picture.factor - 0.5).astype(int)
        mask = self._picture.mask
        inside = np.asarray(((xy >= 0) & (xy < np.array(mask.shape[::-1]))).all(axis=-1))
        x, y = np.moveaxis(np.where(inside[..., None], xy, 0), -1, 0)
        return np.asarray(mask[y, x] & inside)

    def _levels(self, at: Float) -> Float:
        """Grey level at positions (..., 2), brighter ground positive; NaN outside the image."""
        xy = np.rint(at).astype(int)
        inside = np.asarray(((xy >= 0) & (xy < np.array(self._grey.shape[::-1]))).all(axis=-1))
        x, y = np.moveaxis(np.where(inside[..., None], xy, 0), -1, 0)
        return np.where(inside, self._grey[y, x].astype(np.float64), np.nan)


def completed(picture: LinePicture, grey: Float32, lattice: LineLattice, target: GridTarget) -> LineLattice | None:
    """Number the lines of a lattice that shows only some of the target's.

    Lines beyond an end are accepted if pieces of them are seen, or if the lines across run on beyond one end of the
    lattice while all of them stop at the other. Lines that are declared missing are counted as such.

    Returns
    -------
    Lattice or None
        With all the target's lines, unseen ones predicted; None if the seen lines cannot be numbered with certainty.
    """
    seen = SeenLines(picture, grey, lattice, dark_lines=target.dark_lines)
    present = target.present_lines
    ranges = [[0, n - 1] for n in lattice.counts]
    for axis in (0, 1):
        wanted = int(present[axis][-1] - present[axis][0])
        own = ranges[axis]
        while own[1] - own[0] < wanted:
            low, high = (_line_seen(seen, ranges, axis, end) for end in (0, 1))
            if low + high == 0 or own[1] - own[0] + low + high > wanted:
                break
            own[0], own[1] = own[0] - low, own[1] + high
        rest = wanted - (own[1] - own[0])
        if rest < 0:
            return None
        if rest:
            ends = [_end(seen, ranges, axis, end) for end in (0, 1)]
            if sorted(ends) != ["closed", "open"]:
                return None
            end = ends.index("open")
            own[end] += rest if end else -rest
    first = [own[0] - int(p[0]) for own, p in zip(ranges, present, strict=True)]
    i, j = (np.arange(f, f + n) for f, n in zip(first, target.lines, strict=True))
    H = lattice.plane_to_image @ np.array([[1.0, 0.0, first[0]], [0.0, 1.0, first[1]], [0.0, 0.0, 1.0]])
    nodes = seen.nodes(i, j)
    return LineLattice(nodes, H / H[2, 2], lattice_rotation(H, target.lines), lattice.strays)


def _along(seen: SeenLines, ranges: list[list[int]], axis: int, number: int) -> Float:
    """Intersections (n, 2) of one line with the lines across."""
    across = np.arange(ranges[1 - axis][0], ranges[1 - axis][1] + 1)
    own = np.array([number])
    return seen.nodes(own, across)[0] if axis == 0 else seen.nodes(across, own)[:, 0]


def _line_seen(seen: SeenLines, ranges: list[list[int]], axis: int, end: int) -> bool:
    """Return True if pieces of the next line beyond an end are seen."""
    number = ranges[axis][end] + (1 if end else -1)
    nodes = _along(seen, ranges, axis, number)
    return bool(np.count_nonzero(seen.pieces(nodes[:-1], nodes[1:]).line) >= _LEAST)


def _end(seen: SeenLines, ranges: list[list[int]], axis: int, end: int) -> str:
    """Return ``closed`` if the lines across end at the last line, ``open`` if they run on, else ``""``."""
    step = 1 if end else -1
    last = ranges[axis][end]
    nodes, beyond = (_along(seen, ranges, axis, k) for k in (last, last + step))
    if seen.pieces(nodes, beyond, _ENDING).ground.sum() >= _ENDED * len(nodes):
        return "closed"
    running = seen.pieces(nodes, beyond, _RUN).line.sum()
    return "open" if running >= max(_LEAST, _RUNNING_ON * len(nodes)) else ""


def check_missing(picture: LinePicture, grey: Float32, lattice: LineLattice, target: GridTarget) -> None:
    """Compare the lines that a lattice lacks with those that the target declares missing.

    Raises
    ------
    TargetError
        ``target_line_missing`` if they differ.
    """
    seen = SeenLines(picture, grey, lattice, dark_lines=target.dark_lines)
    nodes = lattice.nodes_px
    missing: list[list[int]] = []
    shown: list[list[int]] = []
    for axis in (0, 1):
        lines = nodes if axis == 0 else nodes.swapaxes(0, 1)
        own = seen.pieces(lines[:, :-1], lines[:, 1:])
        across = seen.pieces(lines[:-1], lines[1:])
        clean = own.ground.sum(axis=1) >= _MISSING * np.maximum(own.inside.sum(axis=1), 1)
        runs = across.line.mean(axis=1) > 0.5  # between this line and the next
        cut = ~np.concatenate([runs[:1], runs]) | ~np.concatenate([runs, runs[-1:]])
        missing.append([int(k) + 1 for k in np.flatnonzero(clean & ~cut)])
        declared = target.missing_lines[axis]
        shown.append([k for k in declared if own.line[k - 1].mean() > 0.5])
    extra = [sorted(set(m) - set(d)) for m, d in zip(missing, target.missing_lines, strict=True)]
    names = ("columns", "rows")
    found = [f"line {k} of the {name}" for name, own in zip(names, extra, strict=True) for k in own]
    wrong = [f"line {k} of the {name}" for name, own in zip(names, shown, strict=True) for k in own]
    if not found and not wrong:
        return
    causes = [f"{', '.join(found)} {'is' if len(found) == 1 else 'are'} missing"] if found else []
    causes += [f"{', '.join(wrong)} {'is' if len(wrong) == 1 else 'are'} declared missing but seen"] if wrong else []
    right = [sorted(set(d) - set(s) | set(m)) for d, s, m in zip(target.missing_lines, shown, missing, strict=True)]
    raise TargetError(
        f"{'; '.join(causes)} (counted from 1; columns are crossed along X_sys, rows along Y_sys)",
        code="target_line_missing",
        remedy=f"Declare missing_lines = {right} in the target's description, if this is the target described.",
        missing=missing,
        declared=[list(d) for d in target.missing_lines],
        segments_px=polylines(nodes),
    )
