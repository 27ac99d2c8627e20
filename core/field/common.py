"""What is common in a field's uncertainty: the calibration's part to all points, the reference's noise to all steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.cameras.stereo import StereoPair
from core.common.budget import budget_of
from core.common.derivatives import new_noise_share
from core.common.factor import ParameterCovariance, factor_of
from core.field.points.result import Field
from core.field.points.shared_pixels import roots_of


def with_common_factor(field: Field, source: ParameterCovariance | None) -> Field:
    """Return the field with the common factor of its points; without one where the covariance is not known.

    Parameters
    ----------
    field
        In the system frame, as it is shown: smoothed or not. Smoothing reproduces what varies slowly over its window.
    source
        Covariance of the cameras' parameters.

    Raises
    ------
    CalibrationInputError
        ``covariance_not_positive``.
    """
    if source is None:
        return replace(field, common=None, causes=None)
    valid = field.valid
    points = field.xyz_mm[valid]
    now = None if field.uvw_mm is None else points + field.uvw_mm[valid]
    found = factor_of(source, points, now)
    out = np.full((*field.shape, *found.values.shape[1:]), np.nan)
    out[valid] = found.values
    return replace(field, common=out, causes=found.causes)


def notes_of(field: Field) -> tuple[str, ...]:
    """Return what budgets of a field's quantities do not tell apart, and what they do not include."""
    at_reference = None if field.frozen_covariance is None else 0.0
    row = None if field.common is None else np.zeros(field.common.shape[-1])
    return budget_of(0.0, at_reference, row, field.causes).notes


def with_frozen_noise(field: Field, pair: StereoPair) -> Field:
    """Return the field with the part of its displacement's noise that is the reference pair's, in all steps alike.

    Parameters
    ----------
    field
        In the system frame, as it is shown: smoothed or not.
    pair
        The cameras.
    """
    if field.uvw_mm is None or field.references is not None:
        return replace(field, frozen=None)
    valid = field.valid
    points = field.xyz_mm[valid]
    own = field.covariance[valid][:, 3:, 3:]
    root = roots_of(own)
    out = np.full((*field.shape, 3, 3), np.nan)
    out[valid] = own - root @ new_noise_share(pair, points, points + field.uvw_mm[valid]) @ root
    return replace(field, frozen=out)
