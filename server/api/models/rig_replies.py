"""What the rig, its cameras and its stage answer."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field

from core.names import CameraName
from drivers.stages.protocol import AxisState
from server.api.models.jobs import JobProblem
from server.api.models.rig import DynamicsReply
from server.base.models import Reply
from server.config.rig_file import CalibrationSection, CameraSection, TargetSection

Range = tuple[float, float]


class NominalCamera(CameraSection):
    """What the rig file says of a camera."""

    model_config = ConfigDict(extra="allow")


class NominalTarget(TargetSection):
    """What the rig file says of the target."""

    model_config = ConfigDict(extra="allow")


class UsualPlan(CalibrationSection):
    """The rig file's plan of a calibration."""

    model_config = ConfigDict(extra="allow")


class CameraDevice(Reply):
    """Who a camera is and what it can do, as it says itself; ranges are null where it has no such setting."""

    model: str = Field(description="Model.", examples=["simulated camera"])
    serial: str = Field(description="Serial number.")
    image_size_px: tuple[int, int] = Field(description="Width and height of its images.")
    bit_depths: list[int] = Field(description="Significant bits per pixel that it can deliver.")
    trigger_modes: list[Literal["free", "software", "hardware"]] = Field(description="What may start an exposure.")
    exposure_range_ms: Range | None = Field(description="Shortest and longest exposure.")
    gain_range_db: Range | None = Field(description="Least and greatest gain.")
    frame_rate_range_hz: Range | None = Field(description="Lowest and highest rate of a free run.")
    driver: str = Field(description="Driver that reaches it.", examples=["aravis"])
    firmware: str = Field(description="Firmware; empty where it does not tell.")
    latency_s: float = Field(description="What a frame may take beyond its period before it arrives.")
    clock: str = Field(description="Clock of its times; two cameras' may be compared where both name the same one.")
    counter_range: tuple[int, int] = Field(description="First and last frame number before it begins again.")
    pixel_formats: list[str] = Field(description="Pixel formats, by the device's own names.")
    feature_names: list[str] = Field(description="What `features` of the settings may name.")
    extra: dict[str, str] = Field(description="What else the driver knows, as text.")


class CameraSettingsReply(Reply):
    """Settings as read back from a camera; null where it has no such setting."""

    exposure_ms: float | None = Field(description="Exposure time.")
    gain_db: float | None = Field(description="Gain.")
    frame_rate_hz: float | None = Field(description="Rate of a free run.")
    bit_depth: int | None = Field(description="Significant bits per pixel.")
    trigger: Literal["free", "software", "hardware"] | None = Field(description="What starts an exposure.")
    region_px: tuple[int, int, int, int] | None = Field(description="x0, y0, width, height on the sensor.")
    pixel_format: str | None = Field(description="The device's own name of the pixel format.")
    features: dict[str, bool | int | float | str] | None = Field(
        description="Other settings that were given, by the device's own name."
    )


class CameraReply(Reply):
    """One camera of the rig."""

    name: CameraName = Field(description="Which camera.")
    nominal: NominalCamera = Field(description="What the rig file says.")
    device: CameraDevice | None = Field(description="What the device says; null while it is not connected.")
    settings: CameraSettingsReply | None = Field(description="Its settings as read back; null while not connected.")
    fault: JobProblem | None = Field(None, description="Why it cannot be used now; null: it can.")
    reconnections: int = Field(0, description="How often it was lost and connected again.")


class CamerasReply(Reply):
    """Both cameras."""

    cameras: list[CameraReply] = Field(description="cam1, then cam2.")


class CameraSet(Reply):
    """What a camera took."""

    name: CameraName = Field(description="Which camera.")
    settings: CameraSettingsReply = Field(description="Every setting, as read back.")


class FrameCounts(Reply):
    """What became of a camera's frames since it was opened."""

    delivered: int = Field(description="Frames that came whole.")
    overrun: int = Field(description="Thrown away because nobody took them in time.")
    dropped: int = Field(description="Never arrived, by their numbers.")
    incomplete: int = Field(description="Arrived with lines or packets missing; never used.")
    duplicates: int = Field(description="Delivered twice.")
    out_of_order: int = Field(description="Arrived after a later one.")


class PairCounts(Reply):
    """What became of the triggers: triggered = paired + unpaired + incomplete + dropped."""

    triggered: int = Field(description="Occasions on which a pair was due.")
    paired: int = Field(description="Both frames came.")
    unpaired: int = Field(description="One frame came.")
    incomplete: int = Field(description="A frame had lines or packets missing.")
    dropped: int = Field(description="No frame came.")
    refused: int = Field(description="Of the paired, those whose skew was too large.")
    late: int = Field(description="Frames that came after their occasion was given up.")


