"""Readings out of the cells of a record's table: its clock, its segments, its channels, its doubtful cells."""

from __future__ import annotations

import itertools
from collections import Counter
from datetime import UTC, tzinfo

import numpy as np
from numpy.typing import NDArray

from stereorig.core.arrays import Float
from stereorig.core.errors import InputError
from stereorig.server.formats.channel_units import TIME_S, channel_name, stated_unit, unit_of
from stereorig.server.formats.load_frames.description import (
    MOST_SHOWN,
    RecordColumn,
    RecordLine,
    RecordOptions,
    RecordQuestion,
    RecordRead,
    RecordSegment,
    shown,
)
from stereorig.server.formats.load_frames.layout import Table, is_loose, unreadable
from stereorig.server.formats.load_frames.numbers import decimals, read_cells
from stereorig.server.formats.load_frames.times import clock_times, dates, past_midnight, titled_times

_MAX_COLUMNS = 50
_MOST_SEGMENTS = 100
_MOST_FOOTER = 5  # rows of a footer
_FAR = 20.0  # steps of the clock, the longest before it, from which on a last row may be a footer's
#: seconds since 1904 are less; days of a spreadsheet since 1900 are more from 1982 on
_MOST_S, _SHEET_DAYS = 1e10, 30_000
Index = NDArray[np.intp]
#: times, whether they are of the calendar, channels, units, times of cells that could not be read
Made = tuple[Float, bool, dict[str, Float], dict[str, str], dict[str, Float]]


