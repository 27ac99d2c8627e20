"""A load frame's record: a table of readings over time, as its program writes it (CSV)."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, tzinfo
from typing import Any

import numpy as np

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.server.formats.load_frames.description import RecordOptions, RecordRead
from stereorig.server.formats.load_frames.layout import decoded, find_table, lines_of, unreadable
from stereorig.server.formats.load_frames.reading import Reader

#: first bytes of files that people take for tables
_NO_TEXT = {
    b"PK\3\4": "a workbook (xlsx, ods) or an archive",
    b"\xd0\xcf\x11\xe0": "a workbook (xls)",
    b"TDSm": "a TDMS file",
    b"%PDF": "a PDF",
}


@dataclass(frozen=True, eq=False)
class ChannelTable:
    """Readings over time.

    Attributes
    ----------
    time_s
        (n,) rising, seconds: since the epoch if ``absolute``, else of the record's own clock.
    absolute
        True if the times are calendar times.
    channels
        Values (n,) by channel name; NaN at times without a reading.
    units
        Unit by channel name, as the file states it; ``1`` for none.
    unread
        By channel name, times of cells that are no numbers and of rows that could not be read; ascending, seconds.
    """

    time_s: Float
    absolute: bool
    channels: dict[str, Float]
    units: dict[str, str] = field(default_factory=dict)
    unread: dict[str, Float] = field(default_factory=dict)

    def at(self, time_s: float, max_gap_s: float) -> dict[str, float]:
        """Return each channel at a time, on the straight line between the readings before and after.

        Parameters
        ----------
        max_gap_s
            A channel is left out if its readings before and after are farther apart than this; also outside the record
            and around a cell that could not be read.
        """
        found = {}
        for name, values in self.channels.items():
            there = np.isfinite(values)
            times = self.time_s[there]
            after = int(np.searchsorted(times, time_s))
            if after < times.size and times[after] == time_s:
                found[name] = float(values[there][after])
            elif 0 < after < times.size and times[after] - times[after - 1] <= max_gap_s:
                if self.is_unread(name, time_s):
                    continue
                found[name] = float(np.interp(time_s, times, values[there]))
        return found

    def is_unread(self, name: str, time_s: float) -> bool:
        """Return True if a cell of a channel, between its readings around a time, could not be read."""
        times, unread = self.time_s[np.isfinite(self.channels[name])], self.unread.get(name, np.empty(0))
        after = int(np.searchsorted(times, time_s))
        before_s = times[after - 1] if after else -np.inf
        after_s = times[after] if after < times.size else np.inf
        return bool(np.searchsorted(unread, after_s, "right") > np.searchsorted(unread, before_s, "left"))

    @property
    def interval_s(self) -> float:
        """Median time between readings."""
        return float(np.median(np.diff(self.time_s)))


def read_record(
    content: bytes, options: RecordOptions | None = None, *, zone: tzinfo = UTC
) -> tuple[ChannelTable | None, RecordRead]:
    """Read a record; return its readings and its description.

    Tabs, semicolons or commas separate the cells, which may be quoted; a unit is in brackets after a title, after
    a slash, or in a row below the titles. Lines that are no readings are left out and counted.

    Parameters
    ----------
    content
        The file, UTF-8, UTF-16 or of a code page.
    zone
        Time zone of calendar times that state none.

    Returns
    -------
    table
        None if no column of times is sure; provisional if something else is open.
    read
        Recognised columns, lines left out, doubts, and open questions.

    Raises
    ------
    FileFormatError
        ``channels_unreadable``: no table of numbers, no titles, times that do not rise.
    InputError
        ``channels_unreadable``: no column of that title, no such segment.
    """
    kind = next((kind for begin, kind in _NO_TEXT.items() if content.startswith(begin)), None)
    if kind is not None:
        raise unreadable(f"The file is {kind}, not a text.", "Open it in its program and save the table as CSV.")
    text, encoding = decoded(content)
    lines = lines_of(text)
    made, read = Reader(lines, find_table(lines), options or RecordOptions(), zone).read(encoding)
    return None if made is None else ChannelTable(*made), read


def read_channel_table(content: bytes, *, zone: tzinfo = UTC, **options: Any) -> ChannelTable:
    """Read a record that leaves nothing open.

    Parameters
    ----------
    options
        Fields of `RecordOptions`.

    Raises
    ------
    FileFormatError, InputError
        As :func:`read_record` and :func:`require_answers`.
    """
    return require_answers(*read_record(content, RecordOptions(**options), zone=zone))


def require_answers(table: ChannelTable | None, read: RecordRead) -> ChannelTable:
    """Return the table of a record that leaves nothing open.

    Raises
    ------
    InputError
        ``channels_unreadable`` without a column of times, else ``channels_unsure``; the remedy names the option.
    """
    for question in read.questions:
        choices = ", ".join(map(repr, question.choices[:20]))
        raise InputError(
            f"The file leaves {question.option} open: {question.cause}",
            code="channels_unreadable" if question.option == "time_column" else "channels_unsure",
            remedy=f"Give {question.option} (--{question.option.replace('_', '-')}), one of {choices}.",
        )
    assert table is not None
    return table
