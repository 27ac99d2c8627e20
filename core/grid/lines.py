"""Intersections from line points: three models of a line through its pieces.

``straight``: the lines of the grid are straight, and one smooth distortion, the same for all, bends them in the image.
In corrected coordinates v = u + sum_m D_m f_m(u) each line is straight; f_m holds Seidel's term for any aspect ratio,
r^2 u and (x^2 - y^2) u, its shift by a wrong centre, r^2 e_x and r^2 e_y, and, where the lines ask for them, higher
powers. The condition is linear in D and in each line's two numbers. Terms that map straight lines to straight lines
have no effect and are not needed.

``parabola``: each line by itself, offset = p0 + p1 t + p2 t^2.

``local``: on top of the straight model, each line is a polygon whose corners are the intersections.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.grid.view import LineModel, LineOffsets

_BASE_TERMS = 5
_ALL_TERMS = 10
# prior standard deviation of each term, in units of half the image's diagonal: far beyond any lens for the terms
# that the lines show, but some combinations they do not show: with lines at exactly 45 degrees, (x^2 - y^2) u turns
# lines and bends none
_TERM_PRIOR = np.array([0.5, 0.002, 0.1, 0.02, 0.02, 0.1, 0.1, 0.02, 0.02, 0.002])
_MISFIT = 1.15  # chi^2 per degree of freedom below which no more terms are added
_MORE_TERMS_GAIN = 60.0  # fall of chi^2 that five more terms must bring; five would fall by 5 by chance


@dataclass(frozen=True)
class LinePoints:
    """Sub-pixel points on lines.

    Attributes
    ----------
    xy_px
        (n, 2).
    normal
        (n, 2) unit vector across the line.
    sigma_px
        (n,) standard deviation across the line, from the image's noise.
    family, line, along
        (n,) 0 or 1; number of the line; position along the line in units of the pitch.
    """

    xy_px: Float
    normal: Float
    sigma_px: Float
    family: NDArray[np.intp]
    line: NDArray[np.intp]
    along: Float


@dataclass(frozen=True)
class LineFit:
    """Lines of both families under one model.

    Attributes
    ----------
    nodes_px
        (n_a, n_b, 2) all intersections.
    covariance_px2
        (n_a, n_b, 2, 2) from the line points' own noise.
    residual_px
        (n,) of each line point across its line.
    variance_px2
        (n,) that the fit weighted it with.
    straight_px
        (n_a, n_b, 2) intersections in coordinates without distortion, up to a projective map; equal to ``nodes_px``
        under the parabola model.
    line_offsets
        Joint covariance along each line, see :class:`core.grid.view.LineOffsets`; of the local model only.
    """

    nodes_px: Float
    covariance_px2: Float
    residual_px: Float
    variance_px2: Float
    straight_px: Float
    line_offsets: LineOffsets | None = None


@dataclass(frozen=True)
class _Distortion:
    """Distortion v = u + sum D_m f_m(u), in units of half the image's diagonal about its centre."""

    centre_px: Float
    scale_px: float
    D: Float

    def terms(self, u: Float) -> Float:
        """Return f_m(u), (..., 2, m)."""
        return _terms(u, len(self.D))

    def correct(self, xy_px: Float) -> Float:
        u = (xy_px - self.centre_px) / self.scale_px
        return u + self.terms(u) @ self.D

    def gradient(self, xy_px: Float, normal: Float) -> Float:
        """Return unit vectors (..., 2) in the image across lines whose normals in corrected coordinates are given."""
        u = (xy_px - self.centre_px) / self.scale_px
        h = 1e-5
        steps = [(self.terms(u + d) - self.terms(u - d)) @ self.D / (2.0 * h) for d in h * np.eye(2)]
        across = normal + np.stack([np.sum(normal * step, axis=-1) for step in steps], axis=-1)
        return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))

    def distort(self, v: Float) -> Float:
        u = v.copy()
        for _ in range(12):
            u = v - self.terms(u) @ self.D
        return u * self.scale_px + self.centre_px


def _terms(u: Float, n: int) -> Float:
    x, y = u[..., 0], u[..., 1]
    r2 = x * x + y * y
    zero = np.zeros_like(x)
    columns = [
        (r2 * x, r2 * y),
        ((x * x - y * y) * x, (x * x - y * y) * y),
        (r2 * r2 * x, r2 * r2 * y),
        (r2, zero),
        (zero, r2),
        (r2**3 * x, r2**3 * y),
        (r2**4 * x, r2**4 * y),
        (r2 * r2, zero),
        (zero, r2 * r2),
        (x**4 * x, x**4 * y),
    ][:n]
    return np.stack([np.stack(c, axis=-1) for c in columns], axis=-1)


