"""The entries of a calibration.json: the cameras' parameters, the settings and the checks of the calibration."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from stereorig.core.target import LINE_GRID
from stereorig.server.formats.records import Record


class RecordedMeasures(Record):
    """Reprojection measures; ``nsce`` is a pure number."""

    rbe_px: float | None = None
    raz_mm: float | None = None
    nsce: float | None = None


class CheckRecord(RecordedMeasures):
    """The measures of some positions of the cameras, together and by camera."""

    per_camera: dict[str, RecordedMeasures] = Field(default={})


class MadeCheck(Record):
    """A check that a calibration went through."""

    name: str = ""
    text: str | None = None


class ChecksRecord(Record):
    """The measures at the positions that were fitted and at those that were held out, and the checks made."""

    fitted: CheckRecord | None = None
    held_out: CheckRecord | None = None
    made: list[MadeCheck] = Field(default=[])


class VerdictRecord(Record):
    """The verdict on a calibration."""

    level: str | None = None
    reasons: list[str] = Field(default=[])


class UncertaintyRecord(Record):
    """Standard uncertainty of a shape from the calibration's covariance; ``scale`` is a pure number."""

    shape_rms_mm: float | None = None
    predicted_shape_rms_mm: float | None = None
    scale: float | None = None


class PoseRecord(Record):
    """A pose: rotation vector and translation."""

    rotation_vector_rad: tuple[float, float, float]
    translation_mm: tuple[float, float, float]


class ViewRecord(RecordedMeasures):
    """One image of the target, at a stage position or in a free pose."""

    camera: str
    dz_mm: float | None = None
    frame: int | None = None
    held_out: bool = False
    cam_from_target: PoseRecord | None = None


class TargetRecord(Record):
    """The target that was observed: a line grid with ``lines``, another board with ``size``."""

    kind: str = LINE_GRID
    lines: tuple[int, int] | None = None
    size: tuple[int, int] | None = None
    pitch_mm: float
    line_width_mm: float | None = None
    node_tolerance_mm: float = 0.0
    dark_lines: bool = True
    missing_lines: tuple[list[int], list[int]] = ([], [])
    marker_mm: float | None = None
    dictionary: str | None = None


class LensRecord(Record):
    """Lens model, and why it was taken."""

    model: str = "paper"
    reasons: list[str] = Field(default=[])


class StageRecord(Record):
    """The moving part of a calibration stage: the target or the cameras."""

    moves: str = "cameras"


class RecordedCamera(Record):
    """Identity of a camera, as it reports it."""

    model_config = ConfigDict(extra="allow")

    model: str | None = None
    serial: str | None = None


class OriginRecord(Record):
    """Origin of a calibration."""

    localiser: str | None = None
    frames: int | None = None
    rig: str | None = None
    software_version: str | None = None
    cameras: dict[str, RecordedCamera] = Field(default={})


class SettingsRecord(Record):
    """Settings of the fit."""

    axis_tilt_sigma_rad: float | None = None


class CalibrationRecord(Record):
    """Content of a calibration.json; another program's file has none of it, one of parameters alone only these."""

    cam1: dict[str, float] = Field(default={})
    cam2: dict[str, float] = Field(default={})
    checks: ChecksRecord | None = None
    verdict: VerdictRecord = VerdictRecord()
    uncertainty: UncertaintyRecord = UncertaintyRecord()
    lens: LensRecord = LensRecord()
    stage: StageRecord = StageRecord()
    sigma: dict[str, float | None] = Field(default={})
    views: list[ViewRecord] | None = None
    target: TargetRecord | None = None
    provenance: OriginRecord = OriginRecord()
    settings: SettingsRecord = SettingsRecord()
    kept_checks: dict[str, MadeCheck] = Field(default={})
