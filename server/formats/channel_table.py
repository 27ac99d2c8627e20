"""A load frame's record: a table of readings over time, as its program writes it (CSV)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo

import numpy as np

from core.arrays import Float
from core.errors import FileFormatError, InputError
from server.formats.channel_units import channel_name

#: largest number of readings; an hour at 200 Hz
MAX_ROWS = 1_000_000
_MAX_COLUMNS = 50
_TIMES = (
    "time",
    "t",
    "timestamp",
    "datetime",
    "date_time",
    "zeit",
    "elapsed",
    "elapsed_time",
    "total_time",
    "run_time",
)
_SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
_TITLE = re.compile(r"^(?P<name>.*?)\s*[\[(/]\s*(?P<unit>[^\])]*?)\s*[\])]?$")
_COMMA_NUMBER = re.compile(r"^[-+]?\d+,\d+([eE][-+]?\d+)?$")
_TRIED = ("\t", ";", ",")


@dataclass(frozen=True, eq=False)
class ChannelTable:
    """Readings over time.

    Attributes
    ----------
    time_s
        (n,) rising, seconds: since the epoch where ``absolute``, else of the record's own clock.
    absolute
        Whether the times are of the calendar.
    channels
        By name, unit at its end, (n,); NaN where there was no reading.
    """

    time_s: Float
    absolute: bool
    channels: dict[str, Float]

    def at(self, time_s: float, max_gap_s: float) -> dict[str, float]:
        """Return each channel at a time, on the straight line between the readings before and after.

        Parameters
        ----------
        max_gap_s
            Readings further apart say nothing of what was between them: the channel is left out then, as it is outside
            the record.
        """
        found = {}
        for name, values in self.channels.items():
            there = np.isfinite(values)
            times = self.time_s[there]
            after = int(np.searchsorted(times, time_s))
            if after < times.size and times[after] == time_s:
                found[name] = float(values[there][after])
            elif 0 < after < times.size and times[after] - times[after - 1] <= max_gap_s:
                found[name] = float(np.interp(time_s, times, values[there]))
        return found

    @property
    def interval_s(self) -> float:
        """Median time between readings."""
        return float(np.median(np.diff(self.time_s)))


def read_channel_table(content: bytes, *, time_column: str | None = None, zone: tzinfo = UTC) -> ChannelTable:
    """Read a record.

    Columns are parted by tabs, semicolons or commas; a unit stands in brackets behind a title, behind a slash, or in a
    row below the titles. Lines above the titles are left out, and columns of text.

    Parameters
    ----------
    content
        The file, UTF-8 or Latin-1.
    time_column
        Title of the time's column; left out, the first one whose title says so.
    zone
        Of times of the calendar that state none.

    Raises
    ------
    FileFormatError
        ``channels_unreadable``: no table of numbers, no column of times, times that do not rise.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    rows, titles, units = _table(lines)
    names = [channel_name(title, unit) for title, unit in zip(titles, units, strict=True)]
    at = _time_column(titles, units, time_column)
    time_s, absolute = _times([row[at] for row in rows], units[at], titles[at], zone)
    channels: dict[str, Float] = {}
    for k, name in enumerate(names):
        if k == at:
            continue
        values = np.array([_number(row[k]) for row in rows])
        if np.isfinite(values).any():
            channels[name if name not in channels else f"{name}_{k + 1}"] = values
    if not channels:
        raise _unreadable("The table has no column of numbers beside its times.")
    if len(channels) > _MAX_COLUMNS:
        raise _unreadable(f"The table has {len(channels)} columns of numbers, {_MAX_COLUMNS} are taken.")
    order = np.argsort(time_s, kind="stable")
    time_s = time_s[order]
    if time_s.size < 2 or not (np.diff(time_s) > 0).any():
        raise _unreadable(f"The times in {titles[at]!r} do not rise.")
    keep = np.r_[True, np.diff(time_s) > 0]  # of readings at one time the first
    return ChannelTable(time_s[keep], absolute, {name: values[order][keep] for name, values in channels.items()})


def _unreadable(cause: str) -> FileFormatError:
    return FileFormatError(
        cause,
        code="channels_unreadable",
        remedy="Give a table with a row of titles and a column of times, as in 'time_s,force_kn'.",
    )


