"""Bodies about cameras, stage and scene; :mod:`stereorig.server.rig.description` has the devices' own descriptions."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, field_validator, model_validator

from stereorig.core.names import CameraName
from stereorig.core.settings import Real, Whole
from stereorig.drivers.acquisition.pairing import PairingAccount
from stereorig.drivers.cameras.protocol import FrameCounters
from stereorig.server.base.models import AxisValues, Number, Reply, Reported, Request, any_of, one_of
from stereorig.server.rig.description import CameraReply, CameraSettingsReply, StageMessage
from stereorig.server.workflows.exposure import LEVEL, LEVEL_HIGH, LEVEL_LOW


class SettingsPatch(Request):
    """Camera settings to change; settings left out keep their values."""

    exposure_ms: Annotated[Real, Field(gt=0.0, le=60000.0)] | None = Field(None, description="Exposure time.")
    gain_db: Annotated[Real, Field(ge=-100.0, le=100.0)] | None = Field(None, description="Gain.")
    frame_rate_hz: Annotated[Real, Field(gt=0.0, le=10000.0)] | None = Field(None, description="Free-run rate.")
    bit_depth: Annotated[Whole, Field(ge=8, le=16)] | None = Field(None, description="Significant bits per pixel.")
    features: dict[Annotated[str, Field(min_length=1, max_length=200)], bool | int | float | str] | None = Field(
        None,
        description="Other settings by the device's own name (GenICam feature, V4L2 control), set in this order.",
        max_length=100,
        examples=[{"BlackLevel": 4.0}],
    )


class ExposureRequest(Request):
    """Search for a camera's exposure."""

    level: Annotated[Real, Field(ge=LEVEL_LOW, le=LEVEL_HIGH)] = Field(
        LEVEL,
        description="Level of the brightest parts of the picture, over full scale; the brightest thousandth of its "
        "pixels is left out.",
    )
    shortest_ms: Annotated[Real, Field(gt=0.0, le=60000.0)] | None = Field(
        None, description="Shortest exposure that may be set; the camera's own if left out."
    )
    longest_ms: Annotated[Real, Field(gt=0.0, le=60000.0)] | None = Field(
        None,
        description="Longest exposure that may be set; the camera's own, and nine tenths of the period of a "
        "free-running camera, if left out.",
    )


class ExposureFound(Reply):
    """An exposure that was searched for and set."""

    name: CameraName = Field(description="Name of the camera.")
    settings: CameraSettingsReply = Field(description="Every setting, as read back.")
    level: float = Field(description="Level of the brightest parts of the picture with it, over full scale.")
    saturated_share: float = Field(description="Share of pixels at full scale with it.")
    pictures: int = Field(description="Number of pictures that the search took.")


class MoveRequest(Request):
    """Targets of a move: axes by number, or cameras by their travel dZ."""

    model_config = ConfigDict(json_schema_extra=one_of("positions_mm", "by_mm", "dz_mm"))

    positions_mm: AxisValues | None = Field(
        None, description="Absolute position of each axis.", examples=[{"1": 5.0, "2": 5.0}]
    )
    by_mm: AxisValues | None = Field(None, description="Travel of each axis from its position.")
    dz_mm: dict[CameraName, Number] | None = Field(
        None, description="Travel of each camera from its zero, positive away from the target.", min_length=1
    )

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if sum(v is not None for v in (self.positions_mm, self.by_mm, self.dz_mm)) != 1:
            raise ValueError("give exactly one of positions_mm, by_mm and dz_mm")
        return self


class HomeRequest(Request):
    """Axes to home."""

    axes: list[Annotated[Whole, Field(ge=1, le=31)]] | None = Field(
        None, description="Axis numbers; all that the cameras use if left out.", min_length=1, max_length=6
    )


class AxesRequest(Request):
    """Axes of the request."""

    axes: list[Annotated[Whole, Field(ge=1, le=31)]] | None = Field(
        None, description="Axis numbers; all that the cameras use if left out.", min_length=1, max_length=6
    )


class DynamicsPatch(Request):
    """Velocity and acceleration of an axis; a value left out is kept."""

    model_config = ConfigDict(json_schema_extra=any_of("velocity_mm_s", "acceleration_mm_s2"))

    velocity_mm_s: Annotated[Real, Field(gt=0.0, le=1e6, allow_inf_nan=False)] | None = Field(
        None, description="Velocity of moves."
    )
    acceleration_mm_s2: Annotated[Real, Field(gt=0.0, le=1e9, allow_inf_nan=False)] | None = Field(
        None, description="Acceleration and deceleration of moves."
    )

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.velocity_mm_s is None and self.acceleration_mm_s2 is None:
            raise ValueError("give velocity_mm_s, acceleration_mm_s2 or both")
        return self


