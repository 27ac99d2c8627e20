"""The paper's localiser: dark pixels, weighted by their distance from the threshold, and one parabola a line.

"Non-oblique": the parabola is y(x), or x(y) for a line steeper than 45 degrees, so that least squares is linear. Every
pixel below the threshold on the line, away from the crossings, is a data point with the weight threshold - grey level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from stereorig.core.arrays import Bool, Float, Float32
from stereorig.core.grid.piece_table import PieceTable
from stereorig.core.grid.strip import in_strip, strip_bounds

# share of the depth, below the ground: nearer to the ground noise rules, further down the few pixels left beat with the
# lattice; between 0.15 and 0.3 the error on the paper's rig is 0.0043 px an axis, at 0.5 it is 0.007
THRESHOLD = 0.22
_BLURS = 4.0


@dataclass(frozen=True)
class Parabolas:
    """One non-oblique parabola a line.

    Attributes
    ----------
    steep
        (n,) True where x is a function of y.
    centre_px
        (n, 2) reference point.
    coefficients
        (n, 3) of v = c0 + c1 u + c2 u^2 with u, v = x, y from the reference, exchanged on steep lines.
    covariance
        (n, 3, 3).
    """

    steep: Bool
    centre_px: Float
    coefficients: Float
    covariance: Float


@njit(cache=True, nogil=True)
def _collect(
    image: Float32,
    rows: Float,
    fits: Float,
    use: Bool,
    line: Float,
    steep: Bool,
    centre: Float,
    share: float,
    guard_blurs: float,
    sign: float,
    N: Float,
    g: Float,
) -> None:
    for k in range(rows.shape[0]):
        if not use[k]:
            continue
        f = fits[k]
        piece = rows[k].copy()
        piece[0] += -piece[3] * f[0]
        piece[1] += piece[2] * f[0]
        spread = np.sqrt(f[10] * f[10] + 1.0 / 12.0)
        reach = 0.5 * piece[14] + guard_blurs * spread
        guard = 0.5 * piece[14] + 5.0 * spread
        m = int(line[k])
        depth = abs(f[5]) * f[16]
        x0, x1, y0, y1 = strip_bounds(piece, reach, image.shape[0], image.shape[1])
        for y in range(y0, y1):
            for x in range(x0, x1):
                inside, t, d = in_strip(piece, float(x), float(y), reach, guard)
                if not inside:
                    continue
                ground = f[7] + f[8] * t + f[9] * (d + f[0])
                w = sign * (image[y, x] - ground) - share * depth
                if w <= 0.0:
                    continue
                u = x - centre[m, 0]
                v = y - centre[m, 1]
                if steep[m]:
                    u, v = v, u
                p = 1.0
                for i in range(5):
                    N[k, i] += w * p
                    if i < 3:
                        g[k, i] += w * p * v
                    p *= u


def dark_pixel_lines(image: Float32, table: PieceTable, fits: Float, good: Bool, *, dark_lines: bool) -> Parabolas:
    """Fit each line's parabola to its dark pixels.

    Parameters
    ----------
    image
        (rows, columns) grey levels.
    table, fits, good
        Pieces, their ground and depth, and True for those to use. The pieces' positions only bound the search.
    dark_lines
        Sign of the contrast.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a line has no dark pixels to speak of.
    """
    index = table.line_index()
    n_line = int(sum(table.counts))
    ends = table.ends_px()
    centre = np.stack([ends[index == k].reshape(-1, 2).mean(axis=0) for k in range(n_line)])
    chord = np.stack([ends[index == k][-1, 1] - ends[index == k][0, 0] for k in range(n_line)])
    steep = np.abs(chord[:, 1]) > np.abs(chord[:, 0])
    n_piece = len(index)
    N, g = np.zeros((n_piece, 5)), np.zeros((n_piece, 3))
    _collect(
        image,
        table.rows,
        fits,
        good,
        index.astype(np.float64),
        steep,
        centre,
        THRESHOLD,
        _BLURS,
        -1.0 if dark_lines else 1.0,
        N,
        g,
    )
    M = N[:, np.add.outer(np.arange(3), np.arange(3))]  # (n_piece, 3, 3) normal equations of each piece
    seen = N[:, 0] > 0.0
    coefficients, inverse = np.zeros((n_line, 3)), np.zeros((n_line, 3, 3))
    for k in range(n_line):
        mine = (index == k) & seen
        if np.count_nonzero(mine) < 4:
            raise np.linalg.LinAlgError(f"line {k} has dark pixels on {np.count_nonzero(mine)} pieces")
        inverse[k] = np.linalg.inv(M[mine].sum(axis=0))
        coefficients[k] = inverse[k] @ g[mine].sum(axis=0)
    # the pixels' spread is the line's width, not noise: the residual of each piece's mean is noise
    left = (g - np.einsum("kij,kj->ki", M, coefficients[index]))[seen]
    variance = float(np.sum((left[:, 0] / N[seen, 0]) ** 2)) / max(int(seen.sum()) - 3 * n_line, 1)
    spread = np.zeros((n_line, 3, 3))
    np.add.at(spread, index[seen], variance * np.einsum("ki,kj->kij", N[seen, :3], N[seen, :3]))
    return Parabolas(steep, centre, coefficients, inverse @ spread @ inverse)


def meet_non_oblique(parabolas: Parabolas, start_px: Float) -> tuple[Float, Float]:
    """Meet the parabolas of both families by Newton's method.

    Parameters
    ----------
    parabolas
        Family a first.
    start_px
        (n_a, n_b, 2) start values.

    Returns
    -------
    nodes, covariance
        (n_a, n_b, 2) and (n_a, n_b, 2, 2).
    """
    na = start_px.shape[0]
    x = start_px.copy()
    gradient = np.empty((*x.shape, 2))
    for _ in range(8):
        fa, gradient[..., 0, :] = _value(parabolas, slice(None, na), x, family_axis=0)
        fb, gradient[..., 1, :] = _value(parabolas, slice(na, None), x, family_axis=1)
        x = x - np.linalg.solve(gradient, np.stack([fa, fb], axis=-1)[..., None])[..., 0]
    across = np.zeros_like(gradient)
    for axis, part in ((0, slice(None, na)), (1, slice(na, None))):
        u, _ = _local(parabolas, part, x, axis)
        powers = np.stack([np.ones_like(u), u, u * u], axis=-1)
        C = parabolas.covariance[part]
        C = C[:, None] if axis == 0 else C[None]
        across[..., axis, axis] = np.einsum("ijk,ijkl,ijl->ij", powers, np.broadcast_to(C, (*u.shape, 3, 3)), powers)
    inverse = np.linalg.inv(gradient)
    return x, inverse @ across @ np.swapaxes(inverse, -1, -2)


def _local(parabolas: Parabolas, part: slice, x: Float, family_axis: int) -> tuple[Float, Float]:
    centre, steep = parabolas.centre_px[part], parabolas.steep[part]
    d = x - (centre[:, None] if family_axis == 0 else centre[None])
    steep = steep[:, None] if family_axis == 0 else steep[None]
    return np.where(steep, d[..., 1], d[..., 0]), np.where(steep, d[..., 0], d[..., 1])


def _value(parabolas: Parabolas, part: slice, x: Float, *, family_axis: int) -> tuple[Float, Float]:
    """Return v - c(u) at the points, (n_a, n_b), and its gradient in x and y."""
    u, v = _local(parabolas, part, x, family_axis)
    c = parabolas.coefficients[part]
    steep = parabolas.steep[part]
    c, steep = (c[:, None], steep[:, None]) if family_axis == 0 else (c[None], steep[None])
    value = v - (c[..., 0] + u * (c[..., 1] + u * c[..., 2]))
    slope = -(c[..., 1] + 2.0 * u * c[..., 2])
    one = np.ones_like(slope)
    return value, np.stack([np.where(steep, one, slope), np.where(steep, slope, one)], axis=-1)
