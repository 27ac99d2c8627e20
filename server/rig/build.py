"""Opening the devices of the rig file: real drivers; for a simulated rig its world and its simulated controllers."""

from __future__ import annotations

import contextlib
import functools
import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from stereorig.core.errors import CameraError, StageError
from stereorig.core.names import CAMERAS, CameraName
from stereorig.drivers.acquisition.actions import ActionTrigger
from stereorig.drivers.acquisition.sources import CommandedPairs, PairSource, StreamedPairs, TriggeredPairs
from stereorig.drivers.acquisition.unit import CameraUnit
from stereorig.drivers.cameras.protocol import CameraOptions, CameraSettings, FrameGrabber
from stereorig.drivers.registry import make_camera, make_stage
from stereorig.drivers.stages.controllers import Controllers, ControllerStatus, KeptController, Line
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.serial_stage import SerialStage
from stereorig.server.config.rig_file import ControllerSection, RigConfig
from stereorig.server.rig.cameras import CameraPair

if TYPE_CHECKING:
    from stereorig.sim.controllers.esp301 import SimESP301
    from stereorig.sim.controllers.smc100 import SimSMC100
    from stereorig.sim.world import SimWorld

OnLost = Callable[[CameraName, CameraError], None]
OnStage = Callable[[ControllerStatus], None]

_RENDER_S_PER_PIXEL = 100e-6
# The first view also compiles the renderer, after this process' other kernels: numba compiles one at a time
_COMPILE_S = 120.0


@dataclass(eq=False)
class Devices:
    """Everything that was opened or is looked for; ``world`` and ``controller`` (the first) only where simulated."""

    pair: CameraPair
    stage: Controllers
    world: SimWorld | None
    controller: SimESP301 | SimSMC100 | None
    _exit: contextlib.ExitStack

    def close(self) -> None:
        """Release everything: the stage first, which stops the axes."""
        self._exit.close()


def first_settings(config: RigConfig, cam: CameraName) -> CameraSettings:
    """Return the settings that the rig file gives."""
    section = config.camera(cam)
    return CameraSettings(
        exposure_ms=section.exposure_ms,
        gain_db=section.gain_db,
        bit_depth=section.bit_depth if section.pixel_format is None else None,
        pixel_format=section.pixel_format,
        region_px=section.region_px,
        features=_strobe(section.strobe_line) | section.features or None,
        trigger=config.trigger_of(cam),
    )


def _strobe(line: str | None) -> dict[str, bool | int | float | str]:
    """Return the features that make a line an output that is on during each exposure."""
    return {} if line is None else {"LineSelector": line, "LineMode": "Output", "LineSource": "ExposureActive"}


def open_devices(
    config: RigConfig,
    settings: Mapping[CameraName, CameraSettings],
    *,
    record: Path | None = None,
    dynamics: Mapping[int, tuple[float | None, float | None]] | None = None,
    on_lost: OnLost | None = None,
    on_stage: OnStage | None = None,
    on_lines: Callable[[list[Line]], None] | None = None,
    keep_looking: bool = False,
) -> Devices:
    """Open stage and cameras, push the cameras' settings.

    Parameters
    ----------
    config
        The rig file.
    settings
        First settings of each camera.
    record
        File that gets a transcript of the stage's wire; each further controller has a file next to it.
    dynamics
        Axis -> (velocity in mm/s, acceleration in mm/s^2) in place of the rig file's.
    on_lost
        Called from a camera's reader thread when the camera is lost.
    on_stage, on_lines
        ``on_change`` and ``on_lines`` of `stereorig.drivers.stages.controllers.Controllers`.
    keep_looking
        A device that is not there is no error. The cameras are not opened yet (`stereorig.server.rig.reconnect`); the
        stage's controllers are looked for until they are found, as long as the rig file has ``auto_reconnect``.

    Raises
    ------
    DeviceError
        With the device's own code; devices opened before are released.
    """
    with contextlib.ExitStack() as stack:
        simulated: dict[int, Callable[[], float]] = {}
        reader = _PositionReader(simulated)
        controllers: list[SimESP301 | SimSMC100] = []
        kept: list[KeptController] = []
        for line in _lines(config):
            url = line.url
            # here and below: a rig of real devices loads no renderer
            if url == "sim":
                from stereorig.sim.controllers.server import ControllerServer

                controllers.append(_simulated_controller(config, line))
                url = stack.enter_context(ControllerServer(controllers[-1])).url
                simulated |= {
                    axis: functools.partial(controllers[-1].true_position_mm, own) for axis, own in line.numbers.items()
                }
            stage = _made_stage(config, line, url, len(kept), record=record, dynamics=dynamics or {})
            kept.append(KeptController(stage, str(line.driver), line.url, watched=line.url != "sim"))
        world: SimWorld | None = None
        if config.rig.kind == "simulated":
            from stereorig.sim.rig import SimRig
            from stereorig.sim.world import SimWorld

            world = SimWorld(SimRig.from_dict(_tables(config)), reader)
        units: dict[CameraName, CameraUnit] = {}
        keys = new_action_keys()
        for cam in CAMERAS:
            unit = units[cam] = make_unit(config, cam, world, on_lost, keys)
            stack.callback(unit.release)
            (unit.look_for if keep_looking else unit.open)(settings[cam])
        pair = CameraPair(
            units["cam1"],
            units["cam2"],
            make_source=functools.partial(make_source, config, units, keys),
            skew_is_set=config.rig.max_skew_ms is not None,
            ptp=config.cam1.ptp and config.cam2.ptp,
        )
        stack.callback(pair.close)
        pair.start()
        reader.stage = controller = Controllers(kept, on_lines, on_stage)
        stack.callback(controller.close)
        controller.open()
        if not keep_looking:
            for status in controller.controllers():
                if status.fault is not None:
                    raise status.fault
        elif config.rig.auto_reconnect:
            controller.keep()
        return Devices(pair, controller, world, controllers[0] if controllers else None, stack.pop_all())


