"""Stage drivers by the names that rig files use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from core.errors import StageError
from drivers.esp301 import ESP301Stage
from drivers.motion import SerialStage
from drivers.smc100 import SMC100Stage
from drivers.stage import AxisOptions

STAGE_DRIVERS: dict[str, Callable[..., SerialStage]] = {"esp301": ESP301Stage, "smc100": SMC100Stage}


def open_stage(
    driver: str,
    url: str,
    options: Mapping[int, AxisOptions],
    *,
    baudrate: int | None = None,
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
        For true serial ports where it is not the driver's usual one (ESP301's USB 921600, SMC100 57600).
    record
        File for a transcript of the wire.
    timeout_s
        How long a reply may take.

    Raises
    ------
    StageError
        ``unknown_driver``, or what opening brings up.
    """
    if driver not in STAGE_DRIVERS:
        raise StageError(
            f"There is no stage driver {driver!r}, only {', '.join(sorted(STAGE_DRIVERS))}.",
            code="unknown_driver",
            remedy="Correct [stage] driver in the rig file.",
        )
    extra = {} if baudrate is None else {"baudrate": baudrate}
    stage = STAGE_DRIVERS[driver](url, options, record=record, timeout_s=timeout_s, **extra)
    stage.open()
    return stage
