"""Analytic textures in material coordinates: speckle, line grid, fiducial dots.

A texture is the brightness of the material point (s, t), in mm on the undeformed surface. It is a formula with a seed,
so it has no resolution and no edge, and a point keeps its brightness under any motion.

Speckle: the material plane is divided into square cells; each holds one dark disc whose position and radius come from a
hash of the cell's indices. The union of the discs, with soft rims, is the paint. The rim is the C2 quintic step over a
stated width.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from stereorig.core.arrays import Float

SPECKLE: Final = 0
GRID: Final = 1
DOTS: Final = 2
# cell width over mean disc diameter at which half of the area is covered, found by counting; see
# tests/unit/sim/test_sim_scenes.py
_CELL_PER_DIAMETER: Final = 1.20
_RADIUS_SPREAD: Final = 0.35  # radii are uniform within +-35 % of the mean
_NO_NODES: Final = np.zeros((1, 1, 2))

_MIX_A: Final = np.uint64(0x9E3779B97F4A7C15)
_MIX_B: Final = np.uint64(0xBF58476D1CE4E5B9)
_MIX_C: Final = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S21, _S42 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(21), np.uint64(42)
_MASK21: Final = np.uint64((1 << 21) - 1)
_EDGE_REACH_SD: Final = 6.0  # a line's soft edge ends here, with 1e-9 left
_FAR_MM: Final = 1e9  # beyond it a cell's index is not exact
_UNIT: Final = 1.0 / float(1 << 21)


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A texture in the flat form that the kernels take.

    Attributes
    ----------
    kind
        ``SPECKLE``, ``GRID`` or ``DOTS``.
    parameters
        Numbers of that kind, see :func:`speckle`, :func:`line_grid`, :func:`dots`.
    nodes_mm
        (n_b, n_a, 2) positions of the grid's intersections; unused by the others.
    finest_mm
        Width of the finest feature's rim (one standard deviation or more); determines the sampling.
    """

    kind: int
    parameters: Float
    nodes_mm: Float
    finest_mm: float

    def paint(self, s_mm: Float, t_mm: Float, out: Float) -> None:
        """Write the brightness of material points into ``out`` (n,); NaN points leave their element as it is."""
        if self.kind == SPECKLE:
            _speckle(self.parameters, s_mm, t_mm, out)
        elif self.kind == GRID:
            _grid(self.parameters, self.nodes_mm, s_mm, t_mm, out)
        else:
            _dots(self.parameters, s_mm, t_mm, out)

    def value(self, st_mm: ArrayLike) -> Float:
        """Brightness (...) in [0, 1] at material points (..., 2) in mm."""
        st = np.asarray(st_mm, dtype=np.float64)
        out = np.full(st.shape[:-1], np.nan)
        flat = out.reshape(-1)
        self.paint(np.ascontiguousarray(st[..., 0]).reshape(-1), np.ascontiguousarray(st[..., 1]).reshape(-1), flat)
        return flat.reshape(st.shape[:-1])


def speckle(
    *, diameter_mm: float, seed: int, rim_mm: float | None = None, dark: float = 0.1, bright: float = 0.85
) -> Texture:
    """Random dark discs on bright paint, about half of the area covered, without limits.

    Parameters
    ----------
    diameter_mm
        Mean diameter of a disc; 3 to 5 pixels make a good pattern.
    seed
        Names the pattern; the same seed is the same specimen.
    rim_mm
        Width over which a disc's rim goes from bright to dark; a third of the diameter by default, like sprayed
        paint.
    dark, bright
        Brightness of disc and ground.
    """
    rim = 0.35 * diameter_mm if rim_mm is None else rim_mm
    if not 0.0 < rim <= 0.5 * diameter_mm:
        raise ValueError(f"rim_mm must lie in (0, {0.5 * diameter_mm:g}], got {rim:g}")
    cell = _CELL_PER_DIAMETER * diameter_mm
    par = np.array([cell, 0.5 * diameter_mm, 0.5 * rim, dark, bright, float(seed % (1 << 48))])
    return Texture(kind=SPECKLE, parameters=par, nodes_mm=_NO_NODES, finest_mm=0.2 * rim)