def _cells(line: str, mark: str) -> list[str]:
    return [cell.strip().strip('"').strip() for cell in line.split(mark)]


def _table(lines: list[str]) -> tuple[list[list[str]], list[str], list[str]]:
    """Return rows, titles and units; the mark that parts the cells is the one that makes most rows of numbers."""
    best: tuple[int, list[list[str]], int] = (0, [], 0)
    for mark in _TRIED:
        rows = [_cells(line, mark) for line in lines]
        begin = next((k for k, row in enumerate(rows) if len(row) > 1 and _is_data(row)), None)
        if begin is None:
            continue
        width = len(rows[begin])
        held = [row for row in rows[begin:] if len(row) == width]
        if len(held) > best[0]:
            best = (len(held), rows, begin)
    count, rows, begin = best
    if not count:
        raise _unreadable("There is no table of numbers in the file.")
    if count > MAX_ROWS:
        raise _unreadable(f"The table has {count} rows, {MAX_ROWS} are taken.")
    width = len(rows[begin])
    above = [row for row in rows[:begin] if len(row) == width]
    if not above:
        raise _unreadable("The table has no row of titles.")
    titles, below = above[-1], [""] * width
    if len(above) > 1 and all(len(cell) <= 12 for cell in titles) and _are_units(titles):
        titles, below = above[-2], [cell.strip("[]()") for cell in above[-1]]
    named, units = [], []
    for title, unit in zip(titles, below, strict=True):
        match = _TITLE.match(title)
        named.append((match["name"] if match and not unit else title).strip() or "channel")
        units.append((match["unit"] if match and not unit else unit).strip())
    return [row for row in rows[begin:] if len(row) == width], named, units


def _are_units(cells: list[str]) -> bool:
    bracketed = [cell for cell in cells if cell[:1] in "([" and cell]
    known = [cell for cell in cells if cell.lower() in {*_SECONDS, "n", "kn", "mm", "mpa", "kpa", "v", "%", "°c", "c"}]
    return len(bracketed) + len(known) >= max(1, len(cells) // 2)


def _is_data(row: list[str]) -> bool:
    numbers = sum(np.isfinite(_number(cell)) for cell in row)
    return numbers >= max(1, len([c for c in row if c]) // 2) or (numbers >= 1 and _moment(row[0]) is not None)


def _number(cell: str) -> float:
    if _COMMA_NUMBER.match(cell):
        cell = cell.replace(",", ".")
    try:
        return float(cell)
    except ValueError:
        return np.nan


def _moment(cell: str) -> datetime | None:
    try:
        return datetime.fromisoformat(cell)
    except ValueError:
        return None


def _time_column(titles: list[str], units: list[str], wanted: str | None) -> int:
    names = [channel_name(title) for title in titles]
    if wanted is not None:
        sought = {wanted, channel_name(wanted)}
        found = [
            k
            for k, (title, name) in enumerate(zip(titles, names, strict=True))
            if {title, name, channel_name(title, units[k])} & sought
        ]
        if not found:
            raise InputError(
                f"The table has no column {wanted!r}; it has {', '.join(titles)}.",
                code="channels_unreadable",
                remedy="Name one of these.",
            )
        return found[0]
    for k, name in enumerate(names):
        if name in _TIMES or name.removesuffix("_s") in _TIMES or name.removesuffix("_utc") in _TIMES:
            return k
    raise _unreadable(f"No column's title says that it holds times: {', '.join(titles)}.")


def _times(cells: list[str], unit: str, title: str, zone: tzinfo) -> tuple[Float, bool]:
    moments = [_moment(cell) for cell in cells] if not np.isfinite(_number(cells[0])) else []
    if moments and all(moment is not None for moment in moments):
        known = [m if m.tzinfo is not None else m.replace(tzinfo=zone) for m in moments if m is not None]
        return np.array([m.timestamp() for m in known]), True
    factor = _SECONDS.get(unit.lower())
    times = np.array([_number(cell) for cell in cells])
    if factor is None or not np.isfinite(times).all():
        raise _unreadable(
            f"The times in {title!r} are neither numbers of seconds nor dates as in 2026-03-01T12:00:00Z."
        )
    return times * factor, False
