"""The rig as the service uses it: captures, moves, settings, state.

Everything that makes the hardware do something runs on its one owner thread, see
:class:`stereorig.server.jobs.hardware.HardwareHold`; reading the stage's state and stopping it do not.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Protocol

from stereorig.core.errors import CameraError, DeviceError, InputError, StageError, StateError, StereorigError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.cameras.protocol import CameraSettings
from stereorig.drivers.stages.controllers import ControllerStatus
from stereorig.drivers.stages.protocol import MoveResult, Stage
from stereorig.server.base.problem import JobProblem, problem_of
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.jobs.hardware import HardwareHold
from stereorig.server.rig.build import Devices, OnLost, OnStage, first_settings, open_devices
from stereorig.server.rig.cameras import CameraPair
from stereorig.server.rig.description import (
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
    controller_reply,
    identity_of,
    kept_camera,
    utc_of,
)
from stereorig.server.rig.process.remote import Check, RemoteDevices, RemoteRig
from stereorig.server.rig.reconnect import ReconnectWatch
from stereorig.server.rig.shared import SharedReading
from stereorig.server.rig.stage_controls import StageControls

_log = logging.getLogger("stereorig.rig")
# finding, setting and arming a camera takes one or two seconds; one that takes longer comes later
_FIRST_S = 10.0


class OpenDevices(Protocol):
    """Opens the rig file's devices, in this process (`stereorig.server.rig.build.open_devices`) or in another one."""

    def __call__(
        self,
        config: RigConfig,
        settings: Mapping[CameraName, CameraSettings],
        *,
        record: Path | None = None,
        dynamics: Mapping[int, tuple[float | None, float | None]] | None = None,
        on_lost: OnLost | None = None,
        on_stage: OnStage | None = None,
        keep_looking: bool = False,
    ) -> Devices | RemoteDevices:
        """Open stage and cameras."""


def _no_announcement(_name: str, _data: Mapping[str, object]) -> None:
    """Do nothing, in place of an event hub."""