def new_action_keys() -> tuple[int, int, int]:
    """Return keys of action commands that no other rig on the network has."""
    return secrets.randbits(32), 1, 1


def make_unit(
    config: RigConfig,
    cam: CameraName,
    world: SimWorld | None = None,
    on_lost: OnLost | None = None,
    action_keys: tuple[int, int, int] | None = None,
) -> CameraUnit:
    """Make one camera as the rig file describes it, not yet opened; parameters as in :func:`open_devices`."""
    section = config.camera(cam)
    return CameraUnit(
        cam,
        functools.partial(_grabber, config, cam, world, action_keys or new_action_keys()),
        trigger=config.trigger_of(cam),
        rate_hz=config.rig.frame_rate_hz if config.rig.trigger in ("free", "hardware") else None,
        serial=section.serial,
        size_px=section.image_size_px,
        on_lost=on_lost,
    )


def make_source(
    config: RigConfig, units: Mapping[CameraName, CameraUnit], action_keys: tuple[int, int, int]
) -> PairSource:
    """Make the source of pairs that the rig file describes."""
    section, driving = config.rig, config.driving
    if section.trigger == "action":
        action = ActionTrigger(units, action_keys, lead_ms=section.action_lead_ms, broadcast=section.action_broadcast)
        lead_s = (section.action_lead_ms or 0.0) / 1000.0
        return CommandedPairs(units, fire=action.fire, max_skew_ms=section.skew_bound_ms, wired=False, lead_s=lead_s)
    if section.trigger == "software" and driving is not None:
        unit = units[driving]
        return CommandedPairs(units, fire=lambda: unit.reader.trigger(), max_skew_ms=section.skew_bound_ms, wired=True)
    if section.trigger == "software":
        return TriggeredPairs(units, max_skew_ms=section.skew_bound_ms)
    by: Literal["time", "frame"] = "time"
    if section.pairing == "frame" or (
        section.pairing == "auto"
        and (section.trigger == "hardware" or driving is not None)
        and section.frame_rate_hz is not None
    ):
        by = "frame"
    return StreamedPairs(
        units,
        by=by,
        max_skew_ms=section.skew_bound_ms,
        capture_timeout_s=section.capture_timeout_s,
        wired=True if driving is not None else None,
    )


def check_config(config: RigConfig) -> None:
    """Refuse a simulated rig whose truth cannot be read, before anything is opened.

    Raises
    ------
    InputError
        ``rig_invalid``.
    """
    if config.rig.kind == "simulated":
        from stereorig.sim.rig import SimRig

        SimRig.from_dict(_tables(config))


