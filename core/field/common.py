"""The calibration's part of a field's uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.common.factor import ParameterCovariance, common_factor
from core.field.points.result import Field


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
        return replace(field, common=None)
    valid = field.valid
    points = field.xyz_mm[valid]
    now = None if field.uvw_mm is None else points + field.uvw_mm[valid]
    found = common_factor(source, points, now)
    out = np.full((*field.shape, *found.shape[1:]), np.nan)
    out[valid] = found
    return replace(field, common=out)
