"""Numbered intersections of two sets of lines, or the reason why there are none.

Family a: lines at constant X_sys, crossed walking along X_sys; family b: lines at constant Y_sys.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import TargetError
from stereorig.core.grid.chains import Chain, CoarseLine, link, order
from stereorig.core.grid.directions import FAMILY_REACH_RAD, Directions, Pieces, family_pieces
from stereorig.core.grid.lines.parabolas import meet_parabolas
from stereorig.core.grid.threshold import LinePicture
from stereorig.core.grid.view import Orientation

_COARSE = ("centre_px", "direction", "bend")
# angles at which two families cross; the narrower ones, of a grid seen at 68 to 80 degrees, only if no others do
_CROSSINGS_RAD = np.radians([[40.0, 90.0], [20.0, 40.0]])
_SHOW = (
    "Show the whole target, clean, evenly lit and in focus, its lines 12 px apart or more: one that is seen obliquely "
    "has them nearer in one direction."
)
_MIN_LINES = 4
_MIN_SEEN = 0.4
# upper ends of the quarter of a turn that contains X_sys. Without a named orientation, grids within 22 degrees of 45
# are indexed as diagonal ones, and grids within 22 degrees of the rows as upright ones
_HIGHEST_DEG: dict[Orientation | None, float] = {"diagonal": 90.0, "upright": 45.0, None: 67.0}
_SURELY_UPRIGHT_DEG = 10.0  # within this a grid is not taken for a diagonal one by its counts
_STRAY_END = 0.1  # share of the pitch; an end line that deviates by more is an edge or a frame


@dataclass(frozen=True)
class LineLattice:
    """Numbered lines and their intersections.

    Attributes
    ----------
    nodes_px
        (m_a, m_b, 2) intersections of the lines found, straight from the coarse lines, or predicted where a line
        was missed.
    plane_to_image
        (3, 3) homography from (number in a, number in b, 1).
    rotation_rad
        Rotation of the lattice in the image.
    strays
        Lines that belong to neither family's sequence.
    """

    nodes_px: Float
    plane_to_image: Float
    rotation_rad: float
    strays: tuple[CoarseLine, ...]

    @property
    def counts(self) -> tuple[int, int]:
        """Lines of family a and b."""
        return self.nodes_px.shape[0], self.nodes_px.shape[1]

    @property
    def tilt_rad(self) -> float:
        """Angle at which the camera sees the target off its normal, for a narrow view and pixels nearly square."""
        middle = 0.5 * np.array(self.counts)
        corner, *ends = apply_homography(self.plane_to_image, middle + np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 1e-3]]))
        large, small = np.linalg.svd(np.array(ends) - corner, compute_uv=False)
        return float(np.arccos(small / large))

    @property
    def pitch_px(self) -> float:
        """Median distance of neighbouring intersections."""
        return pitch_px(self.nodes_px)


def pitch_px(nodes_px: Float) -> float:
    """Return the median distance of neighbours in a lattice (m_a, m_b, 2)."""
    da = np.linalg.norm(np.diff(nodes_px, axis=0), axis=-1).ravel()
    db = np.linalg.norm(np.diff(nodes_px, axis=1), axis=-1).ravel()
    return float(np.median(np.concatenate([da, db])))


def polylines(nodes_px: Float) -> list[list[float]]:
    """Return the lattice's lines from end to end, [x0, y0, x1, y1] each, for a picture."""
    ends = [(line[0], line[-1]) for line in nodes_px] + [(line[0], line[-1]) for line in np.swapaxes(nodes_px, 0, 1)]
    return [[round(float(v), 1) for v in (*p, *q)] for p, q in ends]


_Linked = Callable[[float, float], tuple[Pieces, list[CoarseLine]]]
"""Pieces within an angle of a direction, and the lines that they form."""


