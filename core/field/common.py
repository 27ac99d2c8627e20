"""What is common in a field's uncertainty: the calibration's part to all points, the reference's noise to all steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.common.budget import budget_of
from core.common.derivatives import Estimator, ReferenceView, lower_root
from core.common.factor import FactorColumns, ParameterCovariance, sample_of
from core.field.points.result import Field

_POINTS_AT_ONCE = 4096
_KEPT_POINTS = 100_000  # of more, what the steps have in common is made anew for each: it is 0.5 kB a point


@dataclass(eq=False)
class CommonParts:
    """What is common in the uncertainty of the fields of one test.

    What depends on the reference's points alone is kept from field to field.

    Attributes
    ----------
    pair
        The cameras.
    source
        Covariance of their parameters; None where it is not known.
    """

    pair: StereoPair
    source: ParameterCovariance | None

    def __post_init__(self) -> None:
        self._known: tuple[NDArray[np.int64], ReferenceView] | None = None

    def of(self, field: Field) -> Field:
        """Return the field with what is common in its uncertainty, to all its points and to all steps of a test.

        It gets the common factor of its points, none where the calibration's covariance is not known, and the part of
        the displacement's noise that is the first reference pair's. Of what later references added it has nothing: that
        counts as new in each step, which is more than there is between two steps of one reference.

        Parameters
        ----------
        field
            In the system frame, as it is shown: smoothed or not. Smoothing reproduces what varies slowly over its
            window.

        Raises
        ------
        CalibrationInputError
            ``covariance_not_positive``.
        """
        valid = field.valid
        view = self._view(field.xyz_mm[valid], valid)
        now = None if field.uvw_mm is None else view.points_mm + field.uvw_mm[valid]
        n = len(view.points_mm)
        if n <= _KEPT_POINTS:
            view.keep()

        def at(some: slice) -> Estimator:
            return Estimator.at(self.pair, view.points_mm[some], None if now is None else now[some], view.at(some))

        common, columns, frozen = None, None, None
        if self.source is not None:
            own = np.diagonal(field.covariance, axis1=2, axis2=3)[valid]
            columns = FactorColumns.chosen(
                self.source, at(sample_of(n)), np.sqrt(np.median(own, axis=0)) if n else None
            )
            common = np.full((valid.size, own.shape[-1], len(columns.causes.columns)), np.nan, np.float32)
        added = None if field.references is None else field.references.added_share
        if now is not None and (field.references is None or added is not None):
            frozen = np.full((valid.size, 3, 3), np.nan)
        place = np.flatnonzero(valid)
        noise = field.covariance.reshape(valid.size, *field.covariance.shape[2:])
        for first in range(0, n, _POINTS_AT_ONCE):  # what stays in the processor's cache
            some = slice(first, min(first + _POINTS_AT_ONCE, n))
            estimator, here = at(some), place[some]
            if common is not None and columns is not None:
                common[here] = columns.at(estimator)
            if frozen is not None:
                share = None if added is None else added.reshape(-1, 3, 3)[here]
                frozen[here] = _frozen(noise[here, 3:, 3:], estimator, share)
        return replace(
            field,
            common=None if common is None else common.reshape(*field.shape, *common.shape[1:]),
            causes=None if columns is None else columns.causes,
            frozen=None if frozen is None else frozen.reshape(*field.shape, 3, 3),
        )

    def _view(self, points: Float, valid: Bool) -> ReferenceView:
        """The reference's view of a field's valid points: a step's are the reference's own, but for those it lost."""
        if self._known is not None and self._known[0].shape == valid.shape:
            place, view = self._known
            index = place[valid]
            if (index >= 0).all() and np.array_equal(view.points_mm[index], points):
                return view if len(index) == len(view.ray) else view.at(index)
        place = np.full(valid.shape, -1, np.int64)
        place[valid] = np.arange(len(points))
        view = ReferenceView.of(self.pair, points)
        self._known = (place, view) if len(points) <= _KEPT_POINTS else None
        return view


def with_common_parts(field: Field, source: ParameterCovariance | None, pair: StereoPair) -> Field:
    """Return one field with what is common in its uncertainty: see :meth:`CommonParts.of`."""
    return CommonParts(pair, source).of(field)


def _frozen(own: Float, at: Estimator, added: Float | None = None) -> Float:
    """(n, 3, 3) of the covariance of U, V, W what is the reference pair's noise.

    ``added`` (n, 3, 3) is the share that later references added, of :class:`core.field.points.result.References`: the
    rest is as if the step had been matched against the first one.
    """
    root = lower_root(own)
    if added is None:
        return np.asarray(own - at.new_noise(root))
    left = root @ lower_root(_positive(np.eye(3) - added))
    return np.asarray(left @ np.swapaxes(left, 1, 2) - at.new_noise(left))


def _positive(matrices: Float) -> Float:
    """Return symmetric matrices (n, 3, 3) without their negative eigenvalues: what a check lowered may leave some."""
    value, vector = np.linalg.eigh(0.5 * (matrices + np.swapaxes(matrices, 1, 2)))
    return np.asarray((vector * np.maximum(value, 0.0)[:, None, :]) @ np.swapaxes(vector, 1, 2))


def notes_of(field: Field) -> tuple[str, ...]:
    """Return what budgets of a field's quantities do not tell apart, and what they do not include."""
    at_reference = 0.0 if field.tells_reference else None
    row = None if field.common is None else np.zeros(field.common.shape[-1])
    return budget_of(0.0, at_reference, row, field.causes).notes