def open_configured_stage(config: RigConfig, *, record: Path | None = None) -> Controllers:
    """Open the stage alone, as the rig file describes it; parameters and errors as in :func:`open_devices`."""
    kept = [
        KeptController(
            _made_stage(config, line, line.url, place, record=record, dynamics={}), str(line.driver), line.url
        )
        for place, line in enumerate(_lines(config))
    ]
    stage = Controllers(kept)
    stage.open()
    for status in stage.controllers():
        if status.fault is not None:
            stage.close()
            raise status.fault
    return stage


def _lines(config: RigConfig) -> list[ControllerSection]:
    return [] if config.stage is None else config.stage.lines(config.axes)


def _made_stage(
    config: RigConfig,
    line: ControllerSection,
    url: str,
    place: int,
    *,
    record: Path | None,
    dynamics: Mapping[int, tuple[float | None, float | None]],
) -> SerialStage:
    if record is not None and place > 0:
        record = record.with_name(f"{record.stem}.{place + 1}{record.suffix}")
    return make_stage(
        str(line.driver),
        url,
        {axis: _axis_options(config, axis, dynamics.get(axis, (None, None))) for axis in line.axes},
        baudrate=line.baudrate,
        flow_control=line.flow_control,
        record=record,
        timeout_s=0.5 if config.stage is None else config.stage.reply_timeout_ms / 1000,
        numbers=line.numbers,
    )


class _PositionReader:
    """Position of an axis for simulated cameras: the true one of a simulated controller; else the last one read back.

    Without a stage the cameras stay at dZ = 0.
    """

    def __init__(self, simulated: Mapping[int, Callable[[], float]]) -> None:
        self.stage: Controllers | None = None
        self._simulated = simulated
        self._last_mm: dict[int, float] = {}

    def __call__(self, axis: int) -> float:
        if axis in self._simulated:
            return self._simulated[axis]()
        if self.stage is not None:
            with contextlib.suppress(StageError):
                self._last_mm[axis] = self.stage.position(axis)
        return self._last_mm.get(axis, 0.0)


def _axis_options(config: RigConfig, axis: int, dynamics: tuple[float | None, float | None]) -> AxisOptions:
    section = config.axis(axis)
    velocity, acceleration = dynamics
    return AxisOptions(
        soft_limits_mm=section.soft_limits_mm,
        velocity_mm_s=section.velocity_mm_s if velocity is None else velocity,
        acceleration_mm_s2=section.acceleration_mm_s2 if acceleration is None else acceleration,
        backlash_mm=section.backlash_mm,
        approach_from=section.approach_from,
        settle_ms=section.settle_ms,
        tolerance_mm=section.tolerance_mm,
        assume_homed=section.assume_homed,
        home_mode=section.home_mode,
        positioner=section.positioner,
        mm_per_step=section.mm_per_step,
    )


def _tables(config: RigConfig) -> dict[str, object]:
    tables = config.model_dump(mode="python", exclude_none=True)
    for cam in CAMERAS:
        tables[cam]["stage_zero_mm"] = (
            0.0 if config.stage is None else config.axis(config.camera(cam).stage_axis).zero_mm
        )
    return tables


def _simulated_controller(config: RigConfig, line: ControllerSection) -> SimESP301 | SimSMC100:
    from stereorig.sim.controllers.registry import make_controller

    # room beyond the soft limits, as on a real stage
    limits = [config.axis(axis).soft_limits_mm for axis in line.axes]
    return make_controller(
        str(line.driver),
        sorted(line.numbers.values()),
        travel_mm=(min(low for low, _ in limits) - 5.0, max(high for _, high in limits) + 5.0),
        time_scale=float((config.sim or {}).get("time_scale", 1.0)),
    )


def _grabber(
    config: RigConfig, cam: CameraName, world: SimWorld | None, action_keys: tuple[int, int, int] | None
) -> FrameGrabber:
    section = config.camera(cam)
    if world is not None:
        from stereorig.sim.grabber import SimFrameGrabber

        columns, rows = section.image_size_px
        # a view is rendered when it is first asked for; the watchdog must not take that for death
        return SimFrameGrabber(world, cam, latency_s=max(_COMPILE_S, _RENDER_S_PER_PIXEL * columns * rows))
    return make_camera(
        section.driver,
        CameraOptions(
            device=section.device or "",
            buffers=section.buffers,
            packet_size_bytes=section.packet_size_bytes,
            ptp=section.ptp,
            trigger_source=section.trigger_source,
            trigger_edge=section.trigger_edge,
            action_keys=action_keys,
            trigger_features=dict(section.trigger_features),
        ),
    )
