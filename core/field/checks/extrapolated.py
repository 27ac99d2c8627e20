"""Points outside the volume in which the cameras were calibrated: flagged."""

from __future__ import annotations

from dataclasses import replace

from stereorig.core.calibration.volume import CalibratedVolume
from stereorig.core.field.points.result import Field
from stereorig.core.status import PointStatus


def mark_extrapolated(field: Field, volume: CalibratedVolume | None) -> Field:
    """Return the field with those points marked that are, or were at the reference, outside the calibrated volume.

    Their status becomes EXTRAPOLATED. The calibration's part of their uncertainty, which grows without bound there, is
    in the field's common factor as everywhere.

    Parameters
    ----------
    field
        As measured. A step's starts and the shape that later steps are measured with are taken from the unmarked field.
    volume
        The calibrated volume; None if not known: nothing is marked.
    """
    if volume is None:
        return field
    outside = field.status == PointStatus.OK
    outside &= ~volume.contains(field.xyz_mm)
    now = None if field.uvw_mm is None else field.xyz_mm + field.uvw_mm
    if now is not None:
        outside |= (field.status == PointStatus.OK) & ~volume.contains(now)
    if not outside.any():
        return field
    status = field.status.copy()
    status[outside] = PointStatus.EXTRAPOLATED
    return replace(field, status=status)