def line_grid(
    *,
    pitch_mm: float,
    lines: tuple[int, int],
    line_width_mm: float,
    node_tolerance_mm: float = 0.0,
    dark_lines: bool = True,
    seed: int = 0,
    edge_sd_mm: float | None = None,
    dark: float = 0.1,
    bright: float = 0.8,
) -> Texture:
    """Return the calibration target: two families of lines through nodes with errors up to the tolerance.

    Every node has an independent error, uniform within +-tolerance in s and in t, and lines run straight from node to
    node. (With uniform errors of +-4 um, "toleranced to 4 um" gives the known 0.087 px at 33 um/px.)

    Parameters
    ----------
    pitch_mm
        Spacing of lines.
    lines
        Numbers of lines crossed walking along s and along t; the origin is at the centre of the full set.
    line_width_mm
        Width of lines.
    node_tolerance_mm
        Half width of the uniform distribution of the nodes' errors, each axis.
    dark_lines
        Dark lines on bright ground, or the other way round.
    seed
        Seed of the nodes' errors.
    edge_sd_mm
        Softness of a line's edges (sd of the Gaussian); a twelfth of the line's width by default.
    dark, bright
        Brightness of the two.
    """
    n_a, n_b = lines
    if n_a < 2 or n_b < 2:
        raise ValueError(f"a grid needs two lines each way, got {lines}")
    x = (np.arange(n_a) - 0.5 * (n_a - 1)) * pitch_mm
    y = (np.arange(n_b) - 0.5 * (n_b - 1)) * pitch_mm
    ideal = np.stack(np.meshgrid(x, y), axis=-1)
    nodes = ideal + np.random.default_rng(seed).uniform(-node_tolerance_mm, node_tolerance_mm, ideal.shape)
    edge = line_width_mm / 12.0 if edge_sd_mm is None else edge_sd_mm
    line, ground = (dark, bright) if dark_lines else (bright, dark)
    worst = float(np.abs(nodes - ideal).max())
    par = np.array([pitch_mm, 0.5 * line_width_mm, edge, line, ground, worst])
    return Texture(kind=GRID, parameters=par, nodes_mm=nodes, finest_mm=edge)


def dots(*, pitch_mm: float, diameter_mm: float, rim_mm: float, dark: float = 0.1, bright: float = 0.85) -> Texture:
    """Single dark discs on a square lattice with one at the origin: fiducials for checks of the geometry."""
    par = np.array([pitch_mm, 0.5 * diameter_mm, 0.5 * rim_mm, dark, bright])
    return Texture(kind=DOTS, parameters=par, nodes_mm=_NO_NODES, finest_mm=0.2 * rim_mm)


@njit(cache=True, nogil=True, error_model="numpy")
def _mix(z: np.uint64) -> np.uint64:
    # splitmix64's finaliser: every input bit reaches every output bit
    z = (z ^ (z >> _S30)) * _MIX_B
    z = (z ^ (z >> _S27)) * _MIX_C
    return z ^ (z >> _S31)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_discs(i: int, j: int, par: Float, discs: Float) -> None:
    """Write centre and radius of the discs of the 3 x 3 cells around (i, j) into ``discs`` (9, 3), nearest first."""
    cell, radius, rim, seed = par[0], par[1], par[2], np.uint64(np.int64(par[5]))
    spread = _RADIUS_SPREAD
    # a disc must not reach beyond the neighbouring cell
    max_radius = cell - rim
    for k in range(9):
        m = (k + 4) % 9
        ci = i + m % 3 - 1
        cj = j + m // 3 - 1
        h = _mix(np.uint64(ci) * _MIX_A + _mix(np.uint64(cj) * _MIX_B + _mix(seed + _MIX_A)))
        discs[k, 0] = (ci + (np.float64(h & _MASK21) + 0.5) * _UNIT) * cell
        discs[k, 1] = (cj + (np.float64((h >> _S21) & _MASK21) + 0.5) * _UNIT) * cell
        r = radius * (1.0 + spread * (2.0 * np.float64((h >> _S42) & _MASK21) * _UNIT - 1.0))
        discs[k, 2] = min(r, max_radius)


