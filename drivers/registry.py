"""Drivers by the names that rig files use; camera drivers are imported when they are asked for."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from stereorig.core.errors import CameraError, StageError
from stereorig.drivers.cameras.genicam.table import Feature
from stereorig.drivers.cameras.protocol import CameraOptions, FoundDevice, FrameGrabber
from stereorig.drivers.stages.makers.esp301 import ESP301Stage
from stereorig.drivers.stages.makers.kinesis import KinesisStage
from stereorig.drivers.stages.makers.pi import PIStage
from stereorig.drivers.stages.makers.smc100 import ConexCCStage, SMC100Stage
from stereorig.drivers.stages.makers.standa import StandaStage
from stereorig.drivers.stages.makers.xps import XPSStage
from stereorig.drivers.stages.makers.zaber import ZaberStage
from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.serial_line import FlowControl
from stereorig.drivers.stages.serial_stage import SerialStage

STAGE_DRIVERS: dict[str, Callable[..., SerialStage]] = {
    "conex-cc": ConexCCStage,
    "esp301": ESP301Stage,
    "kinesis": KinesisStage,
    "pi": PIStage,
    "smc100": SMC100Stage,
    "standa": StandaStage,
    "xps": XPSStage,
    "zaber": ZaberStage,
}

#: driver -> module that has ``make(options) -> FrameGrabber`` and ``discover() -> list[FoundDevice]``
CAMERA_DRIVERS: dict[str, str] = {
    "aravis": "stereorig.drivers.cameras.aravis",
    "pylon": "stereorig.drivers.cameras.pylon",
    "v4l2": "stereorig.drivers.cameras.v4l2",
}


def make_camera(driver: str, options: CameraOptions) -> FrameGrabber:
    """Make a camera by the name of its driver, not yet opened.

    Raises
    ------
    CameraError
        ``unknown_driver``; ``driver_missing`` when a library that the driver needs is not installed.
    """
    grabber: FrameGrabber = _camera_driver(driver).make(options)
    return grabber


def discover_cameras(driver: str) -> list[FoundDevice]:
    """List the cameras that one driver finds, also those that it cannot use; raises as `make_camera`."""
    found: list[FoundDevice] = _camera_driver(driver).discover()
    return found


def look_at_camera(name: str) -> tuple[dict[str, str], list[Feature]]:
    """Return maker, model, protocol and description of a GenICam camera, and its features, by Aravis or else by pylon.

    Raises
    ------
    CameraError
        ``camera_lost``, ``driver_missing`` of Aravis; ``camera_busy``.
    """
    missed: list[CameraError] = []
    for driver in ("aravis", "pylon"):
        try:
            found: tuple[dict[str, str], list[Feature]] = _camera_driver(driver).look(name)
            return found
        except CameraError as error:
            if error.code not in ("camera_lost", "driver_missing"):
                raise
            missed.append(error)
    raise missed[0]


def _camera_driver(driver: str) -> ModuleType:
    if driver not in CAMERA_DRIVERS:
        raise CameraError(
            f"There is no camera driver {driver!r}, only {', '.join(sorted(CAMERA_DRIVERS)) or 'the simulated one'}.",
            code="unknown_driver",
            remedy="Correct driver in the rig file's [cam1] or [cam2].",
        )
    return importlib.import_module(CAMERA_DRIVERS[driver])


def make_stage(
    driver: str,
    url: str,
    options: Mapping[int, AxisOptions],
    *,
    baudrate: int | None = None,
    flow_control: FlowControl | None = None,
    record: Path | None = None,
    timeout_s: float = 0.5,
    numbers: Mapping[int, int] | None = None,
) -> SerialStage:
    """Make a stage by the name of its driver, not yet opened.

    Parameters
    ----------
    driver
        A key of `STAGE_DRIVERS`.
    url
        Serial URL as pyserial takes it.
    options
        Axis number -> how it is used.
    baudrate
        For true serial ports that differ from the driver's usual one (ESP301's USB 921600, SMC100 57600, CONEX-CC
        921600).
    flow_control
        Likewise (ESP301 ``hardware``, SMC100 and CONEX-CC ``software``).
    record
        File for a transcript of the wire.
    timeout_s
        Longest time of a reply.
    numbers
        Axis number -> the controller's own, for the SMC100 family the address on the chain; the same if left out.

    Raises
    ------
    StageError
        ``unknown_driver``.
    """
    if driver not in STAGE_DRIVERS:
        raise StageError(
            f"There is no stage driver {driver!r}, only {', '.join(sorted(STAGE_DRIVERS))}.",
            code="unknown_driver",
            remedy="Correct [stage] driver in the rig file.",
        )
    given = {"baudrate": baudrate, "flow_control": flow_control}
    extra = {name: value for name, value in given.items() if value is not None}
    return STAGE_DRIVERS[driver](url, options, record=record, timeout_s=timeout_s, numbers=numbers, **extra)


def open_stage(driver: str, url: str, options: Mapping[int, AxisOptions], **settings: Any) -> SerialStage:
    """Make a stage and open it; parameters and errors as `make_stage`, and errors of opening."""
    stage = make_stage(driver, url, options, **settings)
    stage.open()
    return stage
