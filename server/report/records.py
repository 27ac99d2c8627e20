"""Parts of the records beside the results that a report reads: of the test, its steps, the rig, the analysis."""

from __future__ import annotations

from pathlib import Path

from pydantic import AliasChoices, Field

from server.config.camera_metadata import LensMetadata
from server.formats.calibrations.record import CameraIdentity
from server.formats.records import Record
from server.store.documents import METADATA_NAMES


class CameraRecord(Record):
    """A camera as the rig file describes it and as it was set.

    See :class:`server.config.camera_metadata.CameraMetadata`.
    """

    maker: str | None = None
    model: str | None = None
    sensor: str | None = None
    pixel_um: float | None = None
    lens: LensMetadata | None = None
    exposure_ms: float | None = None
    gain_db: float | None = None


class RigRecord(Record):
    """The rig that a step was captured with."""

    simulated: bool = False
    trigger: str | None = None
    frame_rate_hz: float | None = None
    max_skew_ms: float | None = None
    lighting: str | None = None
    cameras: dict[str, CameraRecord] = Field(default={})


class ImageFigures(Record):
    """Figures of one camera's image, see :class:`server.results.images.quality.ImageQuality`."""

    mean_grey: float | None = None
    contrast_grey: float | None = None
    saturated_share: float | None = None
    focus: float | None = None


class QualityRecord(Record):
    """Quality of a pair of images."""

    code: str = ""
    cam1: ImageFigures = ImageFigures()
    cam2: ImageFigures = ImageFigures()


class StepRecord(Record):
    """``step.json``."""

    label: str = ""
    load_n: float | None = None
    channels: dict[str, float] = Field(default={})
    source: str | None = None
    captured_utc: str | None = None
    host_monotonic_ns: int | None = None
    skew_ms: float | None = None
    frames: int | None = None
    bit_depth: dict[str, int] = Field(default={})
    image_size_px: dict[str, tuple[int, int]] = Field(default={})
    quality: QualityRecord | None = None
    cameras: dict[str, CameraIdentity] = Field(default={})
    rig: RigRecord = RigRecord()


class TestRecord(Record):
    """``test.json``."""

    __test__ = False

    id: str = ""
    name: str = ""
    calibration_id: str | None = None
    calibration_sha256: str | None = None
    calibrations: dict[str, str | None] = Field(default={})
    specimen: str = ""
    notes: str = ""
    metadata: dict[str, object] = Field(default={}, validation_alias=AliasChoices(*METADATA_NAMES))


class OffsetRecord(Record):
    """One finding about the cameras, see :class:`core.orientation.OffsetFinding`."""

    camera_moved: bool | None = None
    offset_rms_px: float
    expected_px: float
    sigmas: float


class CameraMotionRecord(Record):
    """What a step's epipolar offsets said about the cameras, see :class:`server.formats.results.camera_motion`."""

    camera_moved: bool | None = None
    text: str
    calibration: OffsetRecord | None = None
    reference: OffsetRecord | None = None


class StepSummaryRecord(Record):
    """A step of ``summary.json``, or of the service's ``step_0001.json`` beside its result."""

    n: int
    camera_motion: CameraMotionRecord | None = None


class CalibrationFile(Record):
    """The calibration that ``stereorig measure`` was given."""

    file: Path


class AnalysisRecord(Record):
    """``analysis.json`` of the service, or ``summary.json`` of ``stereorig measure``."""

    id: str = ""
    label: str = ""
    calibration: CalibrationFile | None = None


class SummaryRecord(Record):
    """``summary.json``."""

    steps: list[StepSummaryRecord] = Field(default=[])


class OutlineRecord(Record):
    """One outline of a region, px of camera 1's reference image."""

    rectangle: tuple[float, float, float, float] | None = None
    polygon: list[tuple[float, float]] | None = None
    circle: tuple[float, float, float] | None = None


class RegionRecord(OutlineRecord):
    """Region of the points, px of camera 1's reference image."""

    outlines: list[OutlineRecord] = Field(default=[])
    cracks: list[object] | None = None
    holes: list[object] | None = None
    mask: object = None


class NoiseRecord(Record):
    """A camera's noise model: variance by powers of the grey level."""

    coefficients: list[float]
    frames: int


class NoiseRecords(Record):
    """The noise models that were measured with."""

    cam1: NoiseRecord | None = None
    cam2: NoiseRecord | None = None


class SettingsRecord(Record):
    """Settings of the analysis, as its result files have them."""

    reference: int = 0
    subset_px: float | None = None
    spacing_px: float | None = None
    dense_step_px: float | None = None
    prefilter_px: float | None = None
    max_sigma_px: float | None = None
    interpolation: str | None = None
    reference_update: str | None = None
    patch: str | None = None
    strain: object = None
    noise: NoiseRecords = NoiseRecords()
    region: RegionRecord = RegionRecord()