def fit_lines(
    points: LinePoints,
    *,
    counts: tuple[int, int],
    image_size_px: tuple[int, int],
    model: LineModel,
    node_sigma_px: float,
    used: Bool,
) -> LineFit:
    """Fit all lines and meet them.

    Parameters
    ----------
    points
        Line points; those with ``used`` False get a residual but no weight.
    counts
        (n_a, n_b) lines.
    image_size_px
        Columns and rows, for the distortion's centre and scale.
    model
        See the module.
    node_sigma_px
        Standard deviation across a line of the maker's node errors, which the models of whole lines average.
    used
        (n,) points to use.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a line has too few points.
    """
    if model == "parabola":
        return _fit_parabolas(points, counts, node_sigma_px, used)
    fit, distortion, normal = _fit_straight(points, counts, image_size_px, node_sigma_px, used)
    if model == "straight":
        return fit
    return _fit_polygons(points, counts, fit, distortion, normal, used)


def _frames(points: LinePoints, v: Float, counts: tuple[int, int]) -> tuple[Float, Float, Float]:
    """Per line: a point, its direction and its normal, in the coordinates of ``v``; (n_line, 2) each."""
    n = sum(counts)
    index = _line_index(points, counts)
    origin, direction = np.zeros((n, 2)), np.zeros((n, 2))
    for k in range(n):
        mine = v[index == k]
        if len(mine) < 4:
            raise np.linalg.LinAlgError(f"line {k} has {len(mine)} points")
        origin[k] = mine.mean(axis=0)
        d = mine - origin[k]
        direction[k] = np.linalg.eigh(d.T @ d)[1][:, 1]
    return origin, direction, np.stack([-direction[:, 1], direction[:, 0]], axis=-1)


def _line_index(points: LinePoints, counts: tuple[int, int]) -> NDArray[np.intp]:
    return points.line + np.where(points.family == 0, 0, counts[0])


class _Adjusted(NamedTuple):
    """Straight lines and terms of distortion, adjusted together.

    The offsets and slopes of the lines across ``direction``, then the terms; residuals, px; the normal equations, and
    the weighted design; of each line the point, direction and normal of its parametrisation.
    """

    solution: Float
    residual_px: Float
    N: Float
    JW: Float
    origin: Float
    direction: Float
    normal: Float


def _fit_straight(
    points: LinePoints, counts: tuple[int, int], size: tuple[int, int], node_sigma_px: float, used: Bool
) -> tuple[LineFit, _Distortion, Float]:
    centre = np.array([0.5 * (size[0] - 1), 0.5 * (size[1] - 1)])
    scale = 0.5 * float(np.hypot(*size))
    u = (points.xy_px - centre) / scale
    index = _line_index(points, counts)
    n_line = sum(counts)
    variance = points.sigma_px**2 + node_sigma_px**2
    weight = np.where(used, 1.0 / variance, 0.0)

    def solve(n_terms: int) -> _Adjusted:
        D = np.zeros(n_terms)
        origin, direction, normal = _frames(points, u, counts)
        for _ in range(3):  # the distance along the line depends on D; three rounds settle it far below 1e-6 px
            v = u + _terms(u, n_terms) @ D
            origin, direction, normal = _frames(points, v, counts)
            t = np.sum((v - origin[index]) * direction[index], axis=-1)
            J = np.zeros((len(u), 2 * n_line + n_terms))
            rows = np.arange(len(u))
            J[rows, 2 * index] = 1.0
            J[rows, 2 * index + 1] = t
            J[:, 2 * n_line :] = -np.einsum("nk,nkm->nm", normal[index], _terms(u, n_terms))
            y = np.sum((u - origin[index]) * normal[index], axis=-1)
            JW = J * weight[:, None]
            N = np.einsum("ni,nj->ij", JW, J)  # too small for threads
            N[np.diag_indices(len(N))] *= 1.0 + 1e-12
            prior = np.arange(2 * n_line, len(N))
            N[prior, prior] += 1.0 / (_TERM_PRIOR[:n_terms] * scale) ** 2
            solution = np.linalg.solve(N, JW.T @ y)
            D = solution[2 * n_line :]
        residual = (y - J @ solution) * scale
        return _Adjusted(solution, residual, N, JW, origin, direction, normal)

    result = solve(_BASE_TERMS)
    chi2 = float(np.sum(weight * result.residual_px**2))
    dof = max(int(used.sum()) - 2 * n_line - _BASE_TERMS, 1)
    if chi2 > _MISFIT * dof:
        richer = solve(_ALL_TERMS)
        chi2_richer = float(np.sum(weight * richer.residual_px**2))
        if (chi2 - chi2_richer) / max(1.0, chi2_richer / dof) > _MORE_TERMS_GAIN:
            result = richer
    solution, origin, direction, normal = result.solution, result.origin, result.direction, result.normal
    D = solution[2 * n_line :]
    distortion = _Distortion(centre, scale, D)
    # noise of the solution from the points' own noise alone
    A = np.linalg.solve(result.N, result.JW.T)
    covariance = np.einsum("in,jn->ij", A * (points.sigma_px / scale) ** 2, A)
    alpha, beta = solution[0 : 2 * n_line : 2], solution[1 : 2 * n_line : 2]
    point = origin + alpha[:, None] * normal
    along = direction + beta[:, None] * normal
    straight = _meet_straight(point, along, counts)
    nodes = distortion.distort(straight)
    cov = _straight_covariance(straight, origin, direction, normal, covariance, distortion, nodes, counts)
    return LineFit(nodes, cov, result.residual_px, variance, straight), distortion, normal


