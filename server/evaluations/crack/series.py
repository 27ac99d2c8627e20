"""The series about a crack's tip (Williams 1957), and its fit with a free tip.

With z = x + i y from the tip, x ahead along the crack, and traction-free faces behind it,

    2 G (u + i v) = sum_n A_n [kappa z^l + (-1)^n z*^l] + l A_n* [z*^l - z z*^(l-1)],    l = n / 2,

A_0 the translation, the imaginary part of A_2 the rotation, and

    K_I - i K_II = sqrt(2 pi) A_1,    T = 4 Re A_2.

The measured displacement is a mean over the subset, and so is the series.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from stereorig.core.arrays import Float
from stereorig.server.evaluations.crack.points import Points
from stereorig.server.evaluations.crack.settings import Elastic

LEAST_ORDER, _MORE = 3, 2
_ROUNDS = 25
_SETTLED = 1e-6  # of the ring's inner radius
_STEP = 1e-4  # of the ring's inner radius, for derivatives over the tip
_CHANCE = 1e-3  # share of sound fits whose misfit is called too large


@dataclass(frozen=True, eq=False)
class SeriesFit:
    """A fitted series.

    Attributes
    ----------
    order, terms
        Highest n, and (2 order + 2,) real and imaginary part of each A_n / 2 G, one after the other, mm^(1 - n / 2).
    tip_mm, settled
        (2,) the tip in the drawn tip's frame; not settled if it moved on.
    gains
        (2 order + 4, n, 2) derivatives of the terms, and of the tip's x and y, over the points' displacements.
    chi_square, degrees
        Of the residuals by the points' covariance.
    """

    order: int
    terms: Float
    tip_mm: Float
    gains: Float
    chi_square: float
    degrees: int
    settled: bool

    @property
    def excess(self) -> float:
        """Factor of the standard uncertainties for a misfit that chance does not explain; 1 for none."""
        if chi2.sf(self.chi_square, self.degrees) > _CHANCE:
            return 1.0
        return float(np.sqrt(max(self.chi_square / self.degrees, 1.0)))


def terms_at(z: NDArray[np.complex128], order: int, kappa: float) -> Float:
    """Return (..., 2, 2 order + 2): u, v over real and imaginary part of each A_n / 2 G at complex positions."""
    out = np.empty((*z.shape, 2, 2 * order + 2))
    root = np.sqrt(z)
    power, lower = np.ones_like(z), [1.0 / z, 1.0 / root]  # z^l, and z^(l - 1) of this and the next n
    for n in range(order + 1):
        one = kappa * power + (-1) ** n * np.conj(power)
        two = 0.5 * n * np.conj(power) - 0.5 * n * z * np.conj(lower[0])
        lower = [lower[1], power]
        power = power * root
        for k, column in enumerate((one + two, 1j * (one - two))):
            out[..., 0, 2 * n + k], out[..., 1, 2 * n + k] = column.real, column.imag
    return out


def seen_terms(points: Points, tip_mm: Float, order: int, kappa: float) -> Float:
    """Return (n, 2, 2 order + 2) the terms as the points' subsets see them."""
    at = points.xy_mm[:, None] + points.nodes_mm - tip_mm
    seen = terms_at(at[..., 0] + 1j * at[..., 1], order, kappa)
    return np.asarray(np.einsum("nq,nqac->nac", points.weights, seen))


def fitted(points: Points, elastic: Elastic, order: int, tip_mm: Float, inner_mm: float) -> SeriesFit:
    """Fit the series of an order, the tip being free, by least squares with the points' whole covariance."""
    tip, free = np.array(tip_mm, dtype=np.float64), 2 * order + 4
    problem = _Problem(points, elastic.kappa, order, inner_mm)
    design = problem.design(tip, np.zeros(free - 2))
    found, chi_square = problem.solved(np.delete(design, [free - 2, free - 1], axis=1), free - 2)
    settled = False
    for _ in range(_ROUNDS):
        design = problem.design(tip, found[: free - 2] * problem.size[: free - 2])
        found, chi_square = problem.solved(design, free)
        step = found[free - 2 : free]
        length = float(np.linalg.norm(step))
        tip = tip + step * min(1.0, 0.5 * inner_mm / max(length, 1e-300))
        if not np.isfinite(tip).all() or np.linalg.norm(tip - tip_mm) > problem.radius:
            break
        if length < _SETTLED * inner_mm:
            settled = True
            break
    gains = points.unwhitened(problem.gains(design, free) * problem.size[:, None])
    terms = found[: free - 2] * problem.size[: free - 2]
    return SeriesFit(order, terms, tip, gains, chi_square, len(problem.readings) - free, settled)