class FlashConsent(Request):
    """Consent to a change that cannot be undone."""

    write_flash: Literal[True] = Field(
        description="Must be true: leaving writes the controller's flash memory, which endures about a hundred writes."
    )

    @field_validator("write_flash", mode="before")
    @classmethod
    def _only_true(cls, value: Any) -> Any:
        if value is not True:
            raise ValueError("must be true")
        return value


class StopReply(Reply):
    """The stage was commanded to stop."""

    stopped: bool = Field(description="True once the stop command is on the wire.")
    elapsed_ms: float = Field(
        description="From the request's arrival to the command on the wire; of an abort, to the motors off."
    )
    cancelled_job: str | None = Field(None, description="The hardware job that was cancelled with it.")


class SceneRequest(Request):
    """The scene before a simulated rig's cameras."""

    scene: Literal[
        "grid",
        "steel",
        "plate",
        "panel",
        "block",
        "strip",
        "sphere",
        "line_grid",
        "checkerboard",
        "charuco",
        "circles",
        "circles_asymmetric",
    ] = Field(description="Name of the scene; `grid` is the rig's own target, the last five are targets of that kind.")
    load: Number = Field(
        0.0, description="kPa for `plate`, kN for `panel`, per cent for `strip`, share of the motion for `block`."
    )
    params: dict[str, Number | list[Number] | Annotated[str, Field(max_length=100)]] = Field(
        default_factory=dict,
        description="Further parameters of the scene. Targets: `pose` [rx, ry, rz in degrees, x, y, z in mm], a "
        "rotation vector and a place in the system frame, or `hand`, the number of a hand's pose; `bow_mm`, `size` and "
        "others. Any scene: `bump_cam1`, `bump_cam2`, six such numbers that knock a camera from now on.",
        max_length=20,
    )


class CamerasReply(Reply):
    """Both cameras."""

    cameras: list[CameraReply] = Field(description="cam1, then cam2.")


class CameraSet(Reply):
    """Settings that a camera accepted."""

    name: CameraName = Field(description="Name of the camera.")
    settings: CameraSettingsReply = Field(description="Every setting, as read back.")


class FrameCounts(Reported, FrameCounters):
    """Counters of a camera's frames since it was opened."""


class PairCounts(Reported, PairingAccount):
    """Counters of the triggers: triggered = paired + unpaired + incomplete + dropped."""


class FrameQuality(Reply):
    """Quality of one image."""

    code: str = Field(description="`ok`, `saturated`, `dark`, `blank`, `low_texture` or `blurred`.", examples=["ok"])
    mean_grey: float = Field(description="Mean grey level, counts.")
    mean_share: float = Field(description="Mean grey level over full scale.")
    saturated_share: float = Field(description="Share of pixels at full scale.")
    contrast_grey: float = Field(description="Standard deviation of the grey levels, counts.")
    texture_grey_per_px: float = Field(description="Median over tiles of the rms gradient, counts per pixel.")
    focus: float | None = Field(
        None,
        description="Share of the gradient that remains at the scale of a pixel, noise taken out; below 0.12 "
        "blurred; null where little but noise is seen.",
    )


class CameraStats(Reply):
    """Counters of a camera's frames, and the quality of the newest frame."""

    name: CameraName = Field(description="Name of the camera.")
    frames: FrameCounts = Field(description="Its frames since it was opened.")
    driver: dict[str, int | float] = Field(description="The driver's own counts, by its own names.")
    pairs: PairCounts = Field(description="Both cameras' triggers.")
    sequence: int = Field(description="Number of the newest frame.")
    quality: FrameQuality = Field(description="The newest frame.")
    histogram: list[int] = Field(description="Pixels at each of 256 grey levels, the upper 8 bits of deeper images.")


class LiveCheckReply(Reply):
    """The accepted calibration, held against the live pair."""

    calibration_id: str = Field(description="The newest accepted calibration.")
    level: Literal["ok", "warning", "failed", "no_texture", "off_zero", "busy"] = Field(
        description="`ok`, `warning` or `failed` as of a measured field (`epipolar_check`). Not checked: `no_texture`, "
        "`off_zero` (a stage is off the calibrated place) and `busy` (a job runs)."
    )
    offset_px: float | None = Field(description="Distance of points from their epipolar lines; null: not checked.")
    own_px: float | None = Field(description="The calibration's own offset at most; null: not known.")
    points: int = Field(description="Points that were matched; 0 if the offset is from features, or not checked.")
    text: str = Field(description="The finding in a sentence.")
    checked_utc: str = Field(description="Time of the check.")


class StageMessages(Reply):
    """Messages of the controller, oldest first."""

    messages: list[StageMessage] = Field(description="The last 100 at most.")