def _meet_straight(point: Float, along: Float, counts: tuple[int, int]) -> Float:
    na = counts[0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    c = np.sum(normal * point, axis=-1)
    (ax, ay), (bx, by) = normal[:na].T, normal[na:].T
    det = ax[:, None] * by[None, :] - ay[:, None] * bx[None, :]
    x = (c[:na, None] * by[None, :] - c[None, na:] * ay[:, None]) / det
    y = (ax[:, None] * c[None, na:] - bx[None, :] * c[:na, None]) / det
    return np.stack([x, y], axis=-1)


def _straight_covariance(
    straight: Float,
    origin: Float,
    direction: Float,
    normal: Float,
    covariance: Float,
    distortion: _Distortion,
    nodes_px: Float,
    counts: tuple[int, int],
) -> Float:
    """Noise of the intersections: the two lines' offsets there, each moved also by the distortion's terms."""
    na, nb = counts
    n_line = na + nb
    u = (nodes_px - distortion.centre_px) / distortion.scale_px
    f = distortion.terms(u)
    out = np.empty((na, nb, 2, 2))
    for i in range(na):
        for j in range(nb):
            a, b = i, na + j
            rows = np.zeros((2, covariance.shape[0]))
            for r, k in ((0, a), (1, b)):
                rows[r, 2 * k] = 1.0
                rows[r, 2 * k + 1] = (straight[i, j] - origin[k]) @ direction[k]
                rows[r, 2 * n_line :] = -normal[k] @ f[i, j]
            # offsets across both lines -> position, in image coordinates
            to_position = np.linalg.inv(np.stack([normal[a], normal[b]])) @ rows
            out[i, j] = to_position @ covariance @ to_position.T
    return out * distortion.scale_px**2


def _fit_parabolas(points: LinePoints, counts: tuple[int, int], node_sigma_px: float, used: Bool) -> LineFit:
    index = _line_index(points, counts)
    n_line = sum(counts)
    origin, direction, normal = _frames(points, points.xy_px, counts)
    variance = points.sigma_px**2 + node_sigma_px**2
    bend = np.zeros((n_line, 3))
    cov = np.zeros((n_line, 3, 3))
    residual = np.empty(len(index))
    for k in range(n_line):
        mine = index == k
        d = points.xy_px[mine] - origin[k]
        t, y = d @ direction[k], d @ normal[k]
        J = np.stack([np.ones_like(t), t, t * t], axis=-1)
        W = np.where(used[mine], 1.0 / variance[mine], 0.0)
        if np.count_nonzero(W) < 4:
            raise np.linalg.LinAlgError(f"line {k} has {np.count_nonzero(W)} points")
        A = np.linalg.solve((J * W[:, None]).T @ J, (J * W[:, None]).T)
        bend[k] = A @ y
        cov[k] = (A * points.sigma_px[mine] ** 2) @ A.T
        residual[mine] = y - J @ bend[k]
    nodes, node_cov = meet_parabolas(origin, direction, bend, cov, counts)
    return LineFit(nodes, node_cov, residual, variance, nodes)


def meet_parabolas(
    origin: Float, direction: Float, bend: Float, covariance: Float, counts: tuple[int, int]
) -> tuple[Float, Float]:
    """Meet lines that are parabolas across their own directions.

    Parameters
    ----------
    origin, direction
        (n, 2) of each line, family a first.
    bend, covariance
        (n, 3) offset along the normal (-dy, dx), lowest power first, and (n, 3, 3).
    counts
        (n_a, n_b).

    Returns
    -------
    nodes, covariance
        (n_a, n_b, 2) and (n_a, n_b, 2, 2).
    """
    na, nb = counts
    normal = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    oa, da, ma, ba = (v[:na, None] for v in (origin, direction, normal, bend))
    ob, db, mb, bb = (v[None, na:] for v in (origin, direction, normal, bend))
    x = _meet_straight(origin + bend[:, :1] * normal, direction + bend[:, 1:2] * normal, counts)
    ga = gb = np.zeros((na, nb, 2))
    for _ in range(6):
        ta, tb = np.sum((x - oa) * da, axis=-1), np.sum((x - ob) * db, axis=-1)
        fa = np.sum((x - oa) * ma, axis=-1) - (ba[..., 0] + ta * (ba[..., 1] + ta * ba[..., 2]))
        fb = np.sum((x - ob) * mb, axis=-1) - (bb[..., 0] + tb * (bb[..., 1] + tb * bb[..., 2]))
        ga = ma - (ba[..., 1] + 2.0 * ta * ba[..., 2])[..., None] * da
        gb = mb - (bb[..., 1] + 2.0 * tb * bb[..., 2])[..., None] * db
        x = x - np.linalg.solve(np.stack([ga, gb], axis=-2), np.stack([fa, fb], axis=-1)[..., None])[..., 0]
    ta, tb = np.sum((x - oa) * da, axis=-1), np.sum((x - ob) * db, axis=-1)
    pa, pb = (np.stack([np.ones_like(t), t, t * t], axis=-1) for t in (ta, tb))
    va = np.einsum("ijk,ikl,ijl->ij", pa, covariance[:na], pa)
    vb = np.einsum("ijk,jkl,ijl->ij", pb, covariance[na:], pb)
    inverse = np.linalg.inv(np.stack([ga, gb], axis=-2))
    across = np.zeros((na, nb, 2, 2))
    across[..., 0, 0], across[..., 1, 1] = va, vb
    return x, inverse @ across @ np.swapaxes(inverse, -1, -2)


def _fit_polygons(
    points: LinePoints, counts: tuple[int, int], fit: LineFit, distortion: _Distortion, normal: Float, used: Bool
) -> LineFit:
    """Move the straight model's intersections across each line by a polygon through its own points' residuals."""
    na, nb = counts
    index = _line_index(points, counts)
    offset = np.zeros((na, nb, 2))
    covariance_a, covariance_b = np.zeros((na, nb, nb)), np.zeros((nb, na, na))
    residual = fit.residual_px.copy()
    for k in range(na + nb):
        mine = index == k
        n_node = nb if k < na else na
        knot = np.clip(np.floor(points.along[mine]).astype(int), 0, n_node - 2)
        f = points.along[mine] - knot
        J = np.zeros((len(f), n_node))
        J[np.arange(len(f)), knot] = 1.0 - f
        J[np.arange(len(f)), knot + 1] = f
        W = np.where(used[mine], 1.0 / points.sigma_px[mine] ** 2, 0.0)
        N = (J * W[:, None]).T @ J
        # a corner without points on either side takes its neighbours' mean: a weak tie of second differences
        S = np.diff(np.eye(n_node), 2, axis=0)
        N += 1e-6 * np.median(W) * S.T @ S
        A = np.linalg.solve(N, (J * W[:, None]).T)
        corner = A @ fit.residual_px[mine]
        # the points' noise is that across the line in the image, where the offsets' covariance holds too: the scale of
        # the corrected coordinates changes little between a corner and the points beside it
        noise = (A * points.sigma_px[mine] ** 2) @ A.T
        residual[mine] = fit.residual_px[mine] - J @ corner
        if k < na:
            offset[k, :, 0], covariance_a[k] = corner, noise
        else:
            offset[:, k - na, 1], covariance_b[k - na] = corner, noise
    M = np.zeros((na, nb, 2, 2))
    M[..., 0, :] = normal[:na, None]
    M[..., 1, :] = normal[None, na:]
    move = np.linalg.solve(M, offset[..., None])[..., 0] / distortion.scale_px
    straight = fit.straight_px + move
    nodes = distortion.distort(straight)
    across = np.stack([distortion.gradient(nodes, M[..., r, :]) for r in range(2)], axis=-2)
    inverse = np.linalg.inv(across)
    V = np.zeros((na, nb, 2, 2))
    V[..., 0, 0] = np.einsum("ijj->ij", covariance_a)
    V[..., 1, 1] = np.einsum("jii->ij", covariance_b)
    inner = slice(1, -1)
    offsets = LineOffsets(
        normal_a=across[inner, inner, 0],
        normal_b=across[inner, inner, 1],
        covariance_a=covariance_a[inner, inner, inner],
        covariance_b=covariance_b[inner, inner, inner],
    )
    covariance = inverse @ V @ np.swapaxes(inverse, -1, -2)
    return LineFit(nodes, covariance, residual, points.sigma_px**2, straight, offsets)
