"""The numbers of a curve, for many curves at once: smooth functions of the readings of steps that are chosen before."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.evaluations.tensile.curve import AXIAL, LATERAL, STRESS, Indices

PROOF = 0.002
_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Local:
    """Steps through which a parabola, or a cubic, is laid.

    Attributes
    ----------
    at
        Their indices.
    solve
        (q, m) coefficients over the readings: constant, linear, quadratic ... in the place along the curve.
    place
        Where on the curve its value is asked for.
    """

    at: Indices
    solve: Float
    place: float = 0.0

    @staticmethod
    def through(at: Indices, places: Float, place: float = 0.0, *, degree: int = 2) -> Local:
        """Return the steps ``at`` with their places (m,) along the curve."""
        powers = np.vander(places, min(degree + 1, len(at)), increasing=True)
        return Local(at, np.asarray(np.linalg.pinv(powers), dtype=np.float64), place)

    def coefficients(self, y: Float) -> Float:
        """Return the four coefficients (..., 4) of the line through readings (..., n)."""
        found = y[..., self.at] @ self.solve.T
        return np.concatenate([found, np.zeros((*found.shape[:-1], 4 - found.shape[-1]))], axis=-1)

    def value(self, y: Float) -> Float:
        """Return the line through readings (..., n) at the place asked for."""
        return np.asarray(self.coefficients(y) @ self.place ** np.arange(4))


@dataclass(frozen=True, eq=False)
class Plan:
    """The steps that each number uses; none for a number that there is not.

    Attributes
    ----------
    window
        Of the modulus and of Poisson's ratio.
    ratio
        Variance of the stress' own errors over that of the strain's, in the window; infinite without the latter.
    first
        Steps before the specimen is stretched.
    proof, peak, around_peak
        About the proof stress, about the largest stress, and the plateau whose middle is the strain there.
    upper, lower, last
        Index of the upper and of the lower yield point, and of the last step before failure.
    r, n
        Of the anisotropy and of the strain hardening exponent.
    """

    window: Indices
    ratio: float
    first: Indices
    proof: Local | None = None
    peak: Local | None = None
    around_peak: Local | None = None
    upper: int | None = None
    lower: int | None = None
    last: int | None = None
    r: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    n: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    @property
    def used(self) -> Indices:
        """The indices of all steps that a number uses."""
        local = [one.at for one in (self.proof, self.peak, self.around_peak) if one is not None]
        single = [np.array([k]) for k in (self.upper, self.lower, self.last) if k is not None]
        return np.unique(np.concatenate([self.window, self.first, self.r, self.n, *local, *single])).astype(np.intp)


def numbers_of(x: Float, plan: Plan, *, only_line: bool = False) -> dict[str, Float]:
    """Return the card's numbers (...) of curves (..., 3, n), by their keys.

    Besides those of the card: ``toe``, the strain at which the modulus' line has no stress, and ``miss``, by how much
    the stress of the first steps is above the line.
    """
    axial, lateral, stress = x[..., AXIAL, :], x[..., LATERAL, :], x[..., STRESS, :]
    a, s = axial[..., plan.window], stress[..., plan.window]
    modulus = slope_of(a, s, plan.ratio)
    at_zero = s.mean(axis=-1) - modulus * a.mean(axis=-1)
    toe = -at_zero / modulus
    found = {"modulus": modulus, "toe": toe}
    if only_line:
        return found
    found["miss"] = (stress - modulus[..., None] * axial)[..., plan.first].mean(axis=-1) - at_zero
    # the slopes of both strains over the stress: their noise does not lower the ratio
    found["poisson"] = -_products(s, lateral[..., plan.window]) / _products(s, a)
    if plan.proof is not None:
        found["proof"] = _proof(axial, stress, modulus, toe, plan.proof)
    if plan.peak is not None:
        found["strength"] = plan.peak.value(stress)
    if plan.around_peak is not None and "strength" in found:
        bend = np.moveaxis(plan.around_peak.coefficients(stress), -1, 0)
        place = np.zeros(modulus.shape)
        for _ in range(_ROUNDS):
            rise = bend[1] + 2.0 * bend[2] * place + 3.0 * bend[3] * place**2
            place = place - rise / (2.0 * bend[2] + 6.0 * bend[3] * place)
        strain = plan.around_peak.coefficients(axial)
        at_peak = (strain * place[..., None] ** np.arange(4)).sum(axis=-1) - toe
        found |= {"strain_at_strength": at_peak, "uniform": at_peak - found["strength"] / modulus}
    if plan.upper is not None:
        found["upper_yield"] = stress[..., plan.upper]
    if plan.lower is not None:
        found["lower_yield"] = stress[..., plan.lower]
    if plan.last is not None:
        at_break = axial[..., plan.last] - toe
        found |= {"strain_at_break": at_break, "elongation": at_break - stress[..., plan.last] / modulus}
    if len(plan.r):
        true, along, across = (one[..., plan.r] for one in _true(axial, lateral, stress, toe))
        plastic = along - true / modulus[..., None]
        across = across + found["poisson"][..., None] * true / modulus[..., None]
        width = _products(plastic, across) / _products(plastic, plastic)
        found["r"] = -width / (1.0 + width)
    if len(plan.n):
        true, along, _ = (one[..., plan.n] for one in _true(axial, lateral, stress, toe))
        plastic, level = np.log(along - true / modulus[..., None]), np.log(true)
        found["n"] = _products(plastic, level) / _products(plastic, plastic)
        found["k"] = np.exp(level.mean(axis=-1) - found["n"] * plastic.mean(axis=-1))
    return found


def slope_of(x: Float, y: Float, ratio: float) -> Float:
    """Return the slope (...) of y over x (..., m), both with errors; ``ratio`` is y's variance over x's.

    Notes
    -----
    Deming's line. Least squares of y alone would find a smaller slope: the errors of x lengthen its spread.
    """
    xx, xy, yy = _products(x, x), _products(x, y), _products(y, y)
    if not np.isfinite(ratio):
        return np.asarray(xy / xx)
    if ratio == 0.0:
        return np.asarray(yy / xy)
    d = yy - ratio * xx
    root = np.sqrt(d**2 + 4.0 * ratio * xy**2)
    # the two forms are equal; each loses digits where the other does not
    return np.where(d > 0.0, (d + root) / (2.0 * xy), 2.0 * ratio * xy / (root - d))


def _products(x: Float, y: Float) -> Float:
    """Return the sum (...) of products of x and y (..., m) about their means."""
    return np.asarray(((x - x.mean(axis=-1, keepdims=True)) * y).sum(axis=-1))


def _proof(axial: Float, stress: Float, modulus: Float, toe: Float, local: Local) -> Float:
    """Return the stress at which the curve meets the modulus' line, shifted by the proof strain."""
    level = local.coefficients(stress)
    beyond = local.coefficients(axial) - level / modulus[..., None]
    beyond[..., 0] -= toe + PROOF
    place = np.zeros(modulus.shape)
    for _ in range(_ROUNDS):
        value = beyond[..., 0] + beyond[..., 1] * place + beyond[..., 2] * place**2
        place = place - value / (beyond[..., 1] + 2.0 * beyond[..., 2] * place)
    return np.asarray(level[..., 0] + level[..., 1] * place + level[..., 2] * place**2)


def _true(axial: Float, lateral: Float, stress: Float, toe: Float) -> tuple[Float, Float, Float]:
    """Return true stress and true strains along and across, with constant volume."""
    along = axial - toe[..., None]
    return stress * (1.0 + along), np.log1p(along), np.log1p(lateral)
