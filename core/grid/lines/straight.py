"""The ``straight`` model: one distortion common to all lines, and each line straight without it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stereorig.core.arrays import Bool, Float
from stereorig.core.grid.lines.points import LineFit, LinePoints, frames, line_index, meet_straight

_BASE_TERMS = 5
_ALL_TERMS = 10
# prior standard deviation of each term, in units of half the image's diagonal: far beyond any lens for the terms
# that the lines show, but some combinations they do not show: with lines at exactly 45 degrees, (x^2 - y^2) u turns
# lines and bends none
_TERM_PRIOR = np.array([0.5, 0.002, 0.1, 0.02, 0.02, 0.1, 0.1, 0.02, 0.02, 0.002])
_MISFIT = 1.15  # chi^2 per degree of freedom below which no more terms are added
_MORE_TERMS_GAIN = 60.0  # fall of chi^2 that five more terms must bring; five would fall by 5 by chance


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


def fit_straight(
    points: LinePoints, counts: tuple[int, int], size: tuple[int, int], node_sigma_px: float, used: Bool
) -> tuple[LineFit, Distortion, Float]:
    """Fit all lines and the distortion together.

    Returns
    -------
    LineFit
        With the intersections' covariance from the points' own noise.
    Distortion
        Common to all lines.
    normal
        (n_line, 2) across each line in coordinates without distortion.
    """
    centre = np.array([0.5 * (size[0] - 1), 0.5 * (size[1] - 1)])
    scale = 0.5 * float(np.hypot(*size))
    u = (points.xy_px - centre) / scale
    index = line_index(points, counts)
    n_line = sum(counts)
    variance = points.sigma_px**2 + node_sigma_px**2
    weight = np.where(used, 1.0 / variance, 0.0)

    def solve(n_terms: int) -> _Adjusted:
        D = np.zeros(n_terms)
        origin, direction, normal = frames(points, u, counts)
        for _ in range(3):  # the distance along the line depends on D; three rounds settle it far below 1e-6 px
            v = u + distortion_terms(u, n_terms) @ D
            origin, direction, normal = frames(points, v, counts)
            t = np.sum((v - origin[index]) * direction[index], axis=-1)
            J = np.zeros((len(u), 2 * n_line + n_terms))
            rows = np.arange(len(u))
            J[rows, 2 * index] = 1.0
            J[rows, 2 * index + 1] = t
            J[:, 2 * n_line :] = -np.einsum("nk,nkm->nm", normal[index], distortion_terms(u, n_terms))
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
    distortion = Distortion(centre, scale, D)
    # noise of the solution from the points' own noise alone
    A = np.linalg.solve(result.N, result.JW.T)
    covariance = np.einsum("in,jn->ij", A * (points.sigma_px / scale) ** 2, A)
    alpha, beta = solution[0 : 2 * n_line : 2], solution[1 : 2 * n_line : 2]
    point = origin + alpha[:, None] * normal
    along = direction + beta[:, None] * normal
    straight = meet_straight(point, along, counts)
    nodes = distortion.distort(straight)
    cov = _straight_covariance(straight, origin, direction, normal, covariance, distortion, nodes, counts)
    return LineFit(nodes, cov, result.residual_px, variance, straight), distortion, normal


def _straight_covariance(
    straight: Float,
    origin: Float,
    direction: Float,
    normal: Float,
    covariance: Float,
    distortion: Distortion,
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


# A smooth distortion that bends all straight lines of an image.


@dataclass(frozen=True)
class Distortion:
    """Distortion v = u + sum D_m f_m(u), in units of half the image's diagonal about its centre."""

    centre_px: Float
    scale_px: float
    D: Float

    def terms(self, u: Float) -> Float:
        """Return f_m(u), (..., 2, m)."""
        return distortion_terms(u, len(self.D))

    def gradient(self, xy_px: Float, normal: Float) -> Float:
        """Return unit vectors (..., 2) in the image across lines whose normals in corrected coordinates are given."""
        u = (xy_px - self.centre_px) / self.scale_px
        h = 1e-5
        steps = [(self.terms(u + d) - self.terms(u - d)) @ self.D / (2.0 * h) for d in h * np.eye(2)]
        across = normal + np.stack([np.sum(normal * step, axis=-1) for step in steps], axis=-1)
        return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))

    def distort(self, v: Float) -> Float:
        """Return image positions (..., 2), px, of v."""
        u = v.copy()
        for _ in range(12):
            u = v - self.terms(u) @ self.D
        return u * self.scale_px + self.centre_px


def distortion_terms(u: Float, n: int) -> Float:
    """Return the first n of f_m at u (..., 2), (..., 2, n)."""
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
