"""A measured vector with the parts of its uncertainty that several steps share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.common.factor import Causes, joined
from stereorig.core.gauge.rigid import RigidMotion
from stereorig.core.strain.mean import MeanStrainVariance


@dataclass(frozen=True, eq=False)
class Measured:
    """A vector of m numbers read off one step.

    Attributes
    ----------
    value
        (m,).
    new
        (m, m) covariance of the noise that is new at the step.
    reference
        (m, m) of the reference pair's noise, the same in all steps of a test; zero if it is not known separately.
    common
        (m, k) common factor of the calibration; None if that is not known.
    causes
        Causes of the factor's columns.
    """

    value: Float
    new: Float
    reference: Float
    common: Float | None = None
    causes: Causes | None = None

    @property
    def covariance(self) -> Float:
        """(m, m) the whole."""
        own = self.new + self.reference
        return own if self.common is None else own + self.common @ self.common.T

    @property
    def sigma(self) -> Float:
        """(m,) standard uncertainties."""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))


def measured_of(
    value: Float, own: Float, frozen: Float | None, common: Float | None = None, causes: Causes | None = None
) -> Measured:
    """Return a vector from its own covariance (m, m), the reference pair's part of it, and its common factor (m, k)."""
    reference = np.zeros_like(own) if frozen is None else frozen
    return Measured(np.asarray(value, dtype=np.float64), own - reference, reference, common, causes)


def motion_of(motion: RigidMotion, causes: Causes | None) -> Measured:
    """Return small rotation (rad) and translation (mm) of a fitted rigid motion, (6,)."""
    value = np.concatenate([motion.rotation_vector_rad, motion.translation_mm])
    return measured_of(value, motion.own_covariance, motion.reference_covariance, motion.common, causes)


def mean_strain_of(value: Float, variance: MeanStrainVariance) -> Measured:
    """Return the means of exx, eyy, exy over an area; their correlations are not known, and taken as none."""
    frozen = None if variance.reference is None else np.diag(variance.reference)
    return measured_of(value, np.diag(variance.own), frozen, variance.common, variance.causes)


def joint_covariance(parts: Sequence[Measured]) -> Float:
    """Return the covariance (sum of m, sum of m) of vectors of several steps of one test and one calibration.

    New noise is independent, the reference pair's is fully shared, through the symmetric roots of its covariances, and
    a column of the common factor is one cause in all of them.
    """
    sizes = [len(part.value) for part in parts]
    total = np.zeros((sum(sizes), sum(sizes)))
    at = np.cumsum([0, *sizes])
    for k, part in enumerate(parts):
        total[at[k] : at[k + 1], at[k] : at[k + 1]] = part.new
    for size in set(sizes):  # parts of different length are of different kinds, and share no direction
        roots = np.zeros((sum(sizes), size))
        for k, part in enumerate(parts):
            if sizes[k] == size:
                roots[at[k] : at[k + 1]] = _root(part.reference)
        total += roots @ roots.T
    factor = _factor(parts)
    return total if factor is None else total + factor @ factor.T


def _root(covariance: Float) -> Float:
    spread, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((axes * np.sqrt(np.maximum(spread, 0.0))) @ axes.T)


def _factor(parts: Sequence[Measured]) -> Float | None:
    """(sum of m, q): the common factors with one set of columns; zero rows for an unknown one."""
    known = [(p.causes or Causes.unseparated(p.common.shape[1])) for p in parts if p.common is not None]
    if not known:
        return None
    both = reduce(joined, known)
    rows = []
    for part in parts:
        if part.common is None:
            rows.append(np.zeros((len(part.value), len(both.columns))))
        else:
            rows.append((part.causes or Causes.unseparated(part.common.shape[1])).aligned(part.common, both))
    return np.concatenate(rows)
