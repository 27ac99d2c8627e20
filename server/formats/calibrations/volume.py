"""Calibrated volume and reprojection error of a calibration.json."""

from __future__ import annotations

import math

from core.calibration.volume import CalibratedVolume, calibrated_volume
from core.errors import TargetError
from core.names import CAMERAS
from core.target import GridTarget
from server.formats.calibrations.native import covariance_in
from server.formats.calibrations.recognise import LoadedCalibration
from server.formats.calibrations.record import ChecksRecord


def volume_of(calibration: LoadedCalibration) -> CalibratedVolume | None:
    """Return a pair's calibrated volume; None if its file does not state it (other programs', or parameters alone).

    Raises
    ------
    FileFormatError
        ``calibration_unreadable`` if the file's covariance is not usable.
    """
    record = calibration.record
    sizes = (calibration.image_size1_px, calibration.image_size2_px)
    if sizes[0] is None or sizes[1] is None or record.target is None or record.views is None:
        return None
    # those that the fit used
    fitted = [view for view in record.views if not view.held_out]
    positions = [[view.dz_mm for view in fitted if view.camera == cam] for cam in CAMERAS]
    target = record.target
    try:
        grid = GridTarget(pitch_mm=target.pitch_mm, lines=target.lines, line_width_mm=target.line_width_mm)
    except TargetError:
        return None
    return calibrated_volume(
        calibration.pair,
        grid.all_points_mm(),
        (sizes[0], sizes[1]),
        positions,
        pitch_mm=grid.pitch_mm,
        covariance=covariance_in(calibration.details, name="calibration.json"),
    )


def rbe_of(calibration: LoadedCalibration) -> float | None:
    """Return the calibration's reprojection error, of held-out positions where there are any; None if not known."""
    checks = calibration.record.checks or ChecksRecord()
    for measures in (checks.held_out, checks.fitted):
        value = None if measures is None else measures.rbe_px
        if value is not None and math.isfinite(value) and value >= 0.0:
            return value
    return None


def own_px_of(calibration: LoadedCalibration) -> float | None:
    """Return the calibration's own epipolar offset at most, px: from both images' residuals; None if unknown."""
    rbe = rbe_of(calibration)
    return None if rbe is None else 2.0 * rbe
