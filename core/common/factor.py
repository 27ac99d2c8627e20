"""The common factor of a field: a few columns that all its points share, for unit causes.

The covariance of points i and j is that of their own matching, where they share pixels, plus F_i F_j'. Pushed through
the weights of a mean, a distance or a strain and then squared, F does not shrink when points are averaged and cancels
where it must. A column is the same unit cause in all steps and tests of one calibration, so that F_b - F_a of two steps
is what their difference has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from core.arrays import Float, Float32, Floats
from core.cameras.stereo import StereoPair
from core.common.derivatives import Estimator, measured_derivatives
from core.errors import CalibrationInputError
from core.names import CAUSES, Cause

KEPT = 0.999
"""Share of each point's common variance that the columns hold at least."""
_NEGATIVE = 1e-9  # of the largest eigenvalue: what rounding leaves of a covariance that is positive
_SUM = 1e-6  # of two standard deviations: by what parts may miss the covariance
_NOTHING = 1e-10  # of all variance that a calibration gives points: columns beyond it are rounding
FINE = 1 / 128
"""Of a component's common standard deviation: what a factor is rounded to, to be short in files."""
_SAMPLE = 500  # points by which columns are chosen
_OWN_FINE = 1 / 1024
_DEPTHS = (0.97, 1.0, 1.03)  # of the stand-off: points by which columns are ordered


@dataclass(frozen=True)
class Causes:
    """Causes of a factor's columns.

    Attributes
    ----------
    columns
        Of each column, in the order of :data:`core.names.CAUSES`.
    told
        Causes that are told apart; those without a column are zero. ``calibration`` alone holds them all.
    """

    columns: tuple[Cause, ...]
    told: tuple[Cause, ...] = ("calibration",)

    @staticmethod
    def untold(count: int) -> Causes:
        """Return those of columns that nothing is known about."""
        one: Cause = "calibration"
        return Causes((one,) * count)

    def squares(self, factor: Floats) -> dict[Cause, Float]:
        """Return by cause the variance (...) of a factor's rows (..., k)."""
        out = {}
        for cause in self.told:
            first = self.columns.index(cause) if cause in self.columns else 0
            own = factor[..., first : first + self.columns.count(cause)]  # columns are grouped by cause
            out[cause] = np.einsum("...k,...k->...", own, own)
        return out

    def aligned(self, factor: Float, other: Causes) -> Float:
        """Return a factor (..., k) with the columns of both, zero where it has none: (..., q), see :func:`joined`."""
        out = np.zeros((*factor.shape[:-1], len(joined(self, other).columns)))
        at = 0
        for cause in CAUSES:
            own = [k for k, name in enumerate(self.columns) if name == cause]
            out[..., at : at + len(own)] = factor[..., own]
            at += max(len(own), other.columns.count(cause))
        return out


def joined(one: Causes, other: Causes) -> Causes:
    """Return the causes of the columns of two factors of one calibration: the k-th of a cause is the same in both."""
    counts = {cause: max(one.columns.count(cause), other.columns.count(cause)) for cause in CAUSES}
    told = tuple(cause for cause in CAUSES if cause in one.told and cause in other.told)
    return Causes(tuple(cause for cause in CAUSES for _ in range(counts[cause])), told)


