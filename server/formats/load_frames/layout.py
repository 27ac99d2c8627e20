"""Layout of a load frame's record: encoding, cells, and the table among lines of a head and a footer."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from stereorig.core.errors import FileFormatError
from stereorig.server.formats.channel_units import MAX_LINE, MAX_TITLE, known_unit, titled_unit
from stereorig.server.formats.load_frames.description import shown
from stereorig.server.formats.load_frames.times import NATIVE_TIMES, is_format, titled_times

#: largest number of readings; an hour at 200 Hz
MAX_ROWS = 1_000_000
_BLANK = "  "  # two or more: one may be within a title
SEPARATORS = {"\t": "tab", ";": "semicolon", ",": "comma", "|": "bar", _BLANK: "blanks", " ": "blanks"}
#: tried where a text is not UTF-8: taken if the time is named in them
CODE_PAGES = ("cp932", "gb18030", "big5", "euc-kr", "cp1251")
_MOST_WIDE = 1000  # columns, read or not
_SAMPLE = 4000  # lines that the separator is chosen by
_BLANKS = " \u00a0\u2009\u202f"
# a number, a time or a date, in any notation
_LOOSE = re.compile(rf"[-+\u2212.,]{{0,2}}[0-9][-+\u2212.,'\u2019:/{_BLANKS}0-9eEdDTZ]*(?:[AaPp]\.?[Mm]\.?)?")
_BEGINS = frozenset("0123456789+-.,\u2212")
_DIGITS = frozenset("0123456789+-")
_OPEN = re.compile('(?:^|[\t;,]) *"[^"]*$')  # the quote of a cell that goes on in the next line
_MARKS = re.compile("[\t;,]")
_MOST_JOINED, _LONGEST_HEAD = 50, 1000  # lines
_THREE = re.compile("[0-9]{3}")


def unreadable(cause: str, remedy: str = "") -> FileFormatError:
    """Return the refusal of a file that is no record."""
    return FileFormatError(
        cause,
        code="channels_unreadable",
        remedy=remedy or "Give a table with a row of titles and a column of times, as in 'time_s,force_kn'.",
    )


def decoded(content: bytes) -> tuple[str, str]:
    """Return a file's text and the name of its encoding: UTF-8, UTF-16 with and without a mark, or a code page."""
    begin = content[:4096]
    for name, mark, parity in (("UTF-16 LE", b"\xff\xfe", 1), ("UTF-16 BE", b"\xfe\xff", 0)):
        zeros = begin[parity::2].count(0), begin[1 - parity :: 2].count(0)
        # separators, digits and line ends have a zero in each pair; no text in bytes has one
        if begin.startswith(mark) or zeros[0] > max(len(begin) // 8, 4 * zeros[1]):
            return content.decode(name.replace(" ", "-"), "replace").removeprefix("\ufeff"), name
    try:
        return content.decode("utf-8-sig"), "UTF-8"
    except UnicodeDecodeError:
        pass
    for name in CODE_PAGES:
        try:
            text = content.decode(name)
        except UnicodeDecodeError:
            continue
        if any(word in text.lower() for word in NATIVE_TIMES):
            return text, name
    try:
        return content.decode("cp1252"), "cp1252"
    except UnicodeDecodeError:
        return content.decode("latin-1"), "Latin-1"


@dataclass
class Table:
    """The table of a record.

    Attributes
    ----------
    rows, numbers
        Rows below its titles that may be readings, and their lines.
    left, odd
        Lines that are no titles, units or rows; those among them that hold numbers in another count of cells.
    titles, units, titles_line
        Titles and units of the columns, as written; line of the titles.
    measured
        Columns whose cells are numbers, times or dates, most of them.
    doubts
        Rows that were not taken.
    """

    separator: str
    rows: list[list[str]]
    numbers: list[int]
    titles: list[str]
    units: list[str]
    titles_line: int
    measured: list[int]
    left: list[int]
    odd: list[int] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


def lines_of(text: str) -> dict[int, str]:
    """Return the lines that are not blank, by their number from 1."""
    lines = _whole_titles({n: line for n, line in enumerate(text.splitlines(), 1) if line.strip()})
    if max(map(len, lines.values()), default=0) > MAX_LINE:
        raise unreadable(f"A line of the file has more than {MAX_LINE} characters.")
    return lines


def _whole_titles(lines: dict[int, str]) -> dict[int, str]:
    """Join the lines of quoted titles that have more than one line, as a spreadsheet writes them."""
    found = dict(lines)
    numbers = list(lines)[:_LONGEST_HEAD]
    for k, n in enumerate(numbers):
        if n not in found or _OPEN.search(lines[n]) is None:
            continue
        quotes = lines[n].count('"')
        for m in range(k + 1, min(k + _MOST_JOINED, len(numbers))):
            line = lines[numbers[m]]
            quotes += line.count('"')
            if any(cell.strip('" ')[:1] in _DIGITS for cell in _MARKS.split(line)):
                break  # a reading: the quote was an inch's mark
            if quotes % 2 == 0:
                found[n] = " ".join(found.pop(one) for one in numbers[k : m + 1])
                break
    return dict(sorted(found.items()))


def is_loose(cell: str) -> bool:
    """Return True for a cell that may be a number, a time or a date."""
    return cell[:1] in _BEGINS and _LOOSE.fullmatch(cell) is not None


def find_table(lines: dict[int, str]) -> Table:
    """Find the table: the separator that makes most cells numbers, and the titles with most such rows below them.

    Raises
    ------
    FileFormatError
        ``channels_unreadable``: no table of numbers, no titles, two tables, cells that commas part within a number.
    """
    mark, width = _separator(list(lines.values()))
    if width > _MOST_WIDE:
        raise unreadable(f"The table has {width} columns, {_MOST_WIDE} at most are read.")
    rows = dict(zip(lines, _rows(lines.values(), mark), strict=True))
    alike = [row for row in rows.values() if len(row) == width]
    if len(alike) > MAX_ROWS:
        raise unreadable(f"The table has {len(alike)} rows, {MAX_ROWS} are taken.")
    sample = [row for row in alike[:: len(alike) // _SAMPLE + 1] if _share(row) >= 0.5]
    held = [[cell for cell in column if cell] for column in zip(*sample, strict=True)]
    measured = [k for k, column in enumerate(held) if column and 2 * sum(map(is_loose, column)) >= len(column)]
    used = max(k for k, column in enumerate(held) if column) + 1
    parts = _parts(rows, width, used, measured)
    if mark == ",":
        _check_commas(parts, held, measured)
    if not parts:
        raise unreadable("The table has no row of titles.", _titles_remedy(rows, width, sample))
    return _joined(parts, lines, rows, mark, width, measured)


def _check_commas(parts: list[_Part], held: list[list[str]], measured: list[int]) -> None:
    """Refuse a table whose commas part its cells and may be within its numbers or titles too."""
    for part in parts:
        named = [title != "channel" for title in part.titles]
        thousands = any(all(_THREE.fullmatch(cell) for cell in held[k]) for k in measured[1:])
        units = [known_unit(title) is not None for title in part.titles]
        if (thousands and named[0] and not named[measured[-1]]) or (
            len(units) > 3 and units == [False, True] * (len(units) // 2)
        ):
            raise unreadable(
                f"The cells below line {part.titles_line} may be parts of numbers: commas part the cells, and "
                "numbers or titles may have commas too.",
                "Export it again with semicolons, tabs, or quotes about each cell.",
            )


def _rows(lines: Iterable[str], mark: str) -> list[list[str]]:
    if mark == _BLANK:
        return [re.split("  +", line.strip()) for line in lines]
    if mark == " ":
        lines = map(str.strip, lines)
    # a quote that is not closed, as an inch's mark, parts no cell and joins no lines
    closed = [line if line.count('"') % 2 == 0 else line.replace('"', "") for line in lines]
    try:
        rows = list(csv.reader(closed, delimiter=mark, skipinitialspace=True))
    except csv.Error:  # joined to more than a cell may have
        rows = []
    if len(rows) != len(closed):
        rows = [next(csv.reader([line], delimiter=mark, skipinitialspace=True)) for line in closed]
    return [[cell.strip() for cell in row] for row in rows]


def _share(row: Sequence[str]) -> float:
    held = [cell for cell in row if cell]
    return sum(map(is_loose, held)) / len(held) if held else 0.0


def _separator(lines: list[str]) -> tuple[str, int]:
    """Return the mark that parts the cells, and how many a row has."""
    best: tuple[float, str, int] = (0.0, "", 0)
    sample = lines[:: len(lines) // _SAMPLE + 1]
    for mark in SEPARATORS:
        found: dict[int, float] = {}
        for row in _rows(sample, mark):
            share = _share(row) if len(row) > 1 else 0.0
            if share >= 0.5:
                found[len(row)] = found.get(len(row), 0.0) + share
        if found:
            width, score = max(found.items(), key=lambda one: one[1])
            if score > best[0]:
                best = (score, mark, width)
    if not best[2]:
        raise unreadable("There is no table of numbers in the file.")
    return best[1], best[2]


@dataclass
class _Part:
    """Rows below one head of titles."""

    titles: list[str]
    units: list[str]
    titles_line: int
    head: list[int]
    rows: list[int] = field(default_factory=list)


def _parts(rows: dict[int, list[str]], width: int, used: int, measured: list[int]) -> list[_Part]:
    """Return the rows by the titles above them; trailing separators make no row another one."""
    parts: list[_Part] = []
    heads: list[int] = []
    for n, row in rows.items():
        if len(row) != width:
            kept = len(row)
            while kept and not row[kept - 1]:
                kept -= 1
            if kept != used:
                continue
            row = rows[n] = [*row[:kept], *[""] * (width - kept)]
        if any(row[k][:1] in _BEGINS and is_loose(row[k]) for k in measured):
            if heads and (part := _head(heads, rows, measured)) is not None:
                parts.append(part)
            heads = []
            if parts:
                parts[-1].rows.append(n)
        elif any(row[k] for k in measured):
            heads.append(n)
    return [part for part in parts if part.rows]


def _head(heads: list[int], rows: dict[int, list[str]], measured: list[int]) -> _Part | None:
    """Return titles and units of the rows without numbers above a table; a comment only if there is nothing else."""
    heads = [n for n in heads if not rows[n][0].startswith("#")] or heads
    below = next((k for k in range(len(heads) - 1, 0, -1) if _are_units([rows[heads[k]][m] for m in measured])), None)
    full = [n for n in heads[:below] if 2 * sum(bool(rows[n][k]) for k in measured) >= len(measured)]
    if not full:
        return None
    # a row below the titles may hold neither units nor numbers: sampling rates, sensors' numbers
    line = next((n for n in reversed(full) if any(titled_times(*_titled(rows[n])))), full[-1])
    if below is None and heads.index(line) and _are_units([rows[heads[heads.index(line) - 1]][m] for m in measured]):
        below = heads.index(line) - 1
    titles, units = [], []
    for k, title in enumerate(rows[line]):
        title = title.lstrip("# ") if k == 0 else title
        if len(title) > MAX_TITLE:
            raise unreadable(f"The title {title[:20]!r}... has {len(title)} characters, at most {MAX_TITLE} are read.")
        unit = "" if below is None else rows[heads[below]][k].strip("[]() ")
        title, unit = (title, unit) if unit else titled_unit(title)
        titles.append(title.strip() or "channel")
        units.append(unit)
    return _Part(titles, units, line, [line] if below is None else [line, heads[below]])


def _titled(row: list[str]) -> tuple[list[str], list[str]]:
    titles, units = zip(*map(titled_unit, row), strict=True)
    return list(titles), list(units)


def _are_units(cells: list[str]) -> bool:
    held = [cell for cell in cells if cell]
    known = [c for c in held if c[0] in "([" or known_unit(c) or is_format(c)]
    return all(len(cell) <= 16 for cell in held) and 2 * len(known) >= len(held)


def _joined(
    parts: list[_Part], lines: dict[int, str], rows: dict[int, list[str]], mark: str, width: int, measured: list[int]
) -> Table:
    """Return the parts below the titles that have most rows of numbers as one table."""
    clean = [sum(all(not rows[n][k] or is_loose(rows[n][k]) for k in measured) for n in part.rows) for part in parts]
    main = parts[max(range(len(parts)), key=clean.__getitem__)]
    alike = [p for p in parts if p.titles == main.titles and p.units in (main.units, [""] * width)]
    table = Table(SEPARATORS[mark], [], [], main.titles, main.units, alike[0].titles_line, measured, [])
    for part, count in zip(parts, clean, strict=True):
        if part in alike or not count:
            continue
        # a table of results has few rows
        if count > sum(clean) / 10 and (count > 10 or 2 * count >= max(clean)):
            raise unreadable(
                f"Line {part.titles_line} has other titles ({_named(part)}) than line {main.titles_line} "
                f"({_named(main)}): the file has two tables.",
                "Cut the file between the tables, and import each by itself.",
            )
        table.doubts.append(f"Rows left out below other titles in line {part.titles_line}: {count}.")
    table.numbers = [n for part in alike for n in part.rows]
    table.rows = [rows[n] for n in table.numbers]
    taken = {*table.numbers, *(n for part in alike for n in part.head)}
    table.left = [n for n in lines if n not in taken]
    first, last = table.numbers[0], table.numbers[-1]
    other = [n for n in table.left if n > first and len(rows[n]) != width and any(map(is_loose, rows[n]))]
    odd = [n for n in other if n < last or all(map(is_loose, rows[n]))]
    wide = [n for n in odd if len(rows[n]) > width and all(map(is_loose, rows[n]))]
    if wide and mark == ",":
        raise unreadable(
            f"Line {wide[0]} has {len(rows[wide[0]])} cells below {width} titles, all of them numbers: commas part the "
            "cells and are within numbers too.",
            "Export it again with semicolons, tabs, or quotes about each number.",
        )
    table.odd = odd
    if odd:
        table.doubts.append(
            f"Rows left out because they have not as many cells as the {width} titles: {len(odd)} (line {odd[0]} "
            f"has {len(rows[odd[0]])}: {shown(lines[odd[0]])!r})."
        )
    return table


def _named(part: _Part) -> str:
    return shown(", ".join(f"{title} [{unit}]" for title, unit in zip(part.titles, part.units, strict=True)), 300)


def _titles_remedy(rows: dict[int, list[str]], width: int, sample: list[list[str]]) -> str:
    """Return the remedy for a table without titles: numbers that commas part have twice the cells of their titles."""
    first = next((n for n, row in rows.items() if row in sample[:1]), 0)
    above = [row for n, row in rows.items() if n < first and len(row) > 1 and not any(map(is_loose, row))]
    if above and len(above[-1]) != width:
        return (
            f"The row above has {len(above[-1])} cells and a row of numbers {width}. If commas part the cells and are "
            "within numbers too, export with semicolons, tabs or quotes."
        )
    return ""
