"""Descriptions of the rig, its cameras and its stage: the API's replies, and the parts that records keep of them.

A device's own fields are declared by its driver's classes (`stereorig.drivers.cameras.protocol`,
`stereorig.drivers.stages.protocol`).
"""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from typing import Literal

from pydantic import ConfigDict, Field

from stereorig.core.names import CameraName
from stereorig.drivers.cameras.protocol import CameraDescription, CameraIdentity, CameraSettings
from stereorig.drivers.stages.controllers import ControllerStatus, DeviceState
from stereorig.drivers.stages.protocol import (
    AxisDynamics,
    AxisIdentity,
    AxisLimits,
    AxisStatus,
    ControllerMessage,
    StageIdentity,
)
from stereorig.server.base.models import Document, Reply, Reported
from stereorig.server.base.problem import JobProblem, problem_of
from stereorig.server.config.camera_metadata import CameraMetadata
from stereorig.server.config.rig_file import CalibrationSection, CameraSection, TargetSection
from stereorig.server.jobs.hardware import Holder

# the rig file ------------------------------------------------------------------------------------------------------


class NominalCamera(CameraSection):
    """Nominal values of a camera from the rig file."""

    model_config = ConfigDict(extra="allow")


class NominalTarget(TargetSection):
    """The target as the rig file describes it."""

    model_config = ConfigDict(extra="allow")


class UsualPlan(CalibrationSection):
    """The rig file's plan of a calibration."""

    model_config = ConfigDict(extra="allow")


# cameras -----------------------------------------------------------------------------------------------------------


class CameraDevice(Reported, CameraDescription):
    """Identity and capabilities of a camera, as it reports them; ranges are null if it has no such setting."""


class CameraSettingsReply(Reported, CameraSettings):
    """Settings as read back from a camera; null if it has no such setting."""


class CameraReply(Reply):
    """One camera of the rig."""

    name: CameraName = Field(description="Which camera.")
    nominal: NominalCamera = Field(description="Nominal values from the rig file.")
    device: CameraDevice | None = Field(
        description="Properties that the device reports; null while it is not connected."
    )
    settings: CameraSettingsReply | None = Field(description="Its settings as read back; null while not connected.")
    fault: JobProblem | None = Field(None, description="Fault that keeps it from being used; null: none.")
    state: DeviceState | None = Field(
        None,
        description="`looked_for`: it was not found yet; `lost`: it was, and is looked for again; null while the rig "
        "is not open.",
    )
    since_utc: str | None = Field(None, description="Beginning of this state.")
    reconnections: int = Field(0, description="Number of times that it was lost and connected again.")


# stage -------------------------------------------------------------------------------------------------------------


class AxisLimitsReply(Reported, AxisLimits):
    """Travel limits of an axis."""


class DynamicsReply(Reply, AxisDynamics):
    """Velocity and acceleration of an axis, as read back from the controller."""


class AxisReply(Reported, AxisStatus):
    """One axis, as read from the controller."""

    limits: AxisLimitsReply = Field(description="Travel limits.")
    dynamics: DynamicsReply = Field(description="Velocity and acceleration.")
    zero_mm: float = Field(description="Position of dZ = 0.")
    cameras: list[CameraName] = Field(description="Cameras that it moves.")


class AxisIdentityReply(Reported, AxisIdentity):
    """Identity of an axis' controller."""


class StageIdentityReply(Reported, StageIdentity):
    """Identity of the motion controller."""

    axes: tuple[AxisIdentityReply, ...] = Field(description="The controller of each axis.")


class ControllerReply(Reply):
    """Connection of one motion controller."""

    driver: str = Field(description="Protocol.", examples=["conex-cc"])
    url: str = Field(description="Port or address that it is reached at; `sim`: it is simulated.")
    axes: list[int] = Field(description="Axes that it moves.")
    state: DeviceState = Field(
        description="`looked_for`: it was not found yet; `lost`: it was, and is looked for again."
    )
    since_utc: str = Field(description="Beginning of this state.")
    fault: JobProblem | None = Field(description="Reason why it cannot be used; null: none.")