def find_lattice(picture: LinePicture, found: Directions, *, broken: bool = False) -> LineLattice:
    """Try the picture's main directions in pairs; return the lattice with the most line seen.

    ``broken``: covers and dirt may hide long parts of lines, and several neighbouring lines.

    Raises
    ------
    TargetError
        ``target_not_found`` if no pair of directions has four lines each.
    """
    best: LineLattice | None = None
    best_seen = 0.0
    max_counts = (0, 0)

    @cache  # a direction is in several pairs
    def linked(direction_rad: float, reach_rad: float) -> tuple[Pieces, list[CoarseLine]]:
        pieces = family_pieces(picture, found, direction_rad, reach_rad)
        return pieces, link(pieces, broken=broken) if len(pieces) >= _MIN_LINES else []

    for low, high in _CROSSINGS_RAD:
        for p, q in combinations(found.peaks_rad, 2):
            if not low <= _between(p, q) <= high:
                continue
            lattice, seen, counts = _try_pair(linked, p, q, broken)
            max_counts = max(max_counts, counts, key=min)
            if lattice is not None and seen > best_seen:
                best, best_seen = lattice, seen
        if best is not None:
            return best
    raise not_found(
        "no grid is seen: nowhere do two sets of parallel lines cross (at best "
        f"{max_counts[0]} and {max_counts[1]} lines were found)",
        remedy=_SHOW,
        found_a=max_counts[0],
        found_b=max_counts[1],
        clearness=picture.clearness,
    )


def _between(first_rad: float, second_rad: float) -> float:
    """Return the angle between two directions of lines."""
    angle_rad = abs(first_rad - second_rad)
    return min(angle_rad, np.pi - angle_rad)


def not_found(cause: str, **context: Any) -> TargetError:
    """Return the error for an image without a grid."""
    return TargetError(cause, code="target_not_found", **context)


def _try_pair(
    linked: _Linked, first_rad: float, second_rad: float, broken: bool
) -> tuple[LineLattice | None, float, tuple[int, int]]:
    # X_sys runs right and down: its direction is in (0, 90) degrees of the image, and family b runs along it
    along_x, along_y = sorted((first_rad, second_rad))
    if along_x > 0.5 * np.pi or along_y < 0.5 * np.pi:
        # both in one quadrant: a lattice near 0 or 90 degrees, or strongly sheared; nearest to 45 degrees is X
        candidates = (first_rad, second_rad)
        off = [abs(((c - 0.25 * np.pi + 0.5 * np.pi) % np.pi) - 0.5 * np.pi) for c in candidates]
        along_x = candidates[int(np.argmin(off))]
        along_y = candidates[1 - int(np.argmin(off))]
    angle_rad = _between(first_rad, second_rad)
    reach = min(FAMILY_REACH_RAD, 0.5 * angle_rad) if angle_rad < _CROSSINGS_RAD[0, 0] else FAMILY_REACH_RAD
    pieces_a, lines_a = linked(along_y, reach)
    pieces_b, lines_b = linked(along_x, reach)
    if min(len(pieces_a), len(pieces_b)) < _MIN_LINES:
        return None, 0.0, (0, 0)
    centre = np.median(np.concatenate([pieces_a.centre_px, pieces_b.centre_px]), axis=0)
    # X grows to the right; where its direction is steep, downwards: one rule, since both are positive in (0, 90)
    # degrees
    x_dir = np.array([np.cos(along_x), np.sin(along_x)])
    y_dir = np.array([np.cos(along_y), np.sin(along_y)])
    if x_dir.sum() < 0.0:
        x_dir = -x_dir
    if x_dir[0] * y_dir[1] - x_dir[1] * y_dir[0] < 0.0:  # right-handed, y down: clockwise from X to Y
        y_dir = -y_dir
    chain_a = order(lines_a, centre, x_dir, broken=broken)
    chain_b = order(lines_b, centre, y_dir, broken=broken)
    counts = (len(chain_a.lines), len(chain_b.lines))
    if min(counts) < _MIN_LINES:
        return None, 0.0, counts
    chain_a, chain_b = _without_stray_ends(chain_a, chain_b)
    counts = (len(chain_a.lines), len(chain_b.lines))
    if min(counts) < _MIN_LINES:
        return None, 0.0, counts
    lattice = _lattice(chain_a, chain_b)
    if _seen_share(lattice, chain_a, chain_b) < _MIN_SEEN:
        return None, 0.0, (0, 0)
    seen = sum(line.seen_px for line in chain_a.lines) + sum(line.seen_px for line in chain_b.lines)
    return lattice, seen, counts


