"""What became of the cameras' frames and what they were set to, as they travel; see :mod:`server.rig.description`."""

from __future__ import annotations

from pydantic import Field

from core.names import CameraName
from drivers.acquisition.pairing import PairingAccount
from drivers.cameras.protocol import FrameCounters
from server.base.models import Reply, Reported
from server.rig.description import CameraReply, CameraSettingsReply, StageMessage


class CamerasReply(Reply):
    """Both cameras."""

    cameras: list[CameraReply] = Field(description="cam1, then cam2.")


class CameraSet(Reply):
    """What a camera took."""

    name: CameraName = Field(description="Which camera.")
    settings: CameraSettingsReply = Field(description="Every setting, as read back.")


class FrameCounts(Reported, FrameCounters):
    """What became of a camera's frames since it was opened."""


class PairCounts(Reported, PairingAccount):
    """What became of the triggers: triggered = paired + unpaired + incomplete + dropped."""


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


class StageMessages(Reply):
    """Messages of the controller, oldest first."""

    messages: list[StageMessage] = Field(description="The last 200 at most.")
