"""The calibration: one immutable result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.cameras.camera import TEN_PARAMETER_NAMES, RigidTransform
from stereorig.core.cameras.stereo import StereoPair
from stereorig.core.errors import CalibrationError
from stereorig.core.names import CAMERAS, CameraName, Cause

if TYPE_CHECKING:  # who measures reads a calibration's names, and needs nothing that fits one
    from stereorig.core.calibration.checks.measures import CheckMeasures
    from stereorig.core.calibration.checks.positions import PositionCheck
    from stereorig.core.calibration.choice.screening import DroppedView
    from stereorig.core.calibration.choice.structure import Structure
    from stereorig.core.calibration.fit.lens_form import LensName
    from stereorig.core.calibration.inputs import CalibrationOptions, Moves, NominalValues
    from stereorig.core.calibration.uncertainty import VolumeUncertainty

#: parameters of a pair with the paper's lens and a given aspect ratio, the usual order of a covariance
COVARIANCE_NAMES = tuple(f"{camera}.{name}" for camera in CAMERAS for name in TEN_PARAMETER_NAMES)
Level = Literal["good", "warning", "failed"]


@dataclass(frozen=True)
class ViewResult:
    """Residuals of one view.

    Attributes
    ----------
    camera, dz_mm, frame, name, held_out
        The view, its stage position or the number of its free pose, and True if it was left out of the fit.
    residual_px
        (n_a, n_b, 2) measured minus projected, NaN where not found; against the nodes the calibration used.
    rbe_px, raz_mm, nsce
        The paper's measures of this view.
    cam_from_target
        Pose of the target in the camera's frame.
    """

    camera: CameraName
    dz_mm: float | None
    frame: int | None
    name: str
    held_out: bool
    residual_px: Float
    rbe_px: float
    raz_mm: float
    nsce: float
    cam_from_target: RigidTransform


@dataclass(frozen=True)
class LensChosen:
    """Lens model of a calibration.

    Attributes
    ----------
    model
        Its name.
    reasons
        Why it was taken.
    structure
        Structure of its residuals beyond noise.
    """

    model: LensName
    reasons: tuple[str, ...]
    structure: tuple[Structure, ...]


@dataclass(frozen=True)
class StageFound:
    """Properties of the stage as the views show them.

    Attributes
    ----------
    moves
        Part of the rig that it moves.
    direction_sys, direction_sigma_rad
        (3,) unit vector along which a single stage moves the target in the system frame, dZ growing, and the standard
        deviation of its first two components (2,); None if each camera has its own stage or nothing moves.
    scale, scale_sigma
        (2,) relative error of each axis' travel; zero and zero if it was held.
    steps
        Positions read back with the error found and its standard deviation, mm: (axis, dZ, error, sigma).
    """

    moves: Moves
    direction_sys: Float | None
    direction_sigma_rad: Float | None
    scale: Float
    scale_sigma: Float
    steps: tuple[tuple[int, float, float, float], ...]


@dataclass(frozen=True)
class Verdict:
    """Good, warning or failed, with the reasons as text, and those that fail with the remedy of each."""

    level: Level
    reasons: tuple[str, ...]
    failures: tuple[tuple[str, str], ...] = ()

    def check(self) -> None:
        """Raise CalibrationError ``calibration_rejected`` with all that fails, if the verdict is failed."""
        if self.level == "failed":
            raise CalibrationError(
                f"The calibration is not usable: {' '.join(text for text, _ in self.failures)}",
                code="calibration_rejected",
                remedy=" ".join(dict.fromkeys(remedy for _, remedy in self.failures)),
            )


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
    names, covariance
        Estimated parameters of camera 1, then of camera 2, and their covariance (n, n); with the paper's lens and a
        given aspect ratio :data:`COVARIANCE_NAMES`. Priors are included.
    covariance_by_cause
        (n, n) parts of it, which add up to it: ``calibration`` from the views' noise, ``stage`` from the priors of
        steps, scale and tilt, ``target`` from the priors of the pitch and the nodes.
    lens
        Lens model and why.
    stage
        Properties of the stage as the views show them.
    pitch_scale, pitch_scale_sigma
        Relative error of the target's pitch; zero and zero if it was held.
    dropped
        Views left out, with the reasons.
    noise_px
        (2,) standard deviation per coordinate of the intersections, from the residuals, per camera.
    redundancy
        (2,) observations beyond the unknowns, per camera.
    axis_tilt_rad, axis_tilt_sigma_rad
        (2, 2) camera by direction; zero if the axis was held.
    node_corrections_mm, node_sigma_mm
        (n_a, n_b, 2), with free poses (n_a, n_b, 3): estimated departures of the nodes from the nominal target; None if
        the nodes were held.
    fitted, held_out
        The paper's measures; ``held_out`` is None if no position was left out.
    views
        Residuals per view, cameras in order, positions ascending.
    uncertainty
        Predicted uncertainty in the target's volume.
    predicted
        The same as it was predicted before the fit, from nominal values; None with free poses.
    positions
        Declared against seen positions, per camera; empty without stage positions.
    checks
        Checks made and not made.
    verdict
        Automatic assessment, with reasons.
    """

    pair: StereoPair
    names: tuple[str, ...]
    covariance: Float
    covariance_by_cause: dict[Cause, Float]
    lens: LensChosen
    stage: StageFound
    pitch_scale: float
    pitch_scale_sigma: float
    dropped: tuple[DroppedView, ...]
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
    predicted: VolumeUncertainty | None
    positions: tuple[PositionCheck, ...]
    checks: tuple[CheckDone, ...]
    verdict: Verdict
    nominals: tuple[NominalValues, NominalValues]
    options: CalibrationOptions
    iterations: int

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each estimated parameter, by its name in ``names``."""
        return dict(zip(self.names, np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0)).tolist(), strict=True))
