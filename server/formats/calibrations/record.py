"""The entries of a calibration.json: the cameras' parameters, the settings and the checks of the calibration."""

from __future__ import annotations

from pydantic import Field

from server.formats.records import Record


class Measures(Record):
    """Reprojection measures; ``nsce`` is a pure number."""

    rbe_px: float | None = None
    raz_mm: float | None = None
    nsce: float | None = None


class CheckRecord(Measures):
    """The measures of some positions of the cameras, together and by camera."""

    per_camera: dict[str, Measures] = Field(default={})


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


class ViewRecord(Measures):
    """One image of the target."""

    camera: str
    dz_mm: float
    held_out: bool = False


class TargetRecord(Record):
    """The grid that was observed."""

    lines: tuple[int, int]
    pitch_mm: float
    line_width_mm: float
    node_tolerance_mm: float = 0.0
    dark_lines: bool = True


class CameraIdentity(Record):
    """Identity of a camera, as it reports it."""

    model: str | None = None
    serial: str | None = None


class OriginRecord(Record):
    """Origin of a calibration."""

    localiser: str | None = None
    frames: int | None = None
    rig: str | None = None
    software_version: str | None = None
    cameras: dict[str, CameraIdentity] = Field(default={})


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
    sigma: dict[str, float | None] = Field(default={})
    views: list[ViewRecord] | None = None
    target: TargetRecord | None = None
    provenance: OriginRecord = OriginRecord()
    settings: SettingsRecord = SettingsRecord()