def oriented(lattice: LineLattice, orientation: Orientation | None, lines: tuple[int, int]) -> LineLattice:
    """Index a lattice by the quarter of a turn that must contain its X_sys.

    A grid without marks may be indexed in four right-handed ways, and under any rule the index jumps at one angle.
    Without ``orientation`` this angle is 67 degrees, equal to -23. Below -23 degrees the unequal counts of a grid
    decide if they fit only the other way. With rolls on both sides of it two cameras would index differently, and
    ``orientation`` must be named.

    Parameters
    ----------
    lattice
        Indexed in any right-handed way.
    orientation
        See :class:`stereorig.core.grid.view.GridOptions`.
    lines
        Counts of the target.
    """
    highest = _HIGHEST_DEG[orientation]
    # X_sys is turned back into (highest - 90, highest]
    turns = int(np.ceil((float(np.degrees(lattice.rotation_rad)) - highest) / 90.0))
    turned = _turned(lattice, turns)
    rotation_deg = float(np.degrees(turned.rotation_rad))
    swapped = turned.counts == (lines[1], lines[0]) and lines[0] != lines[1]
    if orientation is None and swapped and rotation_deg < -_SURELY_UPRIGHT_DEG:
        return _turned(turned, -1)
    return turned


def _turned(lattice: LineLattice, turns: int) -> LineLattice:
    """Return the lattice with X_sys turned back by quarter turns: X_sys becomes -Y_sys, Y_sys becomes X_sys."""
    turns %= 4
    if turns == 0:
        return lattice
    nodes, H = lattice.nodes_px, lattice.plane_to_image
    for _ in range(turns):
        # new [i, j] is old [j, n_b - 1 - i]
        H = H @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, nodes.shape[1] - 1.0], [0.0, 0.0, 1.0]])
        nodes = np.swapaxes(nodes[:, ::-1], 0, 1)
    nodes = np.ascontiguousarray(nodes)
    rotation = lattice_rotation(H, (nodes.shape[0], nodes.shape[1]))
    return LineLattice(nodes, H, rotation, lattice.strays)


def _seen_share(lattice: LineLattice, chain_a: Chain, chain_b: Chain) -> float:
    """Median share of the lines' length that was seen; noise forms lines of few pieces that happen to be in a row."""
    a = np.linalg.norm(np.diff(lattice.nodes_px, axis=1), axis=-1).sum(axis=1)[chain_a.number]
    b = np.linalg.norm(np.diff(lattice.nodes_px, axis=0), axis=-1).sum(axis=0)[chain_b.number]
    seen = [line.seen_px for line in (*chain_a.lines, *chain_b.lines)]
    return float(np.median(np.array(seen) / np.concatenate([a, b])))


def _without_stray_ends(chain_a: Chain, chain_b: Chain) -> tuple[Chain, Chain]:
    """Drop end lines that the other lines' lattice does not predict."""
    for _ in range(2):
        chain_a = _drop_ends(chain_a, chain_b)
        chain_b = _drop_ends(chain_b, chain_a)
    return chain_a, chain_b


def _drop_ends(chain: Chain, other: Chain) -> Chain:
    for end in (0, -1):
        if len(chain.lines) <= _MIN_LINES:
            break
        keep = np.ones(len(chain.lines), dtype=bool)
        keep[end] = False
        inner = Chain(tuple(line for line, k in zip(chain.lines, keep, strict=True) if k), chain.number[keep], ())
        H = homography(*_known_nodes(inner, other))
        number = np.full(len(other.number), chain.number[end])
        guess = apply_homography(H, np.stack([number, other.number], axis=-1).astype(np.float64))
        step = guess - apply_homography(
            H, np.stack([number + (1 if end == 0 else -1), other.number], axis=-1).astype(np.float64)
        )
        truth = crossings([chain.lines[end]], other.lines)[0]
        off = np.linalg.norm(truth - guess, axis=-1) / np.linalg.norm(step, axis=-1)
        if np.median(off) > _STRAY_END:
            number_kept = chain.number[keep]
            chain = Chain(inner.lines, number_kept - number_kept[0], (*chain.strays, chain.lines[end]))
    return chain


