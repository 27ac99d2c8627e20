"""The calibration: one immutable result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from core.arrays import Float
from core.calibration.checks.measures import CheckMeasures
from core.calibration.checks.positions import PositionCheck
from core.calibration.inputs import CalibrationOptions, NominalCamera
from core.calibration.uncertainty import VolumeUncertainty
from core.cameras.camera import TEN_PARAMETER_NAMES
from core.cameras.stereo import StereoPair
from core.names import CAMERAS, CameraName

COVARIANCE_NAMES = tuple(f"{camera}.{name}" for camera in CAMERAS for name in TEN_PARAMETER_NAMES)
TEN_OF_BOTH = np.r_[0:10, 12:22]  # indices of the ten parameters of both cameras among the adjustment's 24
Level = Literal["good", "warning", "failed"]


@dataclass(frozen=True)
class ViewResult:
    """Residuals of one view.

    Attributes
    ----------
    camera, dz_mm, name, held_out
        The view, and True if it was left out of the fit.
    residual_px
        (n_a, n_b, 2) measured minus projected, NaN where not found; against the nodes the calibration used.
    rbe_px, raz_mm, nsce
        The paper's measures of this view.
    """

    camera: CameraName
    dz_mm: float
    name: str
    held_out: bool
    residual_px: Float
    rbe_px: float
    raz_mm: float
    nsce: float


@dataclass(frozen=True)
class Verdict:
    """Good, warning or failed, with the reasons as text."""

    level: Level
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class CheckDone:
    """One possible check of a calibration: ``made`` or not, and its finding."""

    name: str
    made: bool
    text: str


@dataclass(frozen=True)
class CalibrationResult:
    """Both calibrated cameras, with uncertainty, checks and verdict.

    Attributes
    ----------
    pair
        The cameras at dZ = 0.
    covariance
        (20, 20) of :data:`COVARIANCE_NAMES`: ten parameters of camera 1, then of camera 2. Priors are included.
    noise_px
        (2,) standard deviation per coordinate of the intersections, from the residuals, per camera.
    redundancy
        (2,) observations beyond the unknowns, per camera.
    axis_tilt_rad, axis_tilt_sigma_rad
        (2, 2) camera by direction; zero where the axis was held.
    node_corrections_mm, node_sigma_mm
        (n_a, n_b, 2) estimated departures of the nodes from the nominal grid; None where the grid was held.
    fitted, held_out
        The paper's measures; ``held_out`` is None where no position was left out.
    views
        Residuals per view, cameras in order, positions ascending.
    uncertainty
        Predicted uncertainty in the target's volume.
    predicted
        The same as it was predicted before the fit, from nominal values.
    positions
        Declared against seen positions, per camera.
    checks
        Checks made and not made.
    verdict
        Automatic assessment, with reasons.
    """

    pair: StereoPair
    covariance: Float
    noise_px: Float
    redundancy: Float
    axis_tilt_rad: Float
    axis_tilt_sigma_rad: Float
    node_corrections_mm: Float | None
    node_sigma_mm: Float | None
    fitted: CheckMeasures
    held_out: CheckMeasures | None
    views: tuple[ViewResult, ...]
    uncertainty: VolumeUncertainty
    predicted: VolumeUncertainty
    positions: tuple[PositionCheck, PositionCheck]
    checks: tuple[CheckDone, ...]
    verdict: Verdict
    nominals: tuple[NominalCamera, NominalCamera]
    options: CalibrationOptions
    iterations: int

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each parameter, by its name in :data:`COVARIANCE_NAMES`."""
        return dict(zip(COVARIANCE_NAMES, np.sqrt(np.diagonal(self.covariance)).tolist(), strict=True))

    @property
    def covariance_per_camera(self) -> tuple[Float, Float]:
        """(10, 10) of each camera."""
        return self.covariance[:10, :10], self.covariance[10:, 10:]
