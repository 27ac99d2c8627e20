"""Common parts of a field's uncertainty: the calibration's part for all points, the reference's noise for all steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Bool, Float
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.common.budget import budget_of
from stereorig.core.common.derivatives import Estimator, ReferenceView, lower_root
from stereorig.core.common.factor import Causes, FactorColumns, ParameterCovariance, sample_of
from stereorig.core.field.points.result import Field

_POINTS_AT_ONCE = 1024
# for larger fields the derivatives that all steps share are recomputed in each step: they take 0.5 kB a point
_KEPT_POINTS = 100_000


@dataclass(eq=False)
class CommonParts:
    """Common parts of the uncertainty of the fields of one test.

    Derivatives that depend on the reference's points alone are kept from field to field.

    Attributes
    ----------
    pair
        The cameras.
    source
        Covariance of their parameters; None if it is not known.
    """

    pair: StereoPair
    source: ParameterCovariance | None

    def __post_init__(self) -> None:
        self._known: tuple[NDArray[np.int64], ReferenceView] | None = None

    def of(self, field: Field, pull_mm: Float | None = None) -> Field:
        """Return the field with the common parts of its uncertainty, for all its points and for all steps of a test.

        It gets the common factor of its points, none if the calibration's covariance is not known, and the part of the
        displacement's noise that is the first reference pair's. The part does not include noise that later references
        added: this counts as new in each step, which overestimates it between two steps of one reference.

        Parameters
        ----------
        field
            In the system frame, as it is shown: smoothed or not. Smoothing reproduces values that vary slowly over its
            window.
        pull_mm
            (r, c, 3) shift of U, V, W by a sensor's fixed pattern (:mod:`stereorig.core.systematic.sensor_pull`): one
            more column. None: no shift. None: nothing.

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
        for first in range(0, n, _POINTS_AT_ONCE):  # points whose arrays stay in the processor's cache
            some = slice(first, min(first + _POINTS_AT_ONCE, n))
            estimator, here = at(some), place[some]
            if common is not None and columns is not None:
                common[here] = columns.at(estimator)
            if frozen is not None:
                share = None if added is None else added.reshape(-1, 3, 3)[here]
                frozen[here] = _frozen(noise[here, 3:, 3:], estimator, share)
        whole = replace(
            field,
            common=None if common is None else common.reshape(*field.shape, *common.shape[1:]),
            causes=None if columns is None else columns.causes,
            frozen=None if frozen is None else frozen.reshape(*field.shape, 3, 3),
        )
        return whole if pull_mm is None else _with_pull(whole, pull_mm)

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


def with_common_parts(
    field: Field, source: ParameterCovariance | None, pair: StereoPair, pull_mm: Float | None = None
) -> Field:
    """Return one field with the common parts of its uncertainty: see :meth:`CommonParts.of`."""
    return CommonParts(pair, source).of(field, pull_mm)


def _with_pull(field: Field, pull_mm: Float) -> Field:
    """Return a motion with one more column in its common factor."""
    column = np.concatenate([np.where(np.isfinite(pull_mm), 0.0, np.nan), pull_mm], axis=-1)[..., None]
    known = np.zeros((*field.shape, 6, 0), np.float32) if field.common is None else field.common
    causes = Causes((), ()) if field.common is None else field.causes or Causes.unseparated(known.shape[-1])
    return replace(field, common=np.concatenate([known, column.astype(np.float32)], axis=-1), causes=causes.with_sensor)


def _frozen(own: Float, at: Estimator, added: Float | None = None) -> Float:
    """(n, 3, 3) part of the covariance of U, V, W that is the reference pair's noise.

    ``added`` (n, 3, 3) is the share that later references added, of
    :class:`stereorig.core.field.points.result.References`: the rest is as if the step had been matched against the
    first one.
    """
    root = lower_root(own)
    if added is None:
        return np.asarray(own - at.new_noise(root))
    left = root @ lower_root(_positive(np.eye(3) - added))
    return np.asarray(left @ np.swapaxes(left, 1, 2) - at.new_noise(left))


def _positive(matrices: Float) -> Float:
    """Return symmetric matrices (n, 3, 3) without their negative eigenvalues, which a lowered variance may leave."""
    value, vector = np.linalg.eigh(0.5 * (matrices + np.swapaxes(matrices, 1, 2)))
    return np.asarray((vector * np.maximum(value, 0.0)[:, None, :]) @ np.swapaxes(vector, 1, 2))


def notes_of(field: Field) -> tuple[str, ...]:
    """Return the sources that budgets of a field's quantities do not separate, and those that they do not include."""
    at_reference = 0.0 if field.knows_reference else None
    row = None if field.common is None else np.zeros(field.common.shape[-1])
    return budget_of(0.0, at_reference, row, field.causes).notes