class FrameQuality(Reply):
    """What one image is worth."""

    code: str = Field(description="`ok`, `saturated`, `dark`, `blank`, `low_texture` or `blurred`.", examples=["ok"])
    mean_grey: float = Field(description="Mean grey level, counts.")
    mean_share: float = Field(description="Mean grey level over full scale.")
    saturated_share: float = Field(description="Share of pixels at full scale.")
    contrast_grey: float = Field(description="Standard deviation of the grey levels, counts.")
    texture_grey_per_px: float = Field(description="Median over tiles of the rms gradient, counts per pixel.")
    focus: float = Field(description="How much of the gradient survives at the scale of a pixel; below 0.12 blurred.")


class CameraStats(Reply):
    """What became of a camera's frames, and the newest one's quality."""

    name: CameraName = Field(description="Which camera.")
    frames: FrameCounts = Field(description="Its frames since it was opened.")
    driver: dict[str, int | float] = Field(description="The driver's own counts, by its own names.")
    pairs: PairCounts = Field(description="Both cameras' triggers.")
    sequence: int = Field(description="Number of the newest frame.")
    quality: FrameQuality = Field(description="The newest frame.")
    histogram: list[int] = Field(description="Pixels at each of 256 grey levels, the upper 8 bits of deeper images.")


class AxisLimitsReply(Reply):
    """Where an axis may go."""

    low_mm: float = Field(description="Lowest position, the tighter of the controller's and the rig file's.")
    high_mm: float = Field(description="Highest position.")
    controller_low_mm: float = Field(description="The controller's own lowest position.")
    controller_high_mm: float = Field(description="The controller's own highest position.")


class AxisReply(Reply):
    """One axis, as read from the controller."""

    axis: int = Field(description="Axis number.")
    state: AxisState = Field(description="What it is doing or lacks.", examples=["ready"])
    position_mm: float = Field(description="Where it stands.")
    motor_on: bool = Field(description="Whether its motor has power.")
    homed: bool = Field(description="Whether its position is known.")
    moving: bool = Field(description="Whether it moves.")
    detail: str = Field(description="What the controller says beside the state.")
    limits: AxisLimitsReply = Field(description="Where it may go.")
    dynamics: DynamicsReply = Field(description="How fast it moves.")
    zero_mm: float = Field(description="Position of dZ = 0.")
    cameras: list[CameraName] = Field(description="Cameras that it moves.")


class AxisIdentityReply(Reply):
    """What stands on an axis."""

    axis: int = Field(description="Axis number.")
    model: str = Field(description="Model of the actuator.")
    serial: str = Field(description="Serial number; empty where it does not tell.")
    units: str = Field(description="Unit of the controller's own numbers.")


class StageIdentityReply(Reply):
    """Who the motion controller is."""

    driver: str = Field(description="Protocol.", examples=["esp301"])
    model: str = Field(description="Model.")
    firmware: str = Field(description="Firmware.")
    url: str = Field(description="Port or address that it is reached at.")
    axes: list[AxisIdentityReply] = Field(description="What stands on each axis.")


class StageReply(Reply):
    """The stage."""

    driver: str = Field(description="Protocol of the controller.", examples=["esp301"])
    identity: StageIdentityReply | None = Field(description="Who the controller is; null while it does not answer.")
    axes: list[AxisReply] = Field(description="Every axis; empty while the controller does not answer.")
    zero_mm: float = Field(description="Position of dZ = 0 of axes that have none of their own.")
    fault: JobProblem | None = Field(description="Why it cannot be used; null: it can.")


class SceneReply(Reply):
    """What stands before a simulated rig's cameras; parameters of the scene stand beside these two."""

    scene: str = Field(description="Name of the scene.", examples=["plate"])
    load: float = Field(description="kPa for `plate`, kN for `panel`, per cent for `strip`, a share for `block`.")


class Holder(Reply):
    """What holds the hardware, so that nothing else can use it."""

    what: str = Field(description="In words.", examples=["a calibration"])
    job_id: str | None = Field(None, description="Its job, where it is one.")
    since_s: float = Field(description="For how long, seconds.")


class RigReply(Reply):
    """Everything that a client wants to know before it does anything."""

    name: str = Field(description="Name of the rig.")
    description: str = Field(description="Free text of the rig file.")
    sim: bool = Field(description="Whether it is a simulated rig.")
    connected: bool = Field(description="Whether cameras and stage are open.")
    fault: JobProblem | None = Field(description="Why the rig cannot be used; null: it can.")
    holder: Holder | None = Field(description="What holds the hardware now; null: nothing.")
    scene: SceneReply | None = Field(description="What a simulated rig sees; null on a real one.")
    trigger: Literal["free", "software", "hardware"] = Field(description="What starts the exposures.")
    max_skew_ms: float = Field(description="A pair whose exposures began further apart is refused.")
    target: NominalTarget = Field(description="The grid.")
    calibration_plan: UsualPlan = Field(description="The usual plan of a calibration.")
    cameras: dict[CameraName, CameraReply] = Field(description="Both cameras, by name.")
    stage: StageReply = Field(description="The stage.")
