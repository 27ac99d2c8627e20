"""A stage on one serial line: common parts of the drivers that speak a controller's own language."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar

from stereorig.drivers.stages.protocol import AxisOptions
from stereorig.drivers.stages.serial_line import FlowControl, SerialLine
from stereorig.drivers.stages.serial_stage import SerialStage


class WireStage(SerialStage):
    """Base of the drivers of one serial line; a driver adds its line's parameters and its controller's commands.

    Parameters
    ----------
    url
        Any URL that pyserial opens.
    options
        Axis number -> how it is used; only the axes named here are touched.
    baudrate, flow_control
        For true serial ports, if they differ from the controller's own.
    record
        File for a transcript of the wire.
    timeout_s
        Longest time of a reply.
    numbers
        Axis number -> the controller's own number of it; the same if left out.
    """

    _line: SerialLine
    _line_class: ClassVar[type[SerialLine]] = SerialLine
    _terminator: ClassVar[bytes]
    _baudrate: ClassVar[int] = 115200
    _flow_control: ClassVar[FlowControl] = "none"
    _resync: ClassVar[tuple[str, Callable[[str], bool]] | None] = None

    def __init__(
        self,
        url: str,
        options: Mapping[int, AxisOptions],
        *,
        baudrate: int | None = None,
        flow_control: FlowControl | None = None,
        record: Path | None = None,
        timeout_s: float = 0.5,
        numbers: Mapping[int, int] | None = None,
    ) -> None:
        line = self._line_class(
            url,
            terminator=self._terminator,
            baudrate=self._baudrate if baudrate is None else baudrate,
            flow_control=self._flow_control if flow_control is None else flow_control,
            timeout_s=timeout_s,
            resync=self._resync,
            record=record,
        )
        super().__init__(line, options, numbers)


def finite(text: str) -> float:
    """Read a number that is finite; ValueError for all else."""
    if not re.fullmatch(r"[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?", text) or not math.isfinite(float(text)):
        raise ValueError("not a finite number")
    return float(text)


def flag(text: str) -> bool:
    """Read 0 or 1; ValueError for all else."""
    if text not in ("0", "1"):
        raise ValueError("neither 0 nor 1")
    return text == "1"
