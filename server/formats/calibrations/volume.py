"""What a calibration.json tells a measurement besides its cameras: the calibrated volume and its own error."""

from __future__ import annotations

import math
from typing import Any

from core.calibration.volume import CalibratedVolume, calibrated_volume
from core.errors import TargetError
from core.names import CAMERAS
from core.target import GridTarget
from server.formats.calibrations.native import covariance_in
from server.formats.calibrations.recognise import LoadedCalibration


def volume_of(calibration: LoadedCalibration) -> CalibratedVolume | None:
    """Return where a pair was calibrated; None if its file does not say (other programs', or parameters alone).

    Raises
    ------
    FileFormatError
        ``calibration_unreadable`` if the file's covariance is not usable.
    """
    content = calibration.details
    sizes = (calibration.image_size1_px, calibration.image_size2_px)
    target, views = content.get("target"), content.get("views")
    if sizes[0] is None or sizes[1] is None or not isinstance(target, dict) or not isinstance(views, list):
        return None
    positions = [_positions(views, camera) for camera in CAMERAS]
    try:
        grid = GridTarget(
            pitch_mm=target["pitch_mm"], lines=tuple(target["lines"]), line_width_mm=target["line_width_mm"]
        )
    except (KeyError, TypeError, TargetError):
        return None
    return calibrated_volume(
        calibration.pair,
        grid.all_points_mm(),
        (sizes[0], sizes[1]),
        positions,
        pitch_mm=grid.pitch_mm,
        covariance=covariance_in(content, name="calibration.json"),
    )


def rbe_of(calibration: LoadedCalibration) -> float | None:
    """Return the calibration's reprojection error, of held-out positions where there are any; None if not told."""
    checks = calibration.details.get("checks")
    if not isinstance(checks, dict):
        return None
    for name in ("held_out", "fitted"):
        measures = checks.get(name)
        value = measures.get("rbe_px") if isinstance(measures, dict) else None
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0.0:
            return float(value)
    return None


def _positions(views: list[Any], camera: str) -> list[float]:
    """Travels of a camera's views that the fit used."""
    return [
        float(view["dz_mm"])
        for view in views
        if isinstance(view, dict)
        and view.get("camera") == camera
        and not view.get("held_out", False)
        and isinstance(view.get("dz_mm"), int | float)
    ]
