"""The rig as the service uses it: captures, moves, settings, state.

Everything that makes the hardware do something runs on its one owner thread (:class:`HardwareGate`);
reading the stage's state and stopping it do not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from core.errors import CameraError, DeviceError, InputError, StageError, StateError, StereorigError
from core.names import CAMERAS, CameraName
from drivers.cameras.protocol import CameraSettings
from drivers.stages.protocol import MoveResult
from server.base.problem import problem_of
from server.config.rig_file import RigConfig
from server.jobs.hardware import HardwareGate
from server.rig.build import Devices, first_settings, open_devices
from server.rig.cameras import CameraPair
from server.rig.reconnect import ReconnectWatch
from server.rig.shared import SharedReading
from server.rig.stage_controls import StageControls

_log = logging.getLogger("stereorig.rig")


def _tell_nobody(_name: str, _data: dict[str, Any]) -> None:
    """Stand in for an event hub."""


class Rig:
    """Two cameras and their stage.

    Parameters
    ----------
    config
        The rig file.
    gate
        Hold and owner thread, shared with the jobs.
    announce
        Called with ``camera`` and what happened when a camera is lost or comes back.
    record
        File that gets a transcript of the stage's wire.
    """

    def __init__(
        self,
        config: RigConfig,
        gate: HardwareGate,
        announce: Callable[[str, dict[str, Any]], None] | None = None,
        *,
        record: Path | None = None,
    ) -> None:
        self.config = config
        self._record = record
        self.gate = gate
        self._announce = announce if announce is not None else _tell_nobody
        self._devices: Devices | None = None
        self._fault: dict[str, Any] | None = {"code": "not_connected", "cause": "The rig was not opened yet."}
        # what the cameras were last set to, so that a reconnected one gets it again
        self._settings = {cam: first_settings(config, cam) for cam in CAMERAS}
        self.scene: dict[str, Any] | None = None
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
                self.scene = {"scene": "grid", "load": 0.0}
            if self.config.home_at_start:
                self._home_at_start()
        except StereorigError as error:
            _log.exception("the rig could not be opened")
            self._fault = problem_of(error).plain()
            self._close_devices()

    def _home_at_start(self) -> None:
        # an axis in configuration state is shown as such, and can only be helped with the rig open
        stuck = self.controls.in_configuration(self.config.axes)
        try:
            self.home(tuple(axis for axis in self.config.axes if axis not in stuck))
        except StageError as error:
            if error.code != "stage_stopped":
                raise
            # somebody wants it to stand still, and the cameras to go on
            _log.warning("homing was stopped; the rig is open, and its axes are to be homed before they move")

    def close(self) -> None:
        """Stop the stage first, then release everything."""
        self._close_devices()

    def reconnect(self) -> None:
        """Close, open again, push the settings."""
        self._close_devices()
        self.open()
        if self._fault is not None:
            raise DeviceError(str(self._fault["cause"]), code=self._fault["code"], remedy=self._fault.get("remedy"))
        if self.scene is not None:
            scene = dict(self.scene)
            self.set_scene(scene.pop("scene"), load=scene.pop("load"), **scene)

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
    def fault(self) -> dict[str, Any] | None:
        """Why the rig cannot be used, or None."""
        return self._fault

    def _ready(self) -> Devices:
        devices = self._devices
        if devices is None:
            cause = self._fault["cause"] if self._fault else "The rig is closed."
            raise DeviceError(
                f"The rig is not connected: {cause}",
                code="not_connected",
                remedy="Put the fault right, then POST /rig/reconnect.",
            )
        return devices

    @property
    def pair(self) -> CameraPair:
        """Both cameras."""
        return self._ready().pair

    # description ------------------------------------------------------------------------------------------------

    def describe(self) -> dict[str, Any]:
        """Return everything a client wants to know before it does anything."""
        config = self.config
        return {
            "name": config.rig.name,
            "description": config.rig.description,
            "sim": config.rig.kind == "simulated",
            "connected": self._devices is not None,
            "fault": self._fault,
            "holder": self.gate.holder,
            "scene": self.scene,
            "trigger": config.rig.trigger,
            "max_skew_ms": config.rig.skew_bound_ms,
            "target": config.target.model_dump(mode="json"),
            "calibration_plan": config.calibration.model_dump(mode="json"),
            "cameras": {cam: self.describe_camera(cam) for cam in CAMERAS},
            "stage": self._describe_stage_or_fault(),
        }

    def describe_camera(self, cam: CameraName) -> dict[str, Any]:
        """Nominal data, the device's own description, and the settings it has."""
        section = self.config.camera(cam)
        shown: dict[str, Any] = {
            "name": cam,
            "nominal": section.model_dump(mode="json"),
            "device": None,
            "settings": None,
        }
        if self._devices is not None:
            unit = self._devices.pair.units[cam]
            shown["device"] = asdict(unit.description)
            shown["settings"] = asdict(unit.settings)
            shown["fault"] = None if unit.fault is None else problem_of(unit.fault).plain()
            shown["reconnections"] = unit.reconnections
        return shown

    def identities(self) -> dict[str, dict[str, str]]:
        """Model and serial number of each camera, for the records of what they took."""
        described = {cam: self.pair.units[cam].description for cam in CAMERAS}
        return {cam: {"model": found.model, "serial": found.serial} for cam, found in described.items()}

    def record(self) -> dict[str, Any]:
        """What a report wants to know of the rig that took a step: how it runs, and each camera's settings and lens."""
        section = self.config.rig
        cameras: dict[str, Any] = {}
        for cam in CAMERAS:
            has = self.pair.units[cam].settings
            cameras[cam] = {
                "exposure_ms": has.exposure_ms,
                "gain_db": has.gain_db,
                "frame_rate_hz": has.frame_rate_hz,
                "pixel_format": has.pixel_format,
                **self.config.camera(cam).facts().model_dump(mode="json", exclude_none=True),
            }
        return {
            "name": section.name,
            "simulated": section.kind == "simulated",
            "trigger": section.trigger,
            "frame_rate_hz": section.frame_rate_hz,
            "max_skew_ms": section.skew_bound_ms,
            "lighting": section.lighting,
            "cameras": cameras,
        }

    def _describe_stage_or_fault(self) -> dict[str, Any]:
        # a silent stage must not hide the cameras
        try:
            return self.describe_stage()
        except StageError as error:
            section = self.config.stage
            return {
                "driver": section.driver,
                "identity": None,
                "axes": [],
                "zero_mm": section.zero_mm,
                "fault": problem_of(error).plain(),
            }

    def describe_stage(self) -> dict[str, Any]:
        """Identity, limits and state of each axis; who asks while others do shares their reading."""
        return self._stage_reading()

    def _read_stage(self) -> dict[str, Any]:
        section = self.config.stage
        shown: dict[str, Any] = {
            "driver": section.driver,
            "identity": None,
            "axes": [],
            "zero_mm": section.zero_mm,
            "fault": None,
        }
        devices = self._devices
        if devices is None:
            return shown | {"fault": self._fault}
        shown["identity"] = asdict(devices.stage.identify())
        for axis in devices.stage.axes:
            status = devices.stage.state(axis)
            shown["axes"].append(
                {
                    **asdict(status),
                    "state": status.state.value,
                    "limits": asdict(devices.stage.limits(axis)),
                    "dynamics": asdict(devices.stage.dynamics(axis)),
                    "zero_mm": section.of_axis(axis).zero_mm,
                    "cameras": [cam for cam in CAMERAS if self.config.camera(cam).stage_axis == axis],
                }
            )
        return shown

    # cameras ----------------------------------------------------------------------------------------------------

    def configure(self, cam: CameraName, settings: CameraSettings) -> CameraSettings:
        """Change settings on the owner thread; returns what the device really took."""
        pair = self.pair
        taken = self.gate.call(lambda: pair.configure(cam, settings))
        self._settings[cam] = pair.units[cam].wanted
        return taken

    def set_scene(self, name: str, *, load: float = 0.0, **params: Any) -> dict[str, Any]:
        """Put something else before a simulated rig's cameras."""
        world = self._ready().world
        if world is None:
            raise StateError(
                "This rig has real cameras: there is no scene to set.",
                code="not_simulated",
                remedy="Start the service with a simulated rig's file.",
            )
        try:
            world.set_scene(name, load=load, **params)
        except (TypeError, ValueError) as error:
            raise InputError(f"Scene {name!r}: {error}.", code="scene_invalid") from error
        self.scene = {"scene": name, "load": load, **params}
        return self.scene

    # stage ------------------------------------------------------------------------------------------------------

    def targets_for_dz(self, dz_mm: dict[CameraName, float]) -> dict[int, float]:
        """Return axis positions that bring each camera to its dZ.

        Raises
        ------
        InputError
            ``axis_conflict`` if one axis moves both cameras and they are asked for different places.
        """
        targets: dict[int, float] = {}
        for cam, dz in dz_mm.items():
            section = self.config.camera(cam)
            position = self.config.stage.of_axis(section.stage_axis).zero_mm + section.stage_sign * dz
            if abs(targets.setdefault(section.stage_axis, position) - position) > 1e-9:
                raise InputError(
                    f"Axis {section.stage_axis} moves both cameras, and they are sent to different places.",
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
                    "motor_off": "POST /stage/enable; POST /stage/home where it was not homed either.",
                    "configuration_state": "POST /stage/axes/N/leave-configuration, which writes the flash memory.",
                }
                raise StateError(
                    f"Axis {axis} cannot move: it is {status.state.value}. {status.detail}".strip(),
                    code=code,
                    remedy=remedies.get(code, "POST /stage/home first."),
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
