"""Steps of a test: the pair's metadata, quality and rig, and the watch that takes steps."""

from __future__ import annotations

from pydantic import Field

from stereorig.drivers.acquisition.simultaneity import SKEW_SOURCES, SkewSource
from stereorig.server.base.models import Document
from stereorig.server.config.camera_metadata import LensMetadata
from stereorig.server.documents.jobs import Kept, KeptRequest
from stereorig.server.formats.calibrations.record import RecordedCamera
from stereorig.server.formats.records import Record


class BurstIndex(Document):
    """Index of a step in its burst."""

    job_id: str = Field(description="Job of the burst.")
    index: int = Field(description="Number in the burst, from 0.")
    count: int = Field(description="Steps that were asked for; 0: as many as came.")
    interval_ms: float = Field(description="Interval that was asked for; 0 in a recording.")
    since_first_ms: float = Field(description="Beginning of the exposure after the burst's first step.")
    trigger_ms: float | None = Field(None, description="In a recording: beginning of the exposure after its trigger.")
    pair: int | None = Field(None, description="In a recording: number of the pair, from 0.")


class Watched(Document):
    """The watched channel of a reading that took a step."""

    channel: str
    value: float | None = None
    last_value: float | None = None
    threshold: float | None = None


class StepMetadata(Kept):
    """A step's metadata: the client's entries, and the reason for taking it."""

    label: str | None = None
    load_n: float | None = None
    timestamp_utc: str | None = None
    channels: dict[str, float] = Field(default_factory=dict)
    channel_units: dict[str, str] = Field(default_factory=dict)
    channel_u: dict[str, float] = Field(default_factory=dict)
    request: KeptRequest | None = None
    burst: BurstIndex | None = None
    watch: Watched | None = None


class CameraQuality(Record, Document):
    """Quality of one camera's image."""

    code: str = Field(description="`ok`, `saturated`, `dark`, `blank`, `low_texture` or `blurred`.", examples=["ok"])
    mean_grey: float = Field(description="Mean grey level, counts.", examples=[118.4])
    mean_share: float | None = Field(None, description="Mean grey level over full scale.", examples=[0.464])
    saturated_share: float = Field(description="Share of pixels at full scale.", examples=[0.0])
    contrast_grey: float = Field(description="Standard deviation of the grey levels, counts.", examples=[41.0])
    texture_grey_per_px: float = Field(
        description="Median over tiles of the rms gradient, counts per pixel.", examples=[12.7]
    )
    focus: float | None = Field(
        None,
        description="Share of the gradient that remains at the scale of a pixel, noise taken out; below 0.12 "
        "blurred; null where little but noise is seen.",
        examples=[0.31],
    )
    exposure_ms: float | None = Field(None, description="Exposure as read back; null for files.", examples=[10.0])
    gain_db: float | None = Field(None, description="Gain as read back; null if there is none.", examples=[0.0])
    temperature_c: float | None = Field(
        None, description="Temperature that the camera reports, degrees Celsius; null if it reports none."
    )
    frames: dict[str, int] | None = Field(
        None,
        description="Counters of the camera's frames during the capture: delivered, dropped, incomplete ...",
        examples=[{"delivered": 1, "overrun": 0, "dropped": 0, "incomplete": 0, "duplicates": 0, "out_of_order": 0}],
    )


class StepQuality(Record, Document):
    """Quality of a pair."""

    code: str | None = Field(
        None, description="`ok`, or the first thing that is wrong; `cameras_off_zero` off their calibrated position."
    )
    skew_ms: float | None = Field(None, description="Difference of the exposures' beginnings.", examples=[0.02])
    skew_uncertainty_ms: float | None = Field(None, description="Largest error of the skew.", examples=[0.0])
    skew_source: SkewSource | None = Field(None, description=SKEW_SOURCES, examples=["clock"])
    max_skew_ms: float | None = Field(None, description="Largest skew that the rig allows, ms.", examples=[1.0])
    pairs: dict[str, int] | None = Field(
        None,
        description="Counters of the triggers during the capture: triggered = paired + unpaired + incomplete + "
        "dropped.",
        examples=[{"triggered": 1, "paired": 1, "unpaired": 0, "incomplete": 0, "dropped": 0, "refused": 0, "late": 0}],
    )
    cam1: CameraQuality | None = Field(None, description="Camera 1's image.")
    cam2: CameraQuality | None = Field(None, description="Camera 2's image.")


class CameraRecord(Record, Document):
    """A camera as the rig file describes it and as it was set.

    See :class:`stereorig.server.config.camera_metadata.CameraMetadata`.
    """

    maker: str | None = None
    model: str | None = None
    sensor: str | None = None
    pixel_um: float | None = None
    lens: LensMetadata | None = None
    exposure_ms: float | None = None
    gain_db: float | None = None


class RigRecord(Record, Document):
    """The rig that a step was captured with."""

    simulated: bool = False
    trigger: str | None = None
    frame_rate_hz: float | None = None
    max_skew_ms: float | None = None
    lighting: str | None = None
    cameras: dict[str, CameraRecord] = Field(default={})


class StepRecord(Record, StepMetadata):
    """``step.json``."""

    n: int
    test_id: str | None = None
    source: str | None = None
    captured_utc: str | None = None
    host_monotonic_ns: int | None = None
    skew_ms: float | None = None
    skew_uncertainty_ms: float | None = None
    skew_source: str | None = None
    cameras: dict[str, RecordedCamera] | None = None
    dz_mm: dict[str, float | None] | None = None
    simulated: list[str] | None = None
    rig: RigRecord | None = None
    frames: int | None = None
    grey_scale: int | float | None = None
    bit_depth: dict[str, int] | None = None
    quality: StepQuality | None = None
    image_size_px: dict[str, tuple[int, int]] = Field(default={})
    sha256: dict[str, str] = Field(default={})

    @property
    def quality_code(self) -> str | None:
        """``ok``, or the first thing that is wrong with the pair."""
        return None if self.quality is None else self.quality.code


class WatchRecord(Document):
    """Watch on a channel: ``watch.json``, with the value that the next reading is compared with."""

    active: bool = Field(description="True if readings take steps.")
    channel: str = Field(description="The channel.")
    threshold: float = Field(description="Difference that makes a step.")
    frames: int = Field(description="Frames averaged in each step.")
    label: str = Field(description="Label of steps whose reading brings none.")
    since_utc: str = Field(description="Time at which the watch began.")
    last_value: float | None = Field(None, description="Value that the next reading is compared with; null: none yet.")
    last_step: int | None = Field(None, description="Step that it is from.")