@dataclass(frozen=True, eq=False)
class ParameterCovariance:
    """Covariance of the cameras' parameters, by name.

    Attributes
    ----------
    pair
        The cameras.
    names
        ``cam1.`` or ``cam2.`` and a name of the camera's parameters.
    covariance
        (p, p), units of the parameters.
    by_cause
        (p, p) parts that add up to it; None where they are not told apart.
    """

    pair: StereoPair
    names: Sequence[str]
    covariance: Float
    by_cause: Mapping[Cause, Float] | None = None

    def root(self) -> Float:
        """Return L (p, q) with L L' the covariance, without directions of no variance.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive``.
        """
        return self._root(self.covariance, "The covariance")

    @property
    def told(self) -> tuple[Cause, ...]:
        """The causes that are told apart."""
        if self.by_cause is None:
            return ("calibration",)
        return tuple(cause for cause in CAUSES if cause in self.by_cause)

    def check(self) -> None:
        """Raise an error for a covariance that none can be.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive`` with the eigenvalue, also of a part; ``covariance_parts_differ`` where the parts
            do not add up.
        """
        self.root()
        if self.by_cause is None:
            return
        total = np.sum(list(self.by_cause.values()), axis=0)
        scale = self._scale
        off = np.abs(total - self.covariance) / (scale[:, None] * scale)
        if not off.max(initial=0.0) <= _SUM:
            i, j = (int(k) for k in np.unravel_index(int(np.nanargmax(off)), off.shape))
            raise CalibrationInputError(
                f"The parts by cause of the covariance of {self.names[i]} and {self.names[j]} add up to "
                f"{total[i, j]:.6g}, but it is {self.covariance[i, j]:.6g}.",
                code="covariance_parts_differ",
                remedy="Calibrate anew, or take covariance_by_cause out of the file; the parts are then not told "
                "apart.",
            )
        self.roots()

    def roots(self) -> dict[Cause, Float]:
        """Return by cause L (p, q) with L L' its part.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive``.
        """
        if self.by_cause is None:
            return {"calibration": self.root()}
        return {c: self._root(self.by_cause[c], f"The part of {c} of the covariance") for c in self.told}

    @cached_property
    def columns(self) -> tuple[Float, Causes]:
        """L (p, q), columns grouped by cause, and their causes: those of a cause from the one that moves points most.

        Which columns these are depends on the calibration alone.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive``.
        """
        roots = self.roots()
        rows = _typical_rows(self.pair, self.names)
        moved = {cause: rows @ L for cause, L in roots.items()}
        variance = np.sum([(part**2).sum(axis=1) for part in moved.values()], axis=0)
        weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0.0)
        parts: list[Float] = []
        names: list[Cause] = []
        for cause, L in roots.items():
            value, vector = np.linalg.eigh(moved[cause].T @ (weight[:, None] * moved[cause]))
            kept = np.flatnonzero(value > _NOTHING * len(rows))[::-1]
            turned = L @ vector[:, kept]
            # an eigenvector's sign is arbitrary: the largest derivative is positive
            sign = np.sign((rows @ turned)[np.abs(rows @ turned).argmax(axis=0), range(len(kept))])
            parts.append(turned * np.where(sign == 0.0, 1.0, sign))
            names += [cause] * len(kept)
        return np.concatenate(parts, axis=1), Causes(tuple(names), self.told)

    @property
    def _scale(self) -> Float:
        sd = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return np.where(sd > 0.0, sd, 1.0)  # px, rad and 1/px^2 beside one another

    def _root(self, covariance: Float, what: str) -> Float:
        scale = self._scale
        value, vector = np.linalg.eigh(covariance / scale[:, None] / scale)
        if value[0] < -_NEGATIVE * max(value[-1], 1.0):
            raise CalibrationInputError(
                f"{what} of the cameras' parameters has an eigenvalue of {value[0]:.3g} (of correlations).",
                code="covariance_not_positive",
                remedy="Calibrate anew, or take the covariance out of the file; results then do not include it.",
            )
        kept = value > 0.0
        # a parameter that was held has no part in what rounding leaves
        held = np.diagonal(self.covariance) <= 0.0
        return np.asarray(np.where(held, 0.0, scale)[:, None] * vector[:, kept] * np.sqrt(value[kept]))


@dataclass(frozen=True, eq=False)
class Factor:
    """A common factor with the causes of its columns.

    Attributes
    ----------
    values
        (n, 3, k) of X, Y, Z, or (n, 6, k) of X, Y, Z, U, V, W: mm for unit causes. Rounded so that single precision
        holds it.
    causes
        Of the columns.
    """

    values: Float32
    causes: Causes


@dataclass(frozen=True, eq=False)
class FactorColumns:
    """The columns of a factor, chosen by a sample of its points, and how finely it is rounded.

    Attributes
    ----------
    names
        Of the parameters.
    directions
        (len(names), k) of unit causes in them.
    causes
        Of the columns.
    step
        (3 or 6,) mm: what each component is rounded to.
    """

    names: Sequence[str]
    directions: Float
    causes: Causes
    step: Float

    @staticmethod
    def chosen(source: ParameterCovariance, sample: Estimator, own_mm: Float | None = None) -> FactorColumns:
        """Choose as few columns as hold :data:`KEPT` of each point's common variance.

        Parameters
        ----------
        source
            What is common.
        sample
            The estimator at :func:`sample_of` the points: the factor changes slowly from point to point.
        own_mm
            (3,) or (6,) typical standard deviations of the points' own; what is far below them is rounded away.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive``.
        """
        L, causes = source.columns
        kept = fewest_columns(sample.through(source.names, L), causes)
        directions = L[:, kept]
        found = Causes(tuple(causes.columns[k] for k in kept), causes.told)
        step = _rounding(sample.through(source.names, directions), own_mm, FINE)
        return FactorColumns(source.names, directions, found, step)

    def at(self, estimator: Estimator) -> Float32:
        """Return the factor (n, 3 or 6, k) at an estimator's points."""
        factor = estimator.through(self.names, self.directions).astype(np.float32)
        _to_step(factor, self.step)
        return factor


