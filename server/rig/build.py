"""Opening what the rig file names: real drivers, and for a simulated rig the world and the controllers they talk to."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from core.errors import CameraError, StageError
from core.names import CAMERAS, CameraName
from drivers.acquisition.sources import PairSource, StreamedPairs, TriggeredPairs
from drivers.acquisition.unit import CameraUnit
from drivers.cameras.protocol import CameraOptions, CameraSettings, FrameGrabber
from drivers.registry import make_camera, open_stage
from drivers.stages.protocol import AxisOptions, Stage
from server.config.rig_file import RigConfig
from server.rig.cameras import CameraPair
from sim.controllers.esp301 import SimESP301
from sim.controllers.registry import make_controller
from sim.controllers.server import ControllerServer
from sim.controllers.smc100 import SimSMC100
from sim.grabber import SimFrameGrabber
from sim.rig import SimRig
from sim.world import SimWorld

OnLost = Callable[[CameraName, CameraError], None]

_RENDER_S_PER_PIXEL = 100e-6
# The first view also compiles the renderer, behind whatever else this process compiles: numba does one at a time
_COMPILE_S = 120.0


@dataclass(eq=False)
class Devices:
    """Everything that was opened; ``world`` and ``controller`` only on a simulated rig."""

    pair: CameraPair
    stage: Stage
    world: SimWorld | None
    controller: SimESP301 | SimSMC100 | None
    _exit: contextlib.ExitStack

    def close(self) -> None:
        """Release everything: the stage first, which stops what moves."""
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
        features=section.features or None,
        trigger=config.rig.trigger,
    )


def open_devices(
    config: RigConfig,
    settings: Mapping[CameraName, CameraSettings],
    *,
    record: Path | None = None,
    dynamics: Mapping[int, tuple[float | None, float | None]] | None = None,
    on_lost: OnLost | None = None,
) -> Devices:
    """Open stage and cameras, push the cameras' settings.

    Parameters
    ----------
    config
        The rig file.
    settings
        What each camera is set to.
    record
        File that gets a transcript of the stage's wire.
    dynamics
        Axis -> (velocity in mm/s, acceleration in mm/s^2) in place of the rig file's.
    on_lost
        Called from a camera's reader thread when the camera is lost.

    Raises
    ------
    DeviceError
        With the device's own code; what was opened before is released.
    """
    with contextlib.ExitStack() as stack:
        world: SimWorld | None = None
        controller: SimESP301 | SimSMC100 | None = None
        url = config.stage.url
        reader = _PositionReader()
        if url == "sim":
            controller = _simulated_controller(config)
            url = stack.enter_context(ControllerServer(controller)).url
        if config.rig.kind == "simulated":
            where = reader if controller is None else controller.true_position_mm
            world = SimWorld(SimRig.from_dict(_tables(config)), where)
        units: dict[CameraName, CameraUnit] = {}
        for cam in CAMERAS:
            unit = make_unit(config, cam, world, on_lost)
            stack.callback(unit.release)
            unit.open(settings[cam])
            units[cam] = unit
        pair = CameraPair(
            units["cam1"],
            units["cam2"],
            make_source=functools.partial(_pair_source, config, units),
            skew_is_set=config.rig.max_skew_ms is not None,
        )
        stack.callback(pair.close)
        pair.start()
        stage = open_configured_stage(config, url, record=record, dynamics=dynamics)
        stack.callback(stage.close)
        reader.stage = stage
        return Devices(pair, stage, world, controller, stack.pop_all())


def make_unit(
    config: RigConfig, cam: CameraName, world: SimWorld | None = None, on_lost: OnLost | None = None
) -> CameraUnit:
    """Make one camera as the rig file describes it, not yet opened; parameters as in :func:`open_devices`."""
    section = config.camera(cam)
    return CameraUnit(
        cam,
        functools.partial(_grabber, config, cam, world),
        trigger=config.rig.trigger,
        rate_hz=config.rig.frame_rate_hz,
        serial=section.serial,
        size_px=section.image_size_px,
        on_lost=on_lost,
    )


def _pair_source(config: RigConfig, units: Mapping[CameraName, CameraUnit]) -> PairSource:
    section = config.rig
    if section.trigger == "software":
        return TriggeredPairs(units, max_skew_ms=section.skew_bound_ms)
    by: Literal["time", "frame"] = "time"
    if section.pairing == "frame" or (
        section.pairing == "auto" and section.trigger == "hardware" and section.frame_rate_hz is not None
    ):
        by = "frame"
    return StreamedPairs(units, by=by, max_skew_ms=section.skew_bound_ms, capture_timeout_s=section.capture_timeout_s)


def check_config(config: RigConfig) -> None:
    """Refuse a simulated rig whose truth cannot be read, before anything is opened.

    Raises
    ------
    InputError
        ``rig_invalid``.
    """
    if config.rig.kind == "simulated":
        SimRig.from_dict(_tables(config))


def open_configured_stage(
    config: RigConfig,
    url: str,
    *,
    record: Path | None = None,
    dynamics: Mapping[int, tuple[float | None, float | None]] | None = None,
) -> Stage:
    """Open the stage alone, as the rig file describes it; parameters and errors as in :func:`open_devices`."""
    section = config.stage
    return open_stage(
        section.driver,
        url,
        {axis: _axis_options(config, axis, (dynamics or {}).get(axis, (None, None))) for axis in config.axes},
        baudrate=section.baudrate,
        flow_control=section.flow_control,
        record=record,
        timeout_s=section.reply_timeout_ms / 1000,
    )


class _PositionReader:
    """Position of a real stage with simulated cameras; its last one while it does not answer."""

    def __init__(self) -> None:
        self.stage: Stage | None = None
        self._last_mm: dict[int, float] = {}

    def __call__(self, axis: int) -> float:
        if self.stage is not None:
            with contextlib.suppress(StageError):
                self._last_mm[axis] = self.stage.position(axis)
        return self._last_mm.get(axis, 0.0)


def _axis_options(config: RigConfig, axis: int, dynamics: tuple[float | None, float | None]) -> AxisOptions:
    section = config.stage.of_axis(axis)
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
    )


def _tables(config: RigConfig) -> dict[str, object]:
    tables = config.model_dump(mode="python", exclude_none=True)
    for cam in CAMERAS:
        tables[cam]["stage_zero_mm"] = config.stage.of_axis(config.camera(cam).stage_axis).zero_mm
    return tables


def _simulated_controller(config: RigConfig) -> SimESP301 | SimSMC100:
    # room beyond the soft limits, as on a real stage
    limits = [config.stage.of_axis(axis).soft_limits_mm for axis in config.axes]
    return make_controller(
        config.stage.driver,
        config.axes,
        travel_mm=(min(low for low, _ in limits) - 5.0, max(high for _, high in limits) + 5.0),
        time_scale=float((config.sim or {}).get("time_scale", 1.0)),
    )


def _grabber(config: RigConfig, cam: CameraName, world: SimWorld | None) -> FrameGrabber:
    section = config.camera(cam)
    if world is not None:
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
            trigger_features=dict(section.trigger_features),
        ),
    )