class Reader:
    """Makes readings of a table's cells; notes doubts and open questions."""

    def __init__(self, lines: dict[int, str], table: Table, options: RecordOptions, zone: tzinfo) -> None:
        self._lines, self._table, self._options, self._zone = lines, table, options, zone
        self._numbers = np.array(table.numbers)
        self._columns: list[tuple[str, ...]] = list(zip(*table.rows, strict=True))
        self._doubts = list(table.doubts)
        self._questions: list[RecordQuestion] = []
        measured = {k: self._columns[k] for k in table.measured}
        marks, question = decimals(measured, table.titles, options.decimal, table.separator)
        self._ask(question)
        self._cells = {k: read_cells(cells, marks[k]) for k, cells in measured.items()}
        self._marks = marks
        self._date: int | None = None

    def read(self, encoding: str) -> tuple[Made | None, RecordRead]:
        """Return the readings, None without a clock, and the description of the record."""
        at = self._time_column()
        clock = None if at is None else self._times(at)
        channels = self._channels(at)
        kept, made = np.arange(self._numbers.size), None
        segments: list[RecordSegment] = []
        if at is not None and clock is not None:
            time_s, absolute = clock
            kept = self._readings(time_s, channels)
            segments, chosen = self._segments(time_s, kept)
            made = self._made(self._table.titles[at], time_s, absolute, kept, chosen, channels)
        lines = self._numbers[kept]
        left = sorted({*self._table.left, *self._numbers.tolist()} - {*lines.tolist()})
        ends = (0, lines.min(), lines.max(), np.inf)
        parts = [[n for n in left if low <= n < high] for low, high in itertools.pairwise(ends)]
        return made, RecordRead(
            encoding=encoding,
            separator=self._table.separator,
            titles_line=self._table.titles_line,
            columns=[self._described(k, at, channels, kept) for k in range(len(self._columns))],
            left_above=len(parts[0]),
            left_between=len(parts[1]),
            left_below=len(parts[2]),
            left_lines=[RecordLine(line=n, text=shown(self._lines[n])) for part in parts for n in part[:MOST_SHOWN]],
            segments=segments[:_MOST_SEGMENTS],
            doubts=self._doubts,
            questions=self._questions,
        )

    def _ask(self, question: RecordQuestion | None) -> None:
        if question is not None:
            self._questions.append(question)

    # the clock ------------------------------------------------------------------------------------------------------

    def _time_column(self) -> int | None:
        titles = self._table.titles
        if self._options.time_column is not None:
            found, said = self._named(self._options.time_column), True
        else:
            exact, partly = titled_times(titles, self._table.units)
            found, said = exact or partly, bool(exact or partly)
            if not said:
                found = [k for k in self._table.measured if self._unit(k) in TIME_S or self._is_dates(k)]
        if not said or (len(found) > 1 and self._options.time_column is None):
            found = [k for k in found if self._never_falls(k)] or (found if said else [])
        if len(found) == 1:
            return found[0]
        some = found or list(range(len(titles)))
        cause = f"{len(found)} columns may hold the times" if found else "No column's title names times"
        self._ask(
            RecordQuestion(
                option="time_column",
                cause=f"{cause}: {shown(', '.join(titles[k] for k in some), 500)}.",
                choices=[titles[k] if titles.count(titles[k]) == 1 else str(k + 1) for k in some],
            )
        )
        return None

    def _named(self, wanted: str) -> list[int]:
        titles, units = self._table.titles, self._table.units
        sought = {wanted, channel_name(wanted)}
        names = zip(titles, map(channel_name, titles), map(channel_name, titles, units), strict=True)
        found = [k for k, known in enumerate(names) if sought & {*known}]
        if not found and wanted in map(str, range(1, len(titles) + 1)):
            found = [int(wanted) - 1]
        if not found:
            raise InputError(
                f"The table has no column {wanted!r}; it has {', '.join(titles)}.",
                code="channels_unreadable",
                remedy="Name one of these.",
            )
        return found

    def _unit(self, k: int) -> str:
        return stated_unit(self._table.units[k]) or unit_of(channel_name(self._table.titles[k]))

    def _is_number(self, k: int) -> bool:
        cells = self._cells.get(k)
        numbers = 0 if cells is None else int(np.isfinite(cells.values).sum())
        return cells is not None and numbers > 0 and numbers >= len(cells.unread)

    def _is_dates(self, k: int) -> bool:
        held = [cell for cell in self._columns[k][:100] if cell][:MOST_SHOWN]
        return bool(held) and not self._is_number(k) and bool(np.isfinite(dates(held, "dmy", UTC)[0]).all())

    def _never_falls(self, k: int) -> bool:
        values = self._clock(k)[0]
        held = values[np.isfinite(values)]
        return held.size > 1 and bool((np.diff(held) >= 0).all())

    def _clock(self, k: int) -> tuple[Float, bool, RecordQuestion | None]:
        """Return a column's times, NaN for those that are none, and whether they are of the calendar."""
        cells, order = self._columns[k], self._options.date_order
        self._date = None
        if self._is_number(k):
            unit = self._unit(k)
            return TIME_S.get(unit, 1.0 if unit == "1" else np.nan) * self._cells[k].values, False, None
        clock = clock_times(cells, self._table.units[k])
        if 2 * np.isfinite(clock).sum() < len(cells):
            found, question = dates(cells, order, self._zone)
            return found, True, question
        days = [d for d in self._table.measured if d != k and ":" not in self._columns[d][0] and self._is_dates(d)]
        if len(days) != 1:
            return past_midnight(clock), False, None
        self._date = days[0]
        both = [f"{day} {cell}" for day, cell in zip(self._columns[days[0]], cells, strict=True)]
        found, question = dates(both, order, self._zone)
        return found, True, question

    def _times(self, at: int) -> tuple[Float, bool]:
        time_s, absolute, question = self._clock(at)
        self._ask(question)
        title, unit = self._table.titles[at], self._table.units[at]
        known = np.isfinite(time_s)
        if known.sum() < min(2, known.size):
            raise unreadable(
                f"The times in {title!r}{f' in {unit}' if unit else ''} are neither numbers of seconds nor dates as in "
                "2026-03-01T12:00:00Z."
            )
        if self._is_number(at) and self._unit(at) == "1":
            held = time_s[known]
            if held.max() > _MOST_S or (held.min() > _SHEET_DAYS and np.ptp(held) < 1 and held.max() < 2 * _SHEET_DAYS):
                raise unreadable(
                    f"The column {title!r} states no unit of time, and its numbers, {held.min():.12g} to "
                    f"{held.max():.12g}, are no seconds: milliseconds, days of a spreadsheet, or a date as one number?",
                    "Export the times in seconds, with their unit in the title, or as dates.",
                )
            self._doubts.append(f"The column {title!r} states no unit of time: seconds are taken.")
        return time_s, absolute

    # the readings ---------------------------------------------------------------------------------------------------

    def _readings(self, time_s: Float, channels: dict[str, int]) -> Index:
        """Return the rows that are readings: those with a time, and without a footer's statistics."""
        known = np.isfinite(time_s)
        rows = sorted({row for k in channels.values() for row in self._cells[k].unread if known[row]}, reverse=True)
        last = int(np.flatnonzero(known)[-1])
        counts: dict[int, Counter[str]] = {}
        for row in rows:
            k = next(k for k, column in enumerate(self._columns) if column[row])
            word = self._columns[k][row]
            if is_loose(word):
                continue
            before = row - 1
            while before >= 0 and not known[before]:
                before -= 1
            if row == last and k not in counts:
                counts[k] = Counter(self._columns[k])
            # a word such as Maximum is there once, a sensor's overflow again and again
            if (before >= 0 and time_s[row] <= time_s[before]) or (row == last and counts[k][word] == 1):
                known[row] = False
                last = before if row == last else last
        timeless = np.flatnonzero(~np.isfinite(time_s))
        if timeless.size:
            first = f"line {self._numbers[timeless[0]]}: {shown(self._lines[self._numbers[timeless[0]]])!r}"
            self._doubts.append(f"Rows left out because their time cannot be read: {timeless.size} ({first}).")
        return np.flatnonzero(known)

    def _segments(self, time_s: Float, kept: Index) -> tuple[list[RecordSegment], Index]:
        """Return the readings between restarts of the clock, and the rows of the chosen ones."""
        falls = np.diff(time_s[kept]) < 0
        if falls.sum() > 1 and not (np.diff(time_s[kept]) > 0).any():
            self._doubts.append("The times fall throughout: the rows are taken from the last to the first.")
            kept, falls = kept[::-1], falls & False
        footer = self._footer(time_s, kept[np.flatnonzero(np.r_[True, falls])[-1] :])
        whole = bool(footer) and not falls.any()
        if footer:
            falls[-footer] = True
        parts = np.split(kept, np.flatnonzero(falls) + 1)
        segments = [
            RecordSegment(
                first_line=int(self._numbers[part[0]]),
                last_line=int(self._numbers[part[-1]]),
                readings=int(part.size),
                from_s=float(time_s[part[0]]),
                to_s=float(time_s[part[-1]]),
            )
            for part in parts
        ]
        wanted = self._options.segment
        if wanted == 0 and whole:
            return segments, kept
        if wanted is not None and not 0 < wanted <= len(parts):
            raise InputError(
                f"There is no segment {wanted}; the record has {len(parts)}.",
                code="channels_unreadable",
                remedy="Name one of these.",
            )
        if wanted is None and len(parts) > 1:
            named = "; ".join(
                f"{n}: lines {one.first_line} to {one.last_line}, {one.from_s:.12g} to {one.to_s:.12g} s"
                for n, one in enumerate(segments[:MOST_SHOWN], 1)
            )
            more = ", ..." if len(parts) > MOST_SHOWN else ""
            why = "its clock falls back"
            if footer:
                why = f"the rows from line {segments[-1].first_line} on may be a footer's{', or readings: 0' * whole}"
            cause = f"The record has {len(parts)} segments, since {why} ({named}{more})."
            choices = [str(n) for n in range(1, min(len(parts), _MOST_SEGMENTS) + 1)] + ["0"] * whole
            self._ask(RecordQuestion(option="segment", cause=cause, choices=choices))
        return segments, parts[(wanted or 1) - 1]

    def _footer(self, time_s: Float, rows: Index) -> int:
        """Return how many of the last rows may be a footer's numbers rather than readings."""
        cells = [one.values for one in self._cells.values()]
        for count in range(1, min(_MOST_FOOTER, rows.size - 2) + 1):
            first, before = rows[-count], rows[:-count]
            lines, steps = self._numbers[before], np.diff(time_s[before])
            blank = self._lines.keys().isdisjoint(range(lines[-1] + 1, self._numbers[first]))
            after = self._numbers[first] - lines[-1] > max(1, np.abs(np.diff(lines)).max()) and blank
            far = steps.size > 2 and time_s[first] - time_s[before[-1]] > _FAR * steps.max() > 0
            counted = len(cells) > 1 and {one[first] for one in cells} == {before.size}
            if after or far or (count == 1 and counted):
                return count
        return 0

    def _channels(self, at: int | None) -> dict[str, int]:
        """Return the columns of numbers by their channels' names."""
        found: dict[str, int] = {}
        for k in self._cells:
            if k not in (at, self._date) and self._is_number(k):
                name = channel_name(self._table.titles[k], self._table.units[k])
                found[name if name not in found else f"{name}_{k + 1}"] = k
        if not found:
            raise unreadable("The table has no column of numbers but its times.")
        if len(found) > _MAX_COLUMNS:
            raise unreadable(f"The table has {len(found)} columns of numbers, {_MAX_COLUMNS} are taken.")
        return found

    def _made(
        self, title: str, time_s: Float, absolute: bool, kept: Index, chosen: Index, channels: dict[str, int]
    ) -> Made:
        times = time_s[chosen]
        first = np.r_[True, np.diff(times) > 0]
        if not self._questions and first.sum() < 2:
            raise unreadable(f"The times in {title!r} do not rise.")
        if not first.all():
            self._doubts.append(f"Readings left out because they have the time of the one before: {np.sum(~first)}.")
        rows = chosen[first]
        # rows within the table that could not be read: no channel has a value between the readings around one
        lost = np.union1d(self._table.odd, np.setdiff1d(self._numbers, self._numbers[kept]))
        order = np.argsort(self._numbers[rows])
        after = np.searchsorted(self._numbers[rows][order], lost)
        after = after[(after > 0) & (after < rows.size)]
        between = (times[first][order][after] + times[first][order][after - 1]) / 2
        held = np.zeros(time_s.size, bool)
        held[rows] = True
        unread = {}
        for name, k in channels.items():
            own = [row for row in self._cells[k].unread if held[row]]
            unread[name] = np.sort(np.r_[time_s[own], between])
        values = {name: self._cells[k].values[rows] for name, k in channels.items()}
        return times[first], absolute, values, {name: self._unit(k) for name, k in channels.items()}, unread

    # the recognised parts, for the user ------------------------------------------------------------------------------

    def _described(self, k: int, at: int | None, channels: dict[str, int], kept: Index) -> RecordColumn:
        title, cells = self._table.titles[k], self._cells.get(k)
        name = next((name for name, column in channels.items() if column == k), None)
        is_kept = np.zeros(self._numbers.size, bool)
        is_kept[kept] = True
        parts = (cells.unread, cells.stated) if cells is not None and name else ([], [])
        unread, stated = ([row for row in part if is_kept[row]] for part in parts)
        for rows, are in ((unread, "are neither empty nor numbers"), (stated, "state that there was no reading")):
            if rows:
                first = f"{self._columns[k][rows[0]][:40]!r} in line {self._numbers[rows[0]]}"
                self._doubts.append(f"Cells of {title!r} that {are}: {len(rows)} ({first}).")
        example = next((cell for cell in self._columns[k] if cell), "")
        numbers = int(np.isfinite(cells.values[kept]).sum()) if cells is not None else 0
        stray = 0 if name or k in (at, self._date) else sum(map(is_loose, self._columns[k]))
        if stray:
            held = sum(map(bool, self._columns[k]))
            self._doubts.append(
                f"The column {title!r} is left out: {stray} of its {held} cells may be numbers or dates."
            )
        kinds = {at: "time", self._date: "date"}
        return RecordColumn(
            title=title,
            unit=self._unit(k),
            kind=kinds.get(k, "numbers" if name else "text" if example else "empty"),
            name=name,
            decimal=next((mark for mark in self._marks.get(k, "") if any(mark in c for c in self._columns[k])), None),
            numbers=numbers,
            empty=len(kept) - numbers - len(unread) if cells is not None else 0,
            unread=len(unread),
            example=shown(example),
        )
