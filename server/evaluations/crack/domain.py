"""Local fits of the displacements on one side of the crack, J as an integral over a ring, and the faces' opening.

With q = 1 at the inner edge of a ring, 0 at the outer one and linear between, and faces that are straight and free,

    J = integral over the ring of (s_ij u_j,1 - W d_1i) q,i

(Li, Shih, Needleman 1985). The ring ends at the crack's faces: gradients there come from points of the same side alone.
With g the gradients, J = sum of weight g' H g: a quadratic form of the displacements, whose noise adds its trace.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array, kron

from stereorig.core.arrays import Bool, Float
from stereorig.server.evaluations.crack.points import Points
from stereorig.server.evaluations.crack.series import SeriesFit, seen_terms, terms_at
from stereorig.server.evaluations.crack.settings import Elastic

_NEAREST = 24  # points of a local quadratic
_FROM = 4.0  # spacings from the innermost points from which so many are near
_FARTHEST = 0.75  # share of the distance from the tip within which they must lie
_ANGLES, _RADII = 60, 4  # places on a ring
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(_RADII)


class LocalFits(NamedTuple):
    """Values and gradients at m places as weights (m, n) of n points; ``found`` (m,) where these are near enough."""

    value: csr_array
    by_x: csr_array
    by_y: csr_array
    found: Bool


def local_fits(points: Points, tip_mm: Float, at_mm: Float, sides: Float) -> LocalFits:
    """Fit quadratics to the points nearest to places (m, 2); those behind the tip have a side (m,), +1 or -1."""
    apart = points.xy_mm[None] - at_mm[:, None]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    point, place = points.xy_mm - tip_mm, at_mm - tip_mm
    # a line from a place to a point of the other side meets y = 0 at this x
    height = place[:, 1, None] - point[None, :, 1]
    fall = np.where(height == 0.0, np.inf, height)
    meets = place[:, 0, None] - place[:, 1, None] * (place[:, 0, None] - point[None, :, 0]) / fall
    other = np.sign(point[None, :, 1]) != sides[:, None]
    distance = np.where(other & (meets < 0.0), np.inf, distance)
    near = np.argpartition(distance, _NEAREST, axis=1)[:, :_NEAREST]
    rows = np.arange(len(at_mm))[:, None]
    reach = distance[rows, near].max(axis=1)
    found = np.isfinite(reach) & (reach <= _FARTHEST * np.hypot(place[:, 0], place[:, 1]))
    size = np.where(found, reach, 1.0)[:, None]
    a, b = (apart[rows, near, k] / size for k in (0, 1))
    weight = np.clip(1.0 - (np.hypot(a, b) / 1.2) ** 2, 0.0, None)
    terms = np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=-1) * weight[..., None]
    solve = np.linalg.pinv(np.where(found[:, None, None], terms, 0.0)) * weight[:, None, :]
    every = np.broadcast_to(rows, near.shape).ravel()
    shape = (len(at_mm), len(points.at))
    value, by_x, by_y = (
        coo_array((one.ravel(), (every, near.ravel())), shape=shape).tocsr()
        for one in (solve[:, 0], solve[:, 1] / size, solve[:, 2] / size)
    )
    return LocalFits(value, by_x, by_y, found)


@dataclass(frozen=True, eq=False)
class RingIntegral:
    """J over a ring, N/mm.

    Attributes
    ----------
    value
        Without what the noise adds, and with what subsets and local fits lose of the fitted series.
    gain, square
        (n, 2) derivative over the displacements, and variance from the noise' own square.
    slope, strain
        Root mean square of the slope of w over the ring, and of the strain in the plane.
    """

    value: float
    gain: Float
    square: float
    slope: float
    strain: float


def ring_integral(
    points: Points, fit: SeriesFit, elastic: Elastic, inner_mm: float, outer_mm: float
) -> RingIntegral | None:
    """Return J over a ring about the fitted tip; None if parts of the ring have too few points."""
    angle = (np.arange(_ANGLES) + 0.5) / _ANGLES * 2.0 * np.pi - np.pi
    radius = 0.5 * (inner_mm + outer_mm) + 0.5 * (outer_mm - inner_mm) * _NODES
    way = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    at = (fit.tip_mm + radius[:, None, None] * way).reshape(-1, 2)
    area = (0.5 * (outer_mm - inner_mm) * _WEIGHTS * radius)[:, None] * np.full(_ANGLES, 2.0 * np.pi / _ANGLES)
    fits = local_fits(points, fit.tip_mm, at, np.sign(np.tile(way[:, 1], _RADII)))
    if not fits.found.all():
        return None
    falls = np.tile(-way / (outer_mm - inner_mm), (_RADII, 1))
    forms = _forms(elastic, falls) * area.ravel()[:, None, None]
    whole = _operator(fits)
    model = seen_terms(points, fit.tip_mm, fit.order, elastic.kappa) @ fit.terms
    g, of_series = ((whole @ uv.ravel()).reshape(-1, 4) for uv in (points.uv_mm, model))
    seen, of_model = (float(np.einsum("ma,mab,mb->", one, forms, one)) for one in (g, of_series))
    spread = points.spread_of(whole).reshape(len(at), 4, len(at), 4)
    # the noise' own square: its mean, and its variance as twice the trace of (H C H C)
    mean = float(np.einsum("mab,mbma->", forms, spread))
    turned = np.einsum("mab,mbnc->manc", forms, spread).reshape(4 * len(at), -1)
    square = 2.0 * float(np.einsum("ij,ji->", turned, turned))
    gain = 2.0 * (whole.T @ np.einsum("mab,mb->ma", forms, g).ravel()).reshape(-1, 2)
    lost = j_of_series(fit, elastic) - of_model
    w = points.uvw_mm[:, 2]
    slope = (fits.by_x @ w) ** 2 + (fits.by_y @ w) ** 2
    strain = g[:, 0] ** 2 + g[:, 3] ** 2 + 0.5 * (g[:, 1] + g[:, 2]) ** 2
    slope_rms, strain_rms = (float(np.sqrt((area.ravel() / area.sum()) @ one)) for one in (slope, strain))
    return RingIntegral(seen - mean + lost, gain, square, slope_rms, strain_rms)


def rings(inner_mm: float, outer_mm: float, spacing_mm: float, count: int) -> list[tuple[float, float]]:
    """Return the rings that J is compared on, and the whole of them last; none if there is no room for them."""
    edges = np.linspace(inner_mm + _FROM * spacing_mm, outer_mm, count + 1).tolist()
    if not edges[0] < edges[-1]:
        return []
    return [*itertools.pairwise(edges), (edges[0], edges[-1])]


def j_of_series(fit: SeriesFit, elastic: Elastic) -> float:
    """Return (K_I^2 + K_II^2) / E' of a fitted series, N/mm."""
    return 2.0 * np.pi * elastic.two_g**2 * float(fit.terms[2:4] @ fit.terms[2:4]) / elastic.effective[0]