def sample_of(count: int) -> slice:
    """Return which of some points choose a factor's columns."""
    return slice(None, None, max(count // _SAMPLE, 1))


def factor_of(
    source: ParameterCovariance, points_mm: Float, displaced_mm: Float | None = None, *, own_mm: Float | None = None
) -> Factor:
    """Return the common factor of points, with as few columns as hold :data:`KEPT` of each point's common variance.

    Parameters
    ----------
    source
        What is common.
    points_mm
        (n, 3) points at the reference, system frame, all finite.
    displaced_mm
        (n, 3) their current positions.
    own_mm
        (3,) or (6,) typical standard deviations of the points' own; what is far below them is rounded away.

    Raises
    ------
    CalibrationInputError
        ``covariance_not_positive``.
    """
    some = sample_of(len(points_mm))
    sample = Estimator.at(source.pair, points_mm[some], None if displaced_mm is None else displaced_mm[some])
    columns = FactorColumns.chosen(source, sample, own_mm)
    return Factor(columns.at(Estimator.at(source.pair, points_mm, displaced_mm)), columns.causes)


def round_in_place(factor: Floats, sample: Floats, own: Float | None = None, *, fine: float = FINE) -> None:
    """Round a factor (..., m, k) to a small part of each component's standard deviation, as a power of two.

    It stays far below what the points' own noise and the columns left out change, and is the same in memory and in
    single precision in a file, where smooth columns of few digits take little room.

    Parameters
    ----------
    factor
        Changed in place.
    sample
        (n, m, k) :func:`sample_of` its points; nothing is rounded where there are none.
    own
        (m,) standard deviations of the points' own: rounding never needs to be finer than 1/1024 of them.
    fine
        The part of the standard deviation.
    """
    if sample.size:
        _to_step(factor, _rounding(sample, own, fine))


def _rounding(some: Floats, own: Float | None, fine: float) -> Float:
    """(m,) a power of two that the components of a factor are rounded to, by a sample (n, m, k) of it."""
    if not some.size:
        return np.ones(some.shape[1])
    step = fine * np.sqrt(np.median((np.asarray(some, dtype=np.float64) ** 2).sum(axis=-1), axis=0))
    if own is not None:
        step = np.maximum(step, _OWN_FINE * np.where(np.isfinite(own), own, 0.0))
    return np.asarray(2.0 ** np.floor(np.log2(np.where(step > 0.0, step, 1e-300))))


def _to_step(factor: Floats, step: Float) -> None:
    """Round a factor (..., m, k) in place to steps (m,): exact in either precision, but for steps that hold nothing."""
    by: Any = step[:, None].astype(factor.dtype)
    np.multiply(factor, 1.0 / np.where(by > 0.0, by, 1.0), out=factor)  # of a power of two exact
    np.rint(factor, out=factor)
    np.multiply(factor, by, out=factor)


def common_factor(source: ParameterCovariance, points_mm: Float, displaced_mm: Float | None = None) -> Float32:
    """Return the values of :func:`factor_of`."""
    return factor_of(source, points_mm, displaced_mm).values


def fewest_columns(factor: Float, causes: Causes, kept: float = KEPT) -> list[int]:
    """Return which columns of a factor (n, m, q) hold at least a share of each component's variance.

    Of each cause they are the first ones.
    """
    n, m, q = factor.shape
    square = factor.reshape(n * m, q) ** 2
    variance = square.sum(axis=1)
    if n == 0 or not (variance > 0.0).any():
        return []
    square /= np.where(variance > 0.0, variance, 1.0)[:, None]
    # a column is worth what it or a later one of its cause holds, so that none is left out between
    worth = square.mean(axis=0)
    for cause in causes.told:
        own = [k for k, name in enumerate(causes.columns) if name == cause]
        worth[own] = np.maximum.accumulate(worth[own][::-1])[::-1]
    order = np.argsort(-worth, kind="stable")
    share = np.cumsum(square[:, order], axis=1)
    worst = np.where(variance[:, None] > 0.0, share, 1.0).min(axis=0)
    count = int(np.argmax(worst >= kept)) + 1 if worst[-1] >= kept else q
    return sorted(order[:count].tolist())


def _typical_rows(pair: StereoPair, names: Sequence[str]) -> Float:
    """(n, p) derivatives of positions, and of shifts along each axis, over both cameras' view at their stand-off."""
    depth = float(pair.cam1.cam_from_sys.translation_mm[2])
    if not depth > 0.0:
        depth = 4.0 * pair.baseline_mm
    centre = pair.cam1.lens.image_from_normalised(np.zeros((1, 2))).xy[0]
    reach = 0.8 * np.abs(centre / np.diagonal(pair.cam1.lens.image_jacobian(np.zeros((1, 2)))[0]))
    side = np.linspace(-1.0, 1.0, 5)
    x, y, z = (a.ravel() for a in np.meshgrid(reach[0] * side, reach[1] * side, _DEPTHS, indexing="ij"))
    points = pair.cam1.sys_from_cam.apply(depth * z[:, None] * np.column_stack([x, y, np.ones(len(x))]))
    rows = [measured_derivatives(pair, points, names, points + shift) for shift in 0.01 * depth * np.eye(3)]
    return np.concatenate([rows[0][:, :3], *(part[:, 3:] for part in rows)], axis=1).reshape(-1, len(names))
