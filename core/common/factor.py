"""The common factor of a field: a few columns that all its points share, for unit causes.

The covariance of points i and j is the covariance of their matching, if they share pixels, plus F_i F_j'. F is
propagated through the weights of a mean, a distance or a strain and then squared, so that it does not shrink when
points are averaged, and it cancels in differences of points that share it. A column is the same unit cause in all steps
and tests of one calibration, so that F_b - F_a is the factor of the difference of two steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from stereorig.core.arrays import Float, Float32, Floats
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.derivatives import Estimator, measured_derivatives
from stereorig.core.errors import CalibrationInputError
from stereorig.core.names import ALL_CAUSES, CAUSES, Cause

KEPT = 0.999
"""Share of each point's common variance that the columns hold at least."""
_NEGATIVE = 1e-9  # share of the largest eigenvalue: rounding makes eigenvalues of a covariance this negative
_SUM = 1e-6  # share of two standard deviations by which the sum of the parts may differ from the covariance
_NOTHING = 1e-10  # share of the total variance from the calibration: columns below it are rounding
FINE = 1 / 128
"""Share of a component's common standard deviation that a factor is rounded to, so that it is short in files."""
_SAMPLE = 500  # points by which columns are chosen
_OWN_FINE = 1 / 1024
_DEPTHS = (0.97, 1.0, 1.03)  # multiples of the stand-off: depths of the points by which columns are ordered


@dataclass(frozen=True)
class Causes:
    """Causes of a factor's columns.

    Attributes
    ----------
    columns
        Cause of each column, in the order of :data:`stereorig.core.names.ALL_CAUSES`.
    separate
        Causes whose parts are known separately; a known cause without a column has no variance. ``calibration`` alone
        means that all columns are the calibration's.
    """

    columns: tuple[Cause, ...]
    separate: tuple[Cause, ...] = ("calibration",)

    @staticmethod
    def unseparated(count: int) -> Causes:
        """Return the causes of columns without a record: all are ``calibration``."""
        one: Cause = "calibration"
        return Causes((one,) * count)

    def squares(self, factor: Floats) -> dict[Cause, Float]:
        """Return by cause the variance (...) of a factor's rows (..., k)."""
        out = {}
        for cause in self.separate:
            first = self.columns.index(cause) if cause in self.columns else 0
            own = factor[..., first : first + self.columns.count(cause)]  # columns are grouped by cause
            out[cause] = np.einsum("...k,...k->...", own, own)
        return out

    @property
    def with_sensor(self) -> Causes:
        """The same causes and one more column, for the sensor's pull."""
        return Causes((*self.columns, "sensor"), (*self.separate, "sensor"))

    def of_calibration(self, factor: Floats) -> Float:
        """Return the calibration's part (...) of standard deviations with a factor's rows (..., k); NaN without one."""
        if not any(cause in CAUSES for cause in self.separate):
            return np.full(factor.shape[:-1], np.nan)
        own = factor[..., : len(self.columns) - self.columns.count("sensor")]
        return np.asarray(np.sqrt(np.einsum("...k,...k->...", own, own)))

    def aligned(self, factor: Float, other: Causes) -> Float:
        """Return a factor (..., k) as (..., q) with the columns of both, zero in columns that it does not have."""
        out = np.zeros((*factor.shape[:-1], len(joined(self, other).columns)))
        at = 0
        for cause in ALL_CAUSES:
            own = [k for k, name in enumerate(self.columns) if name == cause]
            out[..., at : at + len(own)] = factor[..., own]
            at += max(len(own), other.columns.count(cause))
        return out