@njit(cache=True, nogil=True, error_model="numpy")
def _rim_step(u: float) -> float:
    return u * u * u * (10.0 + u * (6.0 * u - 15.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _speckle(par: Float, s: Float, t: Float, out: Float) -> None:
    discs = np.empty((9, 3))
    cell, e, dark, contrast = par[0], par[2], par[3], par[4] - par[3]
    last_i, last_j = 0, 0
    fill_discs(0, 0, par, discs)
    for k in range(s.size):
        sk, tk = s[k], t[k]
        if not (abs(sk) < _FAR_MM and abs(tk) < _FAR_MM):
            continue  # nothing hit
        # the points come in rows, so the cell is mostly the last one
        i, j = int(np.floor(sk / cell)), int(np.floor(tk / cell))
        if i != last_i or j != last_j:
            fill_discs(i, j, par, discs)
            last_i, last_j = i, j
        v = 1.0  # share of the ground
        for n in range(9):
            dx = sk - discs[n, 0]
            dy = tk - discs[n, 1]
            d2 = dx * dx + dy * dy
            outer = discs[n, 2] + e
            if d2 < outer * outer:
                inner = discs[n, 2] - e
                if d2 <= inner * inner:
                    v = 0.0
                    break
                v *= _rim_step((np.sqrt(d2) - inner) / (2.0 * e))
        out[k] = dark + contrast * v


@njit(cache=True, nogil=True, error_model="numpy")
def _grid(par: Float, nodes: Float, s: Float, t: Float, out: Float) -> None:
    per_mm = 1.0 / par[0]
    n_b, n_a = nodes.shape[:2]
    centre_a, centre_b = 0.5 * (n_a - 1) + 0.5, 0.5 * (n_b - 1) + 0.5
    # no line is nearer to a point than its nominal distance less the worst node's error
    reach = par[1] + _EDGE_REACH_SD * par[2] + par[5]
    near = reach * per_mm
    for k in range(s.size):
        if not (abs(s[k]) < _FAR_MM and abs(t[k]) < _FAR_MM):
            continue
        a, b = s[k] * per_mm + centre_a, t[k] * per_mm + centre_b
        line_a, line_b = np.floor(a), np.floor(b)
        v = 1.0  # share of the ground
        if abs(a - line_a - 0.5) < near and 0 <= line_a < n_a:
            v -= _line_cover(par, nodes, s[k], t[k], 0)
        if abs(b - line_b - 0.5) < near and 0 <= line_b < n_b:
            v *= 1.0 - _line_cover(par, nodes, t[k], s[k], 1)
        out[k] = par[4] + (par[3] - par[4]) * (1.0 - v)


@njit(cache=True, nogil=True, error_model="numpy")
def _dots(par: Float, s: Float, t: Float, out: Float) -> None:
    for k in range(s.size):
        if abs(s[k]) < _FAR_MM and abs(t[k]) < _FAR_MM:
            dx = s[k] - np.floor(s[k] / par[0] + 0.5) * par[0]
            dy = t[k] - np.floor(t[k] / par[0] + 0.5) * par[0]
            u = (np.sqrt(dx * dx + dy * dy) - (par[1] - par[2])) / (2.0 * par[2])
            out[k] = par[3] + (par[4] - par[3]) * _rim_step(min(max(u, 0.0), 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _line_cover(par: Float, nodes: Float, across: float, along: float, family: int) -> float:
    """Return the coverage of a point by lines of family 0 (they cross s) or 1 (they cross t): 0 outside, 1 inside."""
    pitch, half, sd = par[0], par[1], par[2]
    n_line = nodes.shape[1] if family == 0 else nodes.shape[0]
    n_along = nodes.shape[0] if family == 0 else nodes.shape[1]
    line = int(np.floor(across / pitch + 0.5 * (n_line - 1) + 0.5))
    if line < 0 or line >= n_line:
        return 0.0
    seg = min(max(int(np.floor(along / pitch + 0.5 * (n_along - 1))), 0), n_along - 2)
    other = 1 - family
    # the segment between the displaced nodes at this position
    if seg > 0 and along < _node(nodes, line, seg, family, other):
        seg -= 1
    elif seg < n_along - 2 and along > _node(nodes, line, seg + 1, family, other):
        seg += 1
    c0 = _node(nodes, line, seg, family, family)
    c1 = _node(nodes, line, seg + 1, family, family)
    l0 = _node(nodes, line, seg, family, other)
    l1 = _node(nodes, line, seg + 1, family, other)
    slope = (c1 - c0) / (l1 - l0)
    off = (across - (c0 + slope * (along - l0))) / np.sqrt(1.0 + slope * slope)
    if abs(off) > half + _EDGE_REACH_SD * sd:
        return 0.0
    root = 1.0 / (1.4142135623730951 * sd)
    cover: float = 0.5 * (erf((half - off) * root) + erf((half + off) * root))
    # lines end half a line width behind the outermost crossings, so that the corners are square
    start = _node(nodes, line, 0, family, other) - half
    end = _node(nodes, line, n_along - 1, family, other) + half
    if along < start + _EDGE_REACH_SD * sd:
        cover *= 0.5 * (1.0 + erf((along - start) * root))
    if along > end - _EDGE_REACH_SD * sd:
        cover *= 0.5 * (1.0 + erf((end - along) * root))
    return float(cover)


@njit(cache=True, nogil=True, error_model="numpy")
def _node(nodes: Float, line: int, along: int, family: int, axis: int) -> float:
    return float(nodes[along, line, axis] if family == 0 else nodes[line, along, axis])
