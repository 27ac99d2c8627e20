"""Calibrations and records of channels that a client sent, read behind walls."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any, BinaryIO

import numpy as np
from pydantic import ValidationError

from stereorig.server.base.json_values import without_nan
from stereorig.server.cell.cell import Cell, require
from stereorig.server.cell.sandbox import ReadingLimits
from stereorig.server.formats.calibrations.programs.plausibility import check_calibration
from stereorig.server.formats.calibrations.recognise import imported_content, parse_calibration
from stereorig.server.formats.channel_table import ChannelTable, read_record, require_answers
from stereorig.server.formats.load_frames.description import RecordOptions, RecordRead

#: a cell of a table takes two bytes of the file, and 32 while it is read
_TABLE_FACTOR = 16
_LEAST_BYTES = 512 << 20


def calibration(cell: Cell, content: bytes, *, unit: str | None = None) -> tuple[dict[str, object], dict[str, object]]:
    """Read a calibration's file; return the ``calibration.json`` that carries it, and the findings of its check.

    Raises
    ------
    FileFormatError, CalibrationInputError, InputError
        As :func:`stereorig.server.formats.calibrations.recognise.parse_calibration`.
    FileFormatError, TooLargeError, QueueFullError
        As `Cell.read`.
    """
    found, checked = cell.read(_calibration, [content], unit, limits=ReadingLimits(memory_bytes=_LEAST_BYTES))
    require(isinstance(found, dict) and isinstance(checked, dict), "the file")
    return found, checked


def channels(cell: Cell, content: bytes, **options: Any) -> ChannelTable:
    """Read a load frame's record that leaves nothing open; see :func:`record`."""
    return require_answers(*record(cell, content, **options))


def record(cell: Cell, content: bytes, **options: Any) -> tuple[ChannelTable | None, RecordRead]:
    """Read a load frame's record, see :func:`stereorig.server.formats.channel_table.read_record`.

    Parameters
    ----------
    options
        Fields of `RecordOptions`.

    Raises
    ------
    FileFormatError, InputError
        As there.
    FileFormatError, TooLargeError, QueueFullError
        As `Cell.read`.
    """
    limits = ReadingLimits(memory_bytes=_LEAST_BYTES + _TABLE_FACTOR * len(content))
    made, described = cell.read(_channels, [content], options, of="the record", limits=limits)
    try:
        read = RecordRead.model_validate(described)
    except ValidationError:
        read = None
    require(read is not None, "the record")
    assert read is not None
    if made is None:
        return None, read
    time_s, absolute, values, units, unread = made
    for one in (time_s, *values.values()):
        require(one.dtype == np.float64 and one.shape == time_s.shape and one.ndim == 1, "the record")
    require(all(one.dtype == np.float64 and one.ndim == 1 for one in unread.values()), "the record")
    require(units.keys() == values.keys() and all(isinstance(unit, str) for unit in units.values()), "the record")
    return ChannelTable(time_s, bool(absolute), values, units, unread), read


def warm_up() -> None:
    """Load the part of scipy that the readers load with their first file only."""
    import scipy.spatial.transform  # noqa: F401


def _calibration(files: list[BinaryIO], unit: str | None) -> tuple[dict[str, object], dict[str, Any]]:
    data, name = files[0].read(), "The file"
    checked = asdict(check_calibration(parse_calibration(data, name=name, unit=unit)))
    return imported_content(data, name=name, unit=unit), without_nan(checked)


def _channels(files: list[BinaryIO], options: dict[str, Any]) -> tuple[object, ...]:
    table, read = read_record(files[0].read(), RecordOptions(**options))
    made = None if table is None else [getattr(table, one.name) for one in fields(table)]
    return made, read.model_dump()