class StageReply(Reply):
    """The stage."""

    driver: str | None = Field(description="Protocol of the controller; null without a stage.", examples=["esp301"])
    identity: StageIdentityReply | None = Field(
        description="Identity of the controller; null while it does not answer."
    )
    axes: list[AxisReply] = Field(description="Every axis whose controller answers.")
    controllers: list[ControllerReply] = Field(
        description="Connection of each controller; empty without a stage, and while the rig is not open."
    )
    zero_mm: float = Field(description="Position of dZ = 0 of axes that have none of their own.")
    fault: JobProblem | None = Field(description="Fault that keeps it from being used; null: none.")


class StageMessage(Reply, ControllerMessage):
    """Something that the controller had to say."""

    id: int = Field(description="Grows by one with each message.")
    utc: str = Field(description="Time at which it was read.")


# the rig -----------------------------------------------------------------------------------------------------------


class SceneReply(Reply):
    """The scene before a simulated rig's cameras, with its parameters."""

    scene: str = Field(description="Name of the scene.", examples=["plate"])
    load: float = Field(description="kPa for `plate`, kN for `panel`, per cent for `strip`, a share for `block`.")


class RigReply(Reply):
    """State of the rig, its target, cameras and stage."""

    name: str = Field(description="Name of the rig.")
    description: str = Field(description="Free text of the rig file.")
    sim: bool = Field(description="True if it is a simulated rig.")
    simulated: list[Literal["cam1", "cam2", "stage"]] = Field(description="Its simulated devices.")
    connected: bool = Field(description="True if cameras and stage were found; one that was lost since has a fault.")
    fault: JobProblem | None = Field(description="Fault that keeps the rig from being used; null: none.")
    holder: Holder | None = Field(description="Holder of the hardware; null: it is free.")
    scene: SceneReply | None = Field(description="Scene of a simulated rig; null on a real one.")
    trigger: Literal["free", "software", "hardware", "action"] = Field(description="Source that starts the exposures.")
    max_skew_ms: float = Field(description="A pair whose exposures began at a larger distance is refused.")
    target: NominalTarget = Field(description="The grid.")
    calibration_plan: UsualPlan = Field(description="The usual plan of a calibration.")
    cameras: dict[CameraName, CameraReply] = Field(description="Both cameras, by name.")
    stage: StageReply = Field(description="The stage.")


# records -----------------------------------------------------------------------------------------------------------

#: settings that a step's record keeps
_KEPT_SETTINGS = ("exposure_ms", "gain_db", "frame_rate_hz", "pixel_format")


class CameraKept(CameraMetadata, CameraSettings):
    """A camera as a step's record keeps it: how it was set, and its metadata."""


class RigKept(Document):
    """Record of the rig that took a step, for a report: its operation, and each camera's settings and lens."""

    name: str
    simulated: bool
    trigger: str
    frame_rate_hz: float | None
    max_skew_ms: float
    lighting: str | None
    cameras: dict[CameraName, CameraKept]


def controller_reply(status: ControllerStatus) -> ControllerReply:
    """Return the reply of a controller's connection."""
    return ControllerReply(
        driver=status.driver,
        url=status.url,
        axes=list(status.axes),
        state=status.state,
        since_utc=utc_of(status.since_s),
        fault=None if status.fault is None else problem_of(status.fault),
    )


def utc_of(unix_s: float) -> str:
    """Return a time as the API shows times."""
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def identity_of(description: CameraDescription) -> dict[str, str]:
    """Return a camera's identity, for the records of its images."""
    return {name: getattr(description, name) for name in CameraIdentity.__dataclass_fields__}


def kept_camera(settings: CameraSettings, metadata: CameraMetadata) -> CameraKept:
    """Return the part of a camera's settings and metadata that a step's record keeps; without facts not stated."""
    has = asdict(settings)
    stated = metadata.model_dump(mode="json", exclude_none=True)
    return CameraKept.model_validate({**{name: has[name] for name in _KEPT_SETTINGS}, **stated})