def _known_nodes(chain_a: Chain, chain_b: Chain) -> tuple[Float, Float]:
    """Numbers (n, 2) and positions (n, 2) of the intersections of all lines seen."""
    number = np.stack(np.meshgrid(chain_a.number, chain_b.number, indexing="ij"), axis=-1).astype(np.float64)
    return number.reshape(-1, 2), crossings(chain_a.lines, chain_b.lines).reshape(-1, 2)


def _lattice(chain_a: Chain, chain_b: Chain) -> LineLattice:
    number, xy = _known_nodes(chain_a, chain_b)
    H = homography(number, xy)
    grid = np.stack(np.meshgrid(np.arange(chain_a.count), np.arange(chain_b.count), indexing="ij"), axis=-1)
    nodes = apply_homography(H, grid.astype(np.float64))
    i, j = number.astype(int).T
    nodes[i, j] = xy
    return LineLattice(
        nodes, H, lattice_rotation(H, (chain_a.count, chain_b.count)), (*chain_a.strays, *chain_b.strays)
    )


def lattice_rotation(plane_to_image: Float, counts: tuple[int, int]) -> float:
    """Rotation of the lattice at its centre: the rotation part of the local affine map's polar decomposition.

    For a camera turned by gamma about the image's y axis the map is diag(cos gamma, 1) R(alpha), whose rotation
    part is alpha.
    """
    centre = np.array([0.5 * (counts[0] - 1), 0.5 * (counts[1] - 1)])
    hx, hy = 1e-3 * np.eye(2)
    ex = apply_homography(plane_to_image, centre + hx) - apply_homography(plane_to_image, centre - hx)
    ey = apply_homography(plane_to_image, centre + hy) - apply_homography(plane_to_image, centre - hy)
    return float(np.arctan2(ex[1] - ey[0], ex[0] + ey[1]))


def crossings(lines_a: Sequence[CoarseLine], lines_b: Sequence[CoarseLine]) -> Float:
    """Meet all lines of one family with all of the other, (n_a, n_b, 2)."""
    lines = [*lines_a, *lines_b]
    origin, direction, bend = (np.stack([getattr(line, k) for line in lines]) for k in _COARSE)
    nodes, _ = meet_parabolas(origin, direction, bend, np.zeros((len(lines), 3, 3)), (len(lines_a), len(lines_b)))
    return nodes


def homography(plane: Float, image: Float, weights: Float | None = None) -> Float:
    """Least-squares homography (3, 3) from plane points (n, 2) to image points (n, 2), normalised, linear."""
    Tp, p = _normalise(plane)
    Ti, q = _normalise(image)
    n = len(p)
    A = np.zeros((2 * n, 9))
    A[0::2, 0:2], A[0::2, 2] = p, 1.0
    A[1::2, 3:5], A[1::2, 5] = p, 1.0
    A[0::2, 6:8], A[0::2, 8] = -q[:, :1] * p, -q[:, 0]
    A[1::2, 6:8], A[1::2, 8] = -q[:, 1:] * p, -q[:, 1]
    if weights is not None:
        A *= np.repeat(weights, 2)[:, None]
    _, vectors = np.linalg.eigh(A.T @ A)
    H = np.linalg.inv(Ti) @ vectors[:, 0].reshape(3, 3) @ Tp
    return np.asarray(H / H[2, 2])


def apply_homography(H: Float, points: Float) -> Float:
    """Map points (..., 2)."""
    p = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ H.T
    return np.asarray(p[..., :2] / p[..., 2:])


def _normalise(points: Float) -> tuple[Float, Float]:
    centre = points.mean(axis=0)
    scale = np.sqrt(2.0) / max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean())), 1e-12)
    T = np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])
    return T, (points - centre) * scale