def held(points: Points, elastic: Elastic, tip_mm: Float, inner_mm: float) -> tuple[float, float]:
    """Return K_I of the lowest order with the tip held where it is, MPa sqrt(mm), and its standard uncertainty."""
    problem = _Problem(points, elastic.kappa, LEAST_ORDER, inner_mm)
    free = 2 * LEAST_ORDER + 2
    design = np.delete(problem.design(tip_mm, np.zeros(free)), [free, free + 1], axis=1)
    gain = problem.gains(design, free)[2] * problem.size[2]
    scale = float(np.sqrt(2.0 * np.pi)) * elastic.two_g
    found, chi_square = problem.solved(design, free)
    excess = max(chi_square / (len(problem.readings) - free), 1.0)
    return scale * float(found[2] * problem.size[2]), scale * float(np.sqrt(excess * (gain @ gain)))


def chosen_fit(
    points: Points, elastic: Elastic, tip_mm: Float, inner_mm: float, max_order: int, criterion: str
) -> SeriesFit:
    """Return the fit of two orders more than the one with the most information; the tip starts at ``tip_mm``.

    What the criterion leaves out is below the noise of a point, which is more than an interval may miss. The orders are
    compared about the fit of the highest one, where the tip's displacement is linear.
    """
    highest = max(LEAST_ORDER, min(max_order, len(points.at) // 4 - 2))
    most = fitted(points, elastic, highest, tip_mm, inner_mm)
    if not most.settled and highest > LEAST_ORDER:
        return chosen_fit(points, elastic, tip_mm, inner_mm, highest - 1, criterion)
    problem = _Problem(points, elastic.kappa, highest, inner_mm)
    design = problem.design(most.tip_mm, most.terms)
    scores = {}
    for order in range(LEAST_ORDER, max(LEAST_ORDER, highest - _MORE) + 1):
        kept = np.r_[0 : 2 * order + 2, 2 * highest + 2 : design.shape[1]]
        score = problem.solved(design[:, kept], 2 * order + 4)[1]
        free = 2 * order + 4
        scores[order] = score + free * (2.0 if criterion == "aic" else float(np.log(design.shape[0])))
    best = min(min(scores, key=scores.__getitem__) + _MORE, highest)
    return most if best == highest else fitted(points, elastic, best, most.tip_mm, inner_mm)


class _Problem:
    """Least squares of whitened displacements; the common causes are unknowns with a variance of 1 of their own.

    This is the same as their part of the covariance.
    """

    def __init__(self, points: Points, kappa: float, order: int, inner_mm: float) -> None:
        self.points, self.kappa, self.order, self.inner_mm = points, kappa, order, inner_mm
        self.readings = points.whitened(points.uv_mm[..., None])[:, 0]
        self._causes = np.zeros((len(self.readings), 0)) if points.common is None else points.whitened(points.common)
        self.radius = float(np.linalg.norm(points.xy_mm, axis=1).max())
        #: of the columns, so that they are alike
        self.size = np.concatenate([np.repeat(self.radius ** (-0.5 * np.arange(order + 1)), 2), np.ones(2)])

    def design(self, tip: Float, terms: Float) -> Float:
        """Return the columns: of the terms, of the tip with the terms that are known so far, and of the causes."""
        seen = seen_terms(self.points, tip, self.order, self.kappa)
        moved = np.zeros((len(seen), 2, 2))
        for axis in (0, 1):
            step = _STEP * self.inner_mm * np.eye(2)[axis]
            ends = [seen_terms(self.points, tip + sign * step, self.order, self.kappa) @ terms for sign in (1.0, -1.0)]
            moved[..., axis] = (ends[0] - ends[1]) / (2.0 * step[axis])
        columns = np.concatenate([seen, moved], axis=-1) * self.size
        return np.concatenate([self.points.whitened(columns), self._causes], axis=1)

    def _normal(self, design: Float, free: int) -> Float:
        unit = np.arange(design.shape[1]) >= free
        return np.asarray(design.T @ design + np.diag(unit.astype(np.float64)))

    def solved(self, design: Float, free: int) -> tuple[Float, float]:
        """Return the unknowns of which ``free`` have no variance of their own, and the chi-square."""
        found = np.asarray(np.linalg.solve(self._normal(design, free), design.T @ self.readings))
        left = self.readings - design @ found
        return found, float(left @ left + found[free:] @ found[free:])

    def gains(self, design: Float, free: int) -> Float:
        """Return (free, m) the unknowns' derivatives over the whitened displacements."""
        return np.asarray(np.linalg.solve(self._normal(design, free), design.T)[:free])