def joined(one: Causes, other: Causes) -> Causes:
    """Return the causes of the columns of two factors of one calibration: the k-th of a cause is the same in both."""
    counts = {cause: max(one.columns.count(cause), other.columns.count(cause)) for cause in ALL_CAUSES}
    separate = tuple(cause for cause in CAUSES if cause in one.separate and cause in other.separate)
    if counts["sensor"]:  # a step without it has none of it
        separate += ("sensor",)
    return Causes(tuple(cause for cause in ALL_CAUSES for _ in range(counts[cause])), separate)


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
        (p, p) parts that add up to the covariance; None if the causes are not known separately.
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
    def separate(self) -> tuple[Cause, ...]:
        """The causes whose parts of the covariance are known separately."""
        if self.by_cause is None:
            return ("calibration",)
        return tuple(cause for cause in CAUSES if cause in self.by_cause)

    def check(self) -> None:
        """Raise an error for a covariance that none can be.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive`` with the eigenvalue, also of a part; ``covariance_parts_differ`` if the parts
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
                remedy="Calibrate again, or take covariance_by_cause out of the file; the parts are then not known "
                "separately.",
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
        return {c: self._root(self.by_cause[c], f"The part of {c} of the covariance") for c in self.separate}

    @cached_property
    def columns(self) -> tuple[Float, Causes]:
        """L (p, q), columns grouped by cause, and their causes; each cause's column that moves points most comes first.

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
        return np.concatenate(parts, axis=1), Causes(tuple(names), self.separate)

    @property
    def _scale(self) -> Float:
        sd = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return np.where(sd > 0.0, sd, 1.0)  # px, rad and 1/px^2 in one matrix

    def _root(self, covariance: Float, what: str) -> Float:
        scale = self._scale
        value, vector = np.linalg.eigh(covariance / scale[:, None] / scale)
        if value[0] < -_NEGATIVE * max(value[-1], 1.0):
            raise CalibrationInputError(
                f"{what} of the cameras' parameters has an eigenvalue of {value[0]:.3g} (of correlations).",
                code="covariance_not_positive",
                remedy="Calibrate again, or take the covariance out of the file; results then do not include it.",
            )
        kept = value > 0.0
        # rounding leaves no variance to a parameter that was held fixed
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
        Causes of the columns.
    """

    values: Float32
    causes: Causes


@dataclass(frozen=True, eq=False)
class FactorColumns:
    """The columns of a factor, chosen by a sample of its points, and how finely it is rounded.

    Attributes
    ----------
    names
        Names of the parameters.
    directions
        (len(names), k) of unit causes in them.
    causes
        Causes of the columns.
    step
        (3 or 6,) step that each component is rounded to, mm.
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
            Covariance of the cameras' parameters.
        sample
            The estimator at :func:`sample_of` the points: the factor changes slowly from point to point.
        own_mm
            (3,) or (6,) typical standard deviations of the points' own noise; values far below them are rounded to
            zero.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive``.
        """
        L, causes = source.columns
        kept = fewest_columns(sample.through(source.names, L), causes)
        directions = L[:, kept]
        found = Causes(tuple(causes.columns[k] for k in kept), causes.separate)
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


def factor_of(source: ParameterCovariance, points_mm: Float, displaced_mm: Float | None = None) -> Factor:
    """Return the common factor of points, with as few columns as hold :data:`KEPT` of each point's common variance.

    Parameters
    ----------
    source
        Covariance of the cameras' parameters.
    points_mm
        (n, 3) points at the reference, system frame, all finite.
    displaced_mm
        (n, 3) their current positions.

    Raises
    ------
    CalibrationInputError
        ``covariance_not_positive``.
    """
    some = sample_of(len(points_mm))
    sample = Estimator.at(source.pair, points_mm[some], None if displaced_mm is None else displaced_mm[some])
    columns = FactorColumns.chosen(source, sample)
    return Factor(columns.at(Estimator.at(source.pair, points_mm, displaced_mm)), columns.causes)


def round_in_place(factor: Floats, sample: Floats, own: Float | None = None, *, fine: float = FINE) -> None:
    """Round a factor (..., m, k) to a small part of each component's standard deviation, as a power of two.

    The rounding error is far below the points' own noise and the columns left out. The factor is the same in memory and
    in single precision in a file, and smooth columns of few digits compress well.

    Parameters
    ----------
    factor
        Changed in place.
    sample
        (n, m, k) :func:`sample_of` its points; an empty sample leaves the factor as it is.
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
    np.multiply(factor, 1.0 / np.where(by > 0.0, by, 1.0), out=factor)  # exact, as the factor is a power of two
    np.rint(factor, out=factor)
    np.multiply(factor, by, out=factor)


def common_factor(source: ParameterCovariance, points_mm: Float, displaced_mm: Float | None = None) -> Float32:
    """Return the values of :func:`factor_of`."""
    return factor_of(source, points_mm, displaced_mm).values


def fewest_columns(factor: Float, causes: Causes) -> list[int]:
    """Return which columns of a factor (n, m, q) hold :data:`KEPT` of each component's variance.

    The columns of each cause are returned from its first on, without gaps.
    """
    n, m, q = factor.shape
    square = factor.reshape(n * m, q) ** 2
    variance = square.sum(axis=1)
    if n == 0 or not (variance > 0.0).any():
        return []
    square /= np.where(variance > 0.0, variance, 1.0)[:, None]
    # a column counts as much as the largest of it and the later columns of its cause, so that no gap is left between
    worth = square.mean(axis=0)
    for cause in causes.separate:
        own = [k for k, name in enumerate(causes.columns) if name == cause]
        worth[own] = np.maximum.accumulate(worth[own][::-1])[::-1]
    order = np.argsort(-worth, kind="stable")
    share = np.cumsum(square[:, order], axis=1)
    worst = np.where(variance[:, None] > 0.0, share, 1.0).min(axis=0)
    count = int(np.argmax(worst >= KEPT)) + 1 if worst[-1] >= KEPT else q
    return sorted(order[:count].tolist())


def _typical_rows(pair: StereoPair, names: Sequence[str]) -> Float:
    """(n, p) derivatives of positions and of shifts along each axis, over both cameras' view at their stand-off."""
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
