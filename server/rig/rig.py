"""The rig as the service uses it: captures, moves, settings, state.

Everything that makes the hardware do something runs on its one owner thread (:class:`HardwareGate`);
reading the stage's state and stopping it do not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from core.errors import CameraError, DeviceError, InputError, StageError, StateError, StereorigError
from core.names import CAMERAS, CameraName
from drivers.cameras.protocol import CameraSettings
from drivers.stages.protocol import MoveResult, Stage
from server.base.problem import JobProblem, problem_of
from server.config.rig_file import RigConfig
from server.jobs.hardware import HardwareHold
from server.rig.build import Devices, first_settings, open_devices
from server.rig.cameras import CameraPair
from server.rig.description import (
    AxisReply,
    CameraDevice,
    CameraReply,
    CameraSettingsReply,
    NominalCamera,
    NominalTarget,
    RigKept,
    RigReply,
    SceneReply,
    StageIdentityReply,
    StageReply,
    UsualPlan,
    identity_of,
    kept_camera,
)
from server.rig.reconnect import ReconnectWatch
from server.rig.shared import SharedReading
from server.rig.stage_controls import StageControls

_log = logging.getLogger("stereorig.rig")


def _no_announcement(_name: str, _data: Mapping[str, object]) -> None:
    """Stand in for an event hub."""


class Rig:
    """Two cameras and their stage.

    Parameters
    ----------
    config
        The rig file.
    hardware
        Hold and owner thread, shared with the jobs.
    announce
        Called with ``camera`` and what happened when a camera is lost or comes back.
    record
        File that gets a transcript of the stage's wire.
    """

    def __init__(
        self,
        config: RigConfig,
        hardware: HardwareHold,
        announce: Callable[[str, Mapping[str, object]], None] | None = None,
        *,
        record: Path | None = None,
    ) -> None:
        self.config = config
        self._record = record
        self.hardware = hardware
        self._announce = announce if announce is not None else _no_announcement
        self._devices: Devices | None = None
        self._fault: JobProblem | None = JobProblem(
            code="not_connected", cause="The rig was not opened yet.", remedy="Wait until it is open."
        )
        # what the cameras were last set to, so that a reconnected one gets it again
        self._settings = {cam: first_settings(config, cam) for cam in CAMERAS}
        self.scene: SceneReply | None = None
        self._knocks: dict[str, object] = {}
        self._watch: ReconnectWatch | None = None
        self._stage_reading = SharedReading(self._read_stage)
        self.controls = StageControls(lambda: self._ready().stage)

    # opening and closing ----------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open cameras and stage; a fault is kept and shown, and :meth:`reconnect` tries again."""
        try:
            self._devices = open_devices(
                self.config, self._settings, record=self._record, dynamics=self.controls.dynamics, on_lost=self._lost
            )
            self._fault = None
            self.controls.collect(self._devices.stage)
            if self.config.rig.auto_reconnect:
                self._watch = ReconnectWatch(self._devices.pair, self._came_back)
                self._watch.start()
            if self._devices.world is not None and self.scene is None:
                self.scene = SceneReply(scene="grid", load=0.0)
            if self.config.home_at_start:
                self._home_at_start()
        except StereorigError as error:
            _log.exception("the rig could not be opened")
            self._fault = problem_of(error)
            self._close_devices()

    def _home_at_start(self) -> None:
        # an axis in configuration state is shown as such, and can only be helped with the rig open
        stuck = self.controls.in_configuration(self.config.axes)
        try:
            self.home(tuple(axis for axis in self.config.axes if axis not in stuck))
        except StageError as error:
            if error.code != "stage_stopped":
                raise
            # an operator may want it at rest while the cameras go on
            _log.warning("homing was stopped; the rig is open, and its axes are to be homed before they move")

    def close(self) -> None:
        """Stop the stage first, then release everything."""
        self._close_devices()

    def reconnect(self) -> None:
        """Close, open again, push the settings."""
        self._close_devices()
        self.open()
        if self._fault is not None:
            raise DeviceError(self._fault.cause, code=self._fault.code, remedy=self._fault.remedy)
        if self.scene is not None:
            self.set_scene(self.scene.scene, load=self.scene.load, params=self._knocks | (self.scene.model_extra or {}))

    def _lost(self, cam: CameraName, error: CameraError) -> None:
        _log.warning("%s was lost: %s", cam, error)
        self._announce("camera", {"camera": cam, "state": "lost", "problem": problem_of(error).plain()})

    def _came_back(self, cam: CameraName) -> None:
        _log.warning("%s is connected again", cam)
        self._announce("camera", {"camera": cam, "state": "connected"})

    def _close_devices(self) -> None:
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.stop()
        devices, self._devices = self._devices, None
        if devices is not None:
            self.controls.collect(devices.stage, ask=False)
            devices.close()

    @property
    def fault(self) -> JobProblem | None:
        """Fault that keeps the rig from being used, or None."""
        return self._fault

    def _ready(self) -> Devices:
        devices = self._devices
        if devices is None:
            cause = self._fault.cause if self._fault else "The rig is closed."
            raise DeviceError(
                f"The rig is not connected: {cause}",
                code="not_connected",
                remedy="Put the fault right, then POST /rig:reconnect.",
            )
        return devices

    @property
    def pair(self) -> CameraPair:
        """Both cameras."""
        return self._ready().pair

    # description ------------------------------------------------------------------------------------------------

    def describe(self) -> RigReply:
        """Return the state of the rig, its target, cameras and stage."""
        config = self.config
        return RigReply(
            name=config.rig.name,
            description=config.rig.description,
            sim=config.rig.kind == "simulated",
            connected=self._devices is not None,
            fault=self._fault,
            holder=self.hardware.holder,
            scene=self.scene,
            trigger=config.rig.trigger,
            max_skew_ms=config.rig.skew_bound_ms,
            target=NominalTarget.model_validate(config.target.plain()),
            calibration_plan=UsualPlan.model_validate(config.calibration.model_dump(mode="json")),
            cameras={cam: self.describe_camera(cam) for cam in CAMERAS},
            stage=self._describe_stage_or_fault(),
        )

    def describe_camera(self, cam: CameraName) -> CameraReply:
        """Nominal data, the device's own description, and the settings it has."""
        nominal = NominalCamera.model_validate(self.config.camera(cam).model_dump(mode="json"))
        devices = self._devices
        if devices is None:
            return CameraReply(name=cam, nominal=nominal, device=None, settings=None)
        unit = devices.pair.units[cam]
        return CameraReply(
            name=cam,
            nominal=nominal,
            device=CameraDevice.model_validate(asdict(unit.description)),
            settings=CameraSettingsReply.model_validate(asdict(unit.settings)),
            fault=None if unit.fault is None else problem_of(unit.fault),
            reconnections=unit.reconnections,
        )

    def identities(self) -> dict[str, dict[str, str]]:
        """Identity of each camera, for the records of their images."""
        return {cam: identity_of(self.pair.units[cam].description) for cam in CAMERAS}

    def record(self) -> RigKept:
        """Record of the rig that took a step, for a report."""
        section, units = self.config.rig, self.pair.units
        return RigKept(
            name=section.name,
            simulated=section.kind == "simulated",
            trigger=section.trigger,
            frame_rate_hz=section.frame_rate_hz,
            max_skew_ms=section.skew_bound_ms,
            lighting=section.lighting,
            cameras={cam: kept_camera(units[cam].settings, self.config.camera(cam).metadata()) for cam in CAMERAS},
        )

    def _describe_stage_or_fault(self) -> StageReply:
        # a silent stage must not hide the cameras
        try:
            return self.describe_stage()
        except StageError as error:
            return self._no_stage(problem_of(error))

    def _no_stage(self, fault: JobProblem | None) -> StageReply:
        section = self.config.stage
        return StageReply(driver=section.driver, identity=None, axes=[], zero_mm=section.zero_mm, fault=fault)

    def describe_stage(self) -> StageReply:
        """Identity, limits and state of each axis; who asks while others do shares their reading."""
        return self._stage_reading()

    def _read_stage(self) -> StageReply:
        section, devices = self.config.stage, self._devices
        if devices is None:
            return self._no_stage(self._fault)
        return StageReply(
            driver=section.driver,
            identity=StageIdentityReply.model_validate(asdict(devices.stage.identify())),
            axes=[self._read_axis(devices.stage, axis) for axis in devices.stage.axes],
            zero_mm=section.zero_mm,
            fault=None,
        )

    def _read_axis(self, stage: Stage, axis: int) -> AxisReply:
        return AxisReply.model_validate(
            {
                **asdict(stage.state(axis)),
                "limits": asdict(stage.limits(axis)),
                "dynamics": asdict(stage.dynamics(axis)),
                "zero_mm": self.config.stage.of_axis(axis).zero_mm,
                "cameras": [cam for cam in CAMERAS if self.config.camera(cam).stage_axis == axis],
            }
        )

    # cameras ----------------------------------------------------------------------------------------------------

    def configure(self, cam: CameraName, settings: CameraSettings) -> CameraSettings:
        """Change settings on the owner thread; returns what the device really took."""
        pair = self.pair
        taken = self.hardware.call(lambda: pair.configure(cam, settings))
        self._settings[cam] = pair.units[cam].wanted
        return taken

    def set_scene(self, name: str, *, load: float = 0.0, params: Mapping[str, object] | None = None) -> SceneReply:
        """Put something else before a simulated rig's cameras."""
        world = self._ready().world
        if world is None:
            raise StateError(
                "This rig has real cameras: there is no scene to set.",
                code="not_simulated",
                remedy="Start the service with a simulated rig's file.",
            )
        more = dict(params or {})
        try:
            world.set_scene(name, load=load, **more)
        except (TypeError, ValueError) as error:
            raise InputError(f"Scene {name!r}: {error}.", code="scene_invalid") from error
        # a knocked camera is not put right by what comes before it next
        self._knocks |= {key: value for key, value in more.items() if key.startswith("bump_")}
        self.scene = SceneReply.model_validate({"scene": name, "load": load, **more})
        return self.scene

    # stage ------------------------------------------------------------------------------------------------------

    def targets_for_dz(self, dz_mm: dict[CameraName, float]) -> dict[int, float]:
        """Return axis positions that bring each camera to its dZ.

        Raises
        ------
        InputError
            ``axis_conflict`` if one axis moves both cameras and different positions are asked for.
        """
        targets: dict[int, float] = {}
        for cam, dz in dz_mm.items():
            section = self.config.camera(cam)
            position = self.config.stage.of_axis(section.stage_axis).zero_mm + section.stage_sign * dz
            if abs(targets.setdefault(section.stage_axis, position) - position) > 1e-9:
                raise InputError(
                    f"Axis {section.stage_axis} moves both cameras, and they are sent to different positions.",
                    code="axis_conflict",
                    remedy="Ask for the same dZ for both.",
                )
        return targets

    def dz_of(self, cam: CameraName, position_mm: float) -> float:
        """Travel of a camera along its optical axis at a position that was read back."""
        section = self.config.camera(cam)
        return section.stage_sign * (position_mm - self.config.stage.of_axis(section.stage_axis).zero_mm)

    def check_axes(self, axes: tuple[int, ...]) -> None:
        """Refuse axes that the rig does not have."""
        stage = self._ready().stage
        for axis in axes:
            if axis not in stage.axes:
                raise StageError(
                    f"The rig has no axis {axis}, only {list(stage.axes)}.",
                    code="invalid_axis",
                    remedy="Use an axis that the rig file names.",
                )

    def check_targets(self, targets_mm: dict[int, float]) -> None:
        """Refuse targets outside the limits, and axes that are not ready, before any byte of a motion goes out."""
        stage = self._ready().stage
        self.check_axes(tuple(targets_mm))
        for axis, target in targets_mm.items():
            limits = stage.limits(axis)
            if not limits.low_mm <= target <= limits.high_mm:
                raise StageError(
                    f"Axis {axis} cannot go to {target:g} mm: limits {limits.low_mm:g} to {limits.high_mm:g} mm.",
                    code="out_of_limits",
                    remedy="Stay inside the limits that GET /stage shows.",
                    axis=axis,
                    target_mm=target,
                    limits_mm=[limits.low_mm, limits.high_mm],
                )
        for axis, target in targets_mm.items():
            status = stage.state(axis)
            if status.state.value in ("not_homed", "motor_off", "fault", "configuration"):
                code = {"fault": "stage_not_ready", "configuration": "configuration_state"}.get(
                    status.state.value, status.state.value
                )
                remedies = {
                    "motor_off": "POST /stage:enable; POST /stage:home where it was not homed either.",
                    "configuration_state": "POST /stage/axes/N:leave-configuration, which writes the flash memory.",
                }
                raise StateError(
                    f"Axis {axis} cannot move: it is {status.state.value}. {status.detail}".strip(),
                    code=code,
                    remedy=remedies.get(code, "POST /stage:home first."),
                    axis=axis,
                )
            self._check_room_to_arrive(axis, status.position_mm, target)

    def _check_room_to_arrive(self, axis: int, here_mm: float, target_mm: float) -> None:
        """Refuse a target that could only be arrived at from the wrong side; the driver would, but in mid-job."""
        section, limits = self.config.stage.of_axis(axis), self._ready().stage.limits(axis)
        sign = 1.0 if section.approach_from == "below" else -1.0
        turn = target_mm - sign * section.backlash_mm
        needed = section.backlash_mm > 0.0 and sign * (target_mm - here_mm) < section.backlash_mm
        if needed and not limits.low_mm <= turn <= limits.high_mm:
            raise StageError(
                f"Axis {axis} cannot arrive at {target_mm:g} mm from {section.approach_from}: it would turn at "
                f"{turn:g} mm, outside {limits.low_mm:g} to {limits.high_mm:g} mm.",
                code="out_of_limits",
                remedy=f"Stay the backlash ({section.backlash_mm:g} mm) inside the limit.",
                axis=axis,
                target_mm=target_mm,
            )

    def positions_mm(self, axes: tuple[int, ...] | None = None) -> dict[int, float]:
        """Read positions back."""
        stage = self._ready().stage
        return {axis: stage.position(axis) for axis in axes or stage.axes}

    def move(self, targets_mm: dict[int, float]) -> dict[int, MoveResult]:
        """Move; call on the owner thread, with the hold."""
        return self._ready().stage.move_many(targets_mm)

    def home(self, axes: tuple[int, ...]) -> dict[int, float]:
        """Switch on and home; call on the owner thread, with the hold."""
        stage = self._ready().stage
        found = {}
        for axis in axes:
            stage.enable(axis)
            found[axis] = stage.home(axis)
        return found

    def stop(self) -> None:
        """Stop every axis, now, from any thread."""
        self._ready().stage.stop()
