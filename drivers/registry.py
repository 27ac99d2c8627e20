"""Drivers by the names that rig files use; camera drivers are imported when they are asked for."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

from core.errors import CameraError, StageError
from drivers.cameras.protocol import CameraOptions, FoundDevice, FrameGrabber
from drivers.stages.esp301 import ESP301Stage
from drivers.stages.protocol import AxisOptions
from drivers.stages.serial_line import FlowControl
from drivers.stages.serial_stage import SerialStage
from drivers.stages.smc100 import ConexCCStage, SMC100Stage

STAGE_DRIVERS: dict[str, Callable[..., SerialStage]] = {
    "conex-cc": ConexCCStage,
    "esp301": ESP301Stage,
    "smc100": SMC100Stage,
}

#: driver -> module that has ``make(options) -> FrameGrabber`` and ``discover() -> list[FoundDevice]``
CAMERA_DRIVERS: dict[str, str] = {"aravis": "drivers.cameras.aravis", "v4l2": "drivers.cameras.v4l2"}


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


def _camera_driver(driver: str) -> ModuleType:
    if driver not in CAMERA_DRIVERS:
        raise CameraError(
            f"There is no camera driver {driver!r}, only {', '.join(sorted(CAMERA_DRIVERS)) or 'the simulated one'}.",
            code="unknown_driver",
            remedy="Correct driver in the rig file's [cam1] or [cam2].",
        )
    return importlib.import_module(CAMERA_DRIVERS[driver])


def open_stage(
    driver: str,
    url: str,
    options: Mapping[int, AxisOptions],
    *,
    baudrate: int | None = None,
    flow_control: FlowControl | None = None,
    record: Path | None = None,
    timeout_s: float = 0.5,
) -> SerialStage:
    """Make a stage by the name of its driver and open it.

    Parameters
    ----------
    driver
        A key of `STAGE_DRIVERS`.
    url
        Serial URL as pyserial takes it.
    options
        Axis number -> how it is used; for the SMC100 family the axis number is the address on the chain.
    baudrate
        For true serial ports where it is not the driver's usual one (ESP301's USB 921600, SMC100 57600, CONEX-CC
        921600).
    flow_control
        Likewise (ESP301 ``hardware``, SMC100 and CONEX-CC ``software``).
    record
        File for a transcript of the wire.
    timeout_s
        Longest time of a reply.

    Raises
    ------
    StageError
        ``unknown_driver``, or an error of opening.
    """
    if driver not in STAGE_DRIVERS:
        raise StageError(
            f"There is no stage driver {driver!r}, only {', '.join(sorted(STAGE_DRIVERS))}.",
            code="unknown_driver",
            remedy="Correct [stage] driver in the rig file.",
        )
    given = {"baudrate": baudrate, "flow_control": flow_control}
    extra = {name: value for name, value in given.items() if value is not None}
    stage = STAGE_DRIVERS[driver](url, options, record=record, timeout_s=timeout_s, **extra)
    stage.open()
    return stage
