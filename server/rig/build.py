"""Opening what the rig file names: real drivers, and for a simulated rig the world and the controllers they talk to."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from core.errors import CameraError
from drivers.frames import CameraSettings, FrameGrabber
from drivers.registry import open_stage
from drivers.stage import AxisOptions, Stage
from server.config import CameraName, RigConfig
from server.rig.cameras import CAMERAS, CameraPair, CameraUnit
from sim.controllers.esp301 import SimESP301
from sim.controllers.server import ControllerServer
from sim.controllers.smc100 import SimSMC100
from sim.grabber import SimFrameGrabber
from sim.rig import SimRig
from sim.world import SimWorld

_RENDER_S_PER_PIXEL = 100e-6


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
        exposure_ms=section.exposure_ms, gain_db=section.gain_db, bit_depth=section.bit_depth, trigger="software"
    )


def open_devices(config: RigConfig, settings: Mapping[CameraName, CameraSettings]) -> Devices:
    """Open stage and cameras, push the cameras' settings.

    Raises
    ------
    DeviceError
        With the device's own code; what was opened before is released.
    """
    with contextlib.ExitStack() as stack:
        world: SimWorld | None = None
        controller: SimESP301 | SimSMC100 | None = None
        url = config.stage.url
        if config.rig.kind == "simulated":
            controller = _simulated_controller(config)
            url = stack.enter_context(ControllerServer(controller)).url
            world = SimWorld(SimRig.from_dict(_tables(config)), controller.true_position_mm)
        units = []
        for cam in CAMERAS:
            unit = CameraUnit(cam, _grabber(config, cam, world))
            stack.callback(unit.close)
            unit.open(settings[cam])
            units.append(unit)
        stage = open_stage(config.stage.driver, url, _axis_options(config))
        stack.callback(stage.close)
        return Devices(
            CameraPair(*units, max_skew_ms=config.rig.max_skew_ms), stage, world, controller, stack.pop_all()
        )


def check_config(config: RigConfig) -> None:
    """Refuse a simulated rig whose truth cannot be read, before anything is opened.

    Raises
    ------
    InputError
        ``rig_invalid``.
    """
    if config.rig.kind == "simulated":
        SimRig.from_dict(_tables(config))


def _axis_options(config: RigConfig) -> dict[int, AxisOptions]:
    section = config.stage
    options = AxisOptions(
        soft_limits_mm=section.soft_limits_mm,
        velocity_mm_s=section.velocity_mm_s,
        acceleration_mm_s2=section.acceleration_mm_s2,
        backlash_mm=section.backlash_mm,
        approach_from=section.approach_from,
        settle_ms=section.settle_ms,
        tolerance_mm=section.tolerance_mm,
    )
    return dict.fromkeys(config.axes, options)


def _tables(config: RigConfig) -> dict[str, Any]:
    tables = config.model_dump(mode="python", exclude_none=True)
    for cam in CAMERAS:
        tables[cam]["stage_zero_mm"] = config.stage.zero_mm
    return tables


def _simulated_controller(config: RigConfig) -> SimESP301 | SimSMC100:
    # room beyond the soft limits, as on a real stage
    low, high = config.stage.soft_limits_mm
    travel = (low - 5.0, high + 5.0)
    time_scale = float((config.sim or {}).get("time_scale", 1.0))
    if config.stage.driver == "smc100":
        return SimSMC100(addresses=config.axes, travel_mm=travel, time_scale=time_scale)
    return SimESP301(axes=max(config.axes), travel_mm=travel, time_scale=time_scale)


def _grabber(config: RigConfig, cam: CameraName, world: SimWorld | None) -> FrameGrabber:
    driver = config.camera(cam).driver
    if driver == "sim" and world is not None:
        columns, rows = config.camera(cam).image_size_px
        # a view is rendered when it is first asked for; the watchdog must not take that for death
        return SimFrameGrabber(world, cam, latency_s=max(30.0, _RENDER_S_PER_PIXEL * columns * rows))
    raise CameraError(
        f"There is no camera driver {driver!r} in this version.",
        code="unknown_driver",
        remedy="Use a simulated rig.",
        camera=cam,
    )