class Opening(NamedTuple):
    """By how much the faces part at distances (m,) behind the tip.

    The value (m, 2) is u and v of the upper face less the lower one's; by the gains (m, 2, n, 2) the tip moves too.
    """

    behind_mm: Float
    value: Float
    gains: Float


def opening(points: Points, fit: SeriesFit, elastic: Elastic, behind_mm: Float) -> Opening:
    """Return the faces' opening at those of the distances behind the tip (m,) that have points on both sides.

    What subsets and local fits lose of the series is added.
    """
    at = np.stack([fit.tip_mm[0] - behind_mm, np.full(len(behind_mm), fit.tip_mm[1])], axis=-1)
    upper, lower = (local_fits(points, fit.tip_mm, at, np.full(len(at), side)) for side in (1.0, -1.0))
    kept = upper.found & lower.found
    weights, behind = (upper.value - lower.value).toarray()[kept], behind_mm[kept]
    model = seen_terms(points, fit.tip_mm, fit.order, elastic.kappa) @ fit.terms

    def of_series(distance: Float) -> Float:
        upper = np.asarray(distance * (-1.0 + 1e-12j), dtype=np.complex128)
        jump = terms_at(upper, fit.order, elastic.kappa) - terms_at(np.conj(upper), fit.order, elastic.kappa)
        return np.asarray(jump @ fit.terms)

    value = weights @ (points.uv_mm - model) + of_series(behind)
    gains = np.zeros((len(behind), 2, len(points.at), 2))
    gains[:, 0, :, 0], gains[:, 1, :, 1] = weights, weights
    # a tip farther ahead is another place of the faces
    step = 1e-4 * behind_mm.min()
    slope = (of_series(behind - step) - of_series(behind + step)) / (2.0 * step)
    return Opening(behind, value, gains + slope[..., None, None] * points.of_few(fit.gains[-2:-1])[0])


def _operator(fits: LocalFits) -> csr_array:
    """Return (4 m, 2 n) the gradients u,x u,y v,x v,y of each place over u, v of each point."""
    along, down = np.zeros((4, 2)), np.zeros((4, 2))
    along[[0, 2], [0, 1]], down[[1, 3], [0, 1]] = 1.0, 1.0
    return csr_array(kron(fits.by_x, along) + kron(fits.by_y, down))


def _forms(elastic: Elastic, slope: Float) -> Float:
    """Return (m, 4, 4) symmetric H with g' H g = (s_ij u_j,1 - W d_1i) q,i, for the slopes (m, 2) of q."""
    e, nu = elastic.effective
    normal, cross, shear = e / (1.0 - nu**2), e * nu / (1.0 - nu**2), 0.5 * e / (1.0 + nu)
    # stresses and energy over g = u,x u,y v,x v,y
    xx, yy = np.array([normal, 0.0, 0.0, cross]), np.array([cross, 0.0, 0.0, normal])
    xy = np.array([0.0, shear, shear, 0.0])
    ux, uy, vx, vy = np.eye(4)
    energy = 0.5 * (np.outer(xx, ux) + np.outer(yy, vy) + np.outer(xy, uy + vx))
    along = np.outer(xx, ux) + np.outer(xy, vx) - energy
    across = np.outer(xy, ux) + np.outer(yy, vx)
    whole = slope[:, 0, None, None] * along + slope[:, 1, None, None] * across
    return np.asarray(0.5 * (whole + np.swapaxes(whole, 1, 2)))