class Rig:
    """Two cameras and their stage.

    Parameters
    ----------
    config
        The rig file.
    hardware
        Hold and owner thread, shared with the jobs.
    announce
        Called with ``camera`` or ``stage`` and its state when a camera or a controller is lost or connected.
    record
        File that gets a transcript of the stage's wire.
    opener
        Opens the devices; by default in this process.
    """

    def __init__(
        self,
        config: RigConfig,
        hardware: HardwareHold,
        announce: Callable[[str, Mapping[str, object]], None] | None = None,
        *,
        record: Path | None = None,
        opener: OpenDevices = open_devices,
    ) -> None:
        self.config = config
        self._record = record
        self._opener = opener
        self.hardware = hardware
        self._announce = announce if announce is not None else _no_announcement
        self._devices: Devices | RemoteDevices | None = None
        self._fault: JobProblem | None = JobProblem(
            code="not_connected", detail="The rig was not opened yet.", remedy="Wait until it is open."
        )
        # cameras that were not found since the rig was opened
        self._missing: dict[CameraName, JobProblem] = {}
        # the cameras' last settings, so that a reconnected one gets them again
        self._settings = {cam: first_settings(config, cam) for cam in CAMERAS}
        self.scene: SceneReply | None = None
        self._knocks: dict[str, object] = {}
        self._watch: ReconnectWatch | None = None
        self._stage_reading = SharedReading(self._read_stage)
        self.controls = StageControls(lambda: self._ready().stage)

    # opening and closing ----------------------------------------------------------------------------------------

    def open(self, *, home: bool = True) -> None:
        """Open cameras and stage; a device that is not there is looked for from now on, and shown with its fault.

        Parameters
        ----------
        home
            Home the axes if the rig file asks for it.
        """
        try:
            self._devices = self._opener(
                self.config,
                self._settings,
                record=self._record,
                dynamics=self.controls.dynamics,
                on_lost=self._lost,
                on_stage=self._stage_changed,
                keep_looking=True,
            )
            pair = self._devices.pair
            self._missing = {cam: problem_of(error) for cam, error in pair.missing().items()}
            self._fault = None
            watch = self._watch = ReconnectWatch(
                pair, self._came_back, self._not_found, again=self.config.rig.auto_reconnect
            )
            watch.start()
            self.controls.collect(self._devices.stage)
            if self._devices.world is not None and self.scene is None:
                self.scene = SceneReply(scene="grid", load=0.0)
            if home and self.config.home_at_start:
                self._home_at_start()
            watch.wait_for_first(_FIRST_S)
        except StereorigError as error:
            _log.exception("the rig could not be opened")
            self._fault = problem_of(error)
            self._close_devices()

    def _home_at_start(self) -> None:
        # without the stage the cameras still work; a controller that is found later is not moved unasked
        there = tuple(axis for one in self._ready().stage.controllers() if one.fault is None for axis in one.axes)
        try:
            # an axis in configuration state is shown as such, and can only be helped with the rig open
            stuck = self.controls.in_configuration(there)
            self.home(tuple(axis for axis in there if axis not in stuck), lambda: None)
        except StageError as error:
            _log.warning("homing has failed, and the axes are to be homed before they move: %s", error)

    def close(self) -> None:
        """Stop the stage first, then release everything."""
        self._close_devices()

    def lose(self, error: DeviceError) -> None:
        """Note that the process with the devices has ended: nothing can be used until the rig is opened again."""
        self._fault = problem_of(error)
        self._close_devices()

    def reconnect(self, *, home: bool = True) -> None:
        """Close, open again, push the settings; ``home`` as in :meth:`open`.

        Raises
        ------
        DeviceError
            A device is not there; the others are open, and it is looked for.
        """
        self._close_devices()
        self.open(home=home)
        if self.is_open and self.scene is not None:
            self.set_scene(self.scene.scene, load=self.scene.load, params=self._knocks | (self.scene.model_extra or {}))
        stage = self._describe_stage_or_fault()
        fault = self.fault or stage.fault
        if fault is not None:
            raise DeviceError(fault.detail, code=fault.code, remedy=fault.remedy)

    def _lost(self, cam: CameraName, error: CameraError) -> None:
        _log.warning("%s was lost: %s", cam, error)
        self._announce("camera", {"camera": cam, "state": "lost", "problem": problem_of(error).plain()})

    def _came_back(self, cam: CameraName) -> None:
        first = self._missing.pop(cam, None) is not None
        _log.log(logging.INFO if first else logging.WARNING, "%s is connected", cam)
        self._announce("camera", {"camera": cam, "state": "connected"})

    def _not_found(self, cam: CameraName, error: StereorigError) -> None:
        if cam in self._missing:
            self._missing[cam] = problem_of(error)

    def _stage_changed(self, status: ControllerStatus) -> None:
        problem = {} if status.fault is None else {"problem": problem_of(status.fault).plain()}
        about = {"axes": list(status.axes), "url": status.url, "state": status.state}
        self._announce("stage", {**about, **problem})

    def _close_devices(self) -> None:
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.stop()
        devices, self._devices = self._devices, None
        self._missing = {}
        if devices is not None:
            with contextlib.suppress(DeviceError):  # of a process that has ended, and its messages with it
                self.controls.collect(devices.stage, ask=False)
            devices.close()

    @property
    def is_remote(self) -> bool:
        """True if another process holds the devices."""
        return isinstance(self._opener, RemoteRig)

    @property
    def is_open(self) -> bool:
        """True if the devices were opened, whether each of them was found or not."""
        return self._devices is not None

    @property
    def fault(self) -> JobProblem | None:
        """Fault that keeps the rig from being used: it is not open, or a camera was not found yet; else None."""
        return self._fault or next(iter(self._missing.values()), None)

    def _ready(self) -> Devices | RemoteDevices:
        devices = self._devices
        if devices is None:
            cause = self._fault.detail if self._fault else "The rig is closed."
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
        config, fault, stage = self.config, self.fault, self._describe_stage_or_fault()
        return RigReply(
            name=config.rig.name,
            description=config.rig.description,
            sim=config.rig.kind == "simulated",
            simulated=config.simulated,
            connected=fault is None and all(one.state != "looked_for" for one in stage.controllers),
            fault=fault,
            holder=self.hardware.holder,
            scene=self.scene,
            trigger=config.rig.trigger,
            max_skew_ms=config.rig.skew_bound_ms,
            target=NominalTarget.model_validate(config.target.plain()),
            calibration_plan=UsualPlan.model_validate(config.calibration.model_dump(mode="json")),
            cameras={cam: self.describe_camera(cam) for cam in CAMERAS},
            stage=stage,
        )

    def describe_camera(self, cam: CameraName) -> CameraReply:
        """Nominal data, the device's own description, and the settings it has."""
        nominal = NominalCamera.model_validate(self.config.camera(cam).model_dump(mode="json"))
        devices = self._devices
        if devices is None:
            return CameraReply(name=cam, nominal=nominal, device=None, settings=None)
        unit = devices.pair.units[cam]
        fault, found = unit.fault, unit.was_found
        return CameraReply(
            name=cam,
            nominal=nominal,
            device=CameraDevice.model_validate(asdict(unit.description)) if found else None,
            settings=CameraSettingsReply.model_validate(asdict(unit.settings)) if found else None,
            fault=None if fault is None else problem_of(fault),
            state="connected" if fault is None else "lost" if found else "looked_for",
            since_utc=utc_of(unit.since_s),
            reconnections=unit.reconnections,
        )

    def identities(self) -> dict[str, dict[str, str]]:
        """Identity of each camera, for the records of their images."""
        return {cam: identity_of(description) for cam, (description, _) in self.pair.described().items()}

    def record(self) -> RigKept:
        """Record of the rig that took a step, for a report."""
        section, cameras = self.config.rig, self.pair.described()
        return RigKept(
            name=section.name,
            simulated=section.kind == "simulated",
            trigger=section.trigger,
            frame_rate_hz=section.frame_rate_hz,
            max_skew_ms=section.skew_bound_ms,
            lighting=section.lighting,
            cameras={cam: kept_camera(cameras[cam][1], self.config.camera(cam).metadata()) for cam in CAMERAS},
        )

    def _describe_stage_or_fault(self) -> StageReply:
        # a silent stage must not hide the cameras
        try:
            return self.describe_stage()
        except StageError as error:
            devices = self._devices
            return self._no_stage(problem_of(error), () if devices is None else devices.stage.controllers())

    def _no_stage(self, fault: JobProblem | None, controllers: Sequence[ControllerStatus] = ()) -> StageReply:
        section = self.config.stage
        return StageReply(
            driver=None if section is None else section.driver,
            identity=None,
            axes=[],
            zero_mm=0.0 if section is None else section.zero_mm,
            fault=fault,
            controllers=[controller_reply(one) for one in controllers],
        )

    def describe_stage(self) -> StageReply:
        """Identity, limits and state of each axis; who asks while others do shares their reading.

        Raises
        ------
        StageError
            No controller answers that did before.
        """
        return self._stage_reading()

    def _read_stage(self) -> StageReply:
        devices = self._devices
        if devices is None:
            return self._no_stage(self._fault)
        axes: list[AxisReply] = []
        lost: StageError | None = None
        for axis in devices.stage.axes:
            try:
                axes.append(self._read_axis(devices.stage, axis))
            except StageError as error:
                lost = error
        controllers = devices.stage.controllers()
        fault = next((one.fault for one in controllers if one.fault is not None), lost)
        reply = self._no_stage(None if fault is None else problem_of(fault), controllers)
        if axes:
            identity = StageIdentityReply.model_validate(asdict(devices.stage.identify()))
            return reply.model_copy(update={"axes": axes, "identity": identity})
        if lost is not None and any(one.state != "looked_for" for one in controllers):
            raise lost
        return reply

    def _read_axis(self, stage: Stage, axis: int) -> AxisReply:
        return AxisReply.model_validate(
            {
                **asdict(stage.state(axis)),
                "limits": asdict(stage.limits(axis)),
                "dynamics": asdict(stage.dynamics(axis)),
                "zero_mm": self.config.axis(axis).zero_mm,
                "cameras": [cam for cam in CAMERAS if self.config.camera(cam).stage_axis == axis],
            }
        )

    # cameras ----------------------------------------------------------------------------------------------------

    def configure(self, cam: CameraName, settings: CameraSettings) -> CameraSettings:
        """Change settings on the owner thread; return the settings as the device took them."""
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
        # a knocked camera stays knocked in later scenes
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
            position = self.config.axis(section.stage_axis).zero_mm + section.stage_sign * dz
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
        return section.stage_sign * (position_mm - self.config.axis(section.stage_axis).zero_mm)

    def check_axes(self, axes: tuple[int, ...]) -> None:
        """Refuse axes that the rig does not have or whose controller is not there, and any on a rig without a stage."""
        stage = self._ready().stage
        if not stage.axes:
            self.config.axis(1)  # raises the reason
        for axis in axes:
            if axis not in stage.axes:
                raise StageError(
                    f"The rig has no axis {axis}, only {list(stage.axes)}.",
                    code="invalid_axis",
                    remedy="Use an axis that the rig file names.",
                )
            stage.limits(axis)  # raises the reason where its controller was not found

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
                    "motor_off": "POST /stage:enable; POST /stage:home if it was not homed either.",
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
        section, limits = self.config.axis(axis), self._ready().stage.limits(axis)
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

    def known_positions(self) -> dict[int, float | StageError]:
        """Return the position of each axis, or the reason why it is not known; none without a stage."""
        return self._ready().stage.known_positions()

    def positions_mm(self, axes: tuple[int, ...] | None = None) -> dict[int, float]:
        """Read positions back."""
        stage = self._ready().stage
        return {axis: stage.position(axis) for axis in axes or stage.axes}

    def move(self, targets_mm: dict[int, float], check: Check) -> dict[int, MoveResult]:
        """Move; call on the owner thread, with the hold.

        ``check`` raises if the motion's job is cancelled. A stop cancels the job before its number is known here:
        the number is read first, so that a stop either ends the check or refuses the motion.
        """
        stage = self._ready().stage
        since = stage.last_stop
        check()
        return stage.move_many(targets_mm, since=since)

    def home(self, axes: tuple[int, ...], check: Check) -> dict[int, float]:
        """Switch on and home; call on the owner thread, with the hold; ``check`` as in `move`."""
        stage = self._ready().stage
        since = stage.last_stop
        check()
        found = {}
        for axis in axes:
            stage.enable(axis, since=since)
            found[axis] = stage.home(axis, since=since)
        return found

    def stop(self) -> None:
        """Stop every axis, now, from any thread."""
        self._ready().stage.stop()
