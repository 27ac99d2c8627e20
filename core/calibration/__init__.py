"""Calibration of the pair from views of the grid: ten parameters a camera, checks, verdict."""

from typing import TYPE_CHECKING

from stereorig.core.lazy import names_of

if TYPE_CHECKING:
    from stereorig.core.calibration.checks.distance import DistanceCheck, check_known_distance
    from stereorig.core.calibration.checks.measures import CheckMeasures, Measures, measure_points
    from stereorig.core.calibration.inputs import (
        AnyTarget,
        CalibrationOptions,
        CalibrationView,
        NominalValues,
        TargetLike,
        inner_nodes_mm,
    )
    from stereorig.core.calibration.prepare import predict_uncertainty
    from stereorig.core.calibration.result import COVARIANCE_NAMES, CalibrationResult, CheckDone, Verdict, ViewResult
    from stereorig.core.calibration.solve import calibrate
    from stereorig.core.calibration.uncertainty import VolumeUncertainty, volume_uncertainty

__all__ = [
    "COVARIANCE_NAMES",
    "AnyTarget",
    "CalibrationOptions",
    "CalibrationResult",
    "CalibrationView",
    "CheckDone",
    "CheckMeasures",
    "DistanceCheck",
    "Measures",
    "NominalValues",
    "TargetLike",
    "Verdict",
    "ViewResult",
    "VolumeUncertainty",
    "calibrate",
    "check_known_distance",
    "inner_nodes_mm",
    "measure_points",
    "predict_uncertainty",
    "volume_uncertainty",
]

__getattr__, __dir__ = names_of(
    __name__,
    {
        "checks.distance": ("DistanceCheck", "check_known_distance"),
        "checks.measures": ("CheckMeasures", "Measures", "measure_points"),
        "inputs": (
            "AnyTarget",
            "CalibrationOptions",
            "CalibrationView",
            "NominalValues",
            "TargetLike",
            "inner_nodes_mm",
        ),
        "prepare": ("predict_uncertainty",),
        "result": ("COVARIANCE_NAMES", "CalibrationResult", "CheckDone", "Verdict", "ViewResult"),
        "solve": ("calibrate",),
        "uncertainty": ("VolumeUncertainty", "volume_uncertainty"),
    },
)
