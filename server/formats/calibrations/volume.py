"""Calibrated volume and reprojection error of a calibration.json."""

from __future__ import annotations

import math

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.boards.board import BOARD_KINDS, BoardTarget
from stereorig.core.calibration.volume import CalibratedVolume, calibrated_volume, volume_of_poses
from stereorig.core.cameras.camera import RigidTransform
from stereorig.core.common.factor import ParameterCovariance
from stereorig.core.errors import TargetError
from stereorig.core.names import CAMERAS
from stereorig.core.target import LINE_GRID, GridTarget
from stereorig.server.formats.calibrations.native import parameters_in
from stereorig.server.formats.calibrations.recognise import LoadedCalibration
from stereorig.server.formats.calibrations.record import ChecksRecord, PoseRecord, TargetRecord


def volume_of(calibration: LoadedCalibration) -> CalibratedVolume | None:
    """Return a pair's calibrated volume; None if its file does not state it (other programs', or parameters alone)."""
    record = calibration.record
    sizes = (calibration.image_size1_px, calibration.image_size2_px)
    if sizes[0] is None or sizes[1] is None or record.target is None or record.views is None:
        return None
    # those that the fit used
    fitted = [view for view in record.views if not view.held_out]
    target = record.target
    points = _points_mm(target)
    if points is None:
        return None
    if record.stage.moves == "cameras" and all(view.dz_mm is not None for view in fitted):
        positions = [
            [view.dz_mm for view in fitted if view.camera == cam and view.dz_mm is not None] for cam in CAMERAS
        ]
        return calibrated_volume(calibration.pair, points, (sizes[0], sizes[1]), positions, pitch_mm=target.pitch_mm)
    poses = [
        [_transform(view.cam_from_target) for view in fitted if view.camera == cam and view.cam_from_target is not None]
        for cam in CAMERAS
    ]
    return volume_of_poses(calibration.pair, points, (sizes[0], sizes[1]), poses, pitch_mm=target.pitch_mm)


def parameter_covariance(calibration: LoadedCalibration) -> ParameterCovariance | None:
    """Return the covariance of the cameras' parameters, by cause; None where the file does not state it.

    Raises
    ------
    FileFormatError
        ``calibration_unreadable`` if the file's covariance is not usable.
    """
    return parameters_in(calibration.details, name="calibration.json", pair=calibration.pair)


def target_of(target: TargetRecord | None) -> GridTarget | BoardTarget | None:
    """Return the target that a calibration's file describes; None if it describes none."""
    if target is None:
        return None
    try:
        if target.kind == LINE_GRID:
            if target.lines is None or target.line_width_mm is None:
                return None
            return GridTarget(pitch_mm=target.pitch_mm, lines=target.lines, line_width_mm=target.line_width_mm)
        kind = next((k for k in BOARD_KINDS if k == target.kind), None)
        if kind is None or target.size is None:
            return None
        return BoardTarget(kind=kind, size=target.size, pitch_mm=target.pitch_mm, marker_mm=target.marker_mm)
    except TargetError:
        return None


def _points_mm(target: TargetRecord) -> Float | None:
    found = target_of(target)
    if found is None:
        return None
    return found.all_points_mm() if isinstance(found, GridTarget) else found.points_mm()


def _transform(pose: PoseRecord) -> RigidTransform:
    from scipy.spatial.transform import Rotation  # slow to load, and not every start needs it

    rotation = Rotation.from_rotvec(pose.rotation_vector_rad).as_matrix()
    return RigidTransform(rotation, np.array(pose.translation_mm))


def rbe_of(calibration: LoadedCalibration) -> float | None:
    """Return the calibration's reprojection error in px, at held-out positions if there are any; None if not known."""
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
