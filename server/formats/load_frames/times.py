"""The clock of a record: which column holds it, and its times as numbers, clock times or dates."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from datetime import datetime, tzinfo

import numpy as np

from stereorig.core.arrays import Float
from stereorig.server.formats.channel_units import TIME_S, channel_name, folded, known_unit
from stereorig.server.formats.load_frames.description import RecordQuestion, shown

#: titles that mean the time itself; in any other title a word for time may be one among others
_EXACT = """time t timestamp time_stamp datetime date_time zeit elapsed elapsed_time total_time run_time running_time
test_time prufzeit pruefzeit testzeit temps tiempo tempo tijd czas cas tid aika zaman"""
_WORDS = """time times timestamp datetime runtime elapsed zeit uhrzeit zeitstempel zeitpunkt temps horodatage tiempo
tempo tijd tid testtid provtid aika czas cas ido zaman timp"""
_ENDINGS = ("zeit", "tijd")
NATIVE_TIMES = ("時間", "时间", "時刻", "时刻", "시간", "время", "χρόνος")
_FORM = frozenset("hmsdyf.:/, _-")
_CLOCK = re.compile(r"([0-9]{1,4}):([0-9]{1,2})(?::([0-9]{1,2}))?(?:[.,:]([0-9]{1,9}))?")
_DATE = re.compile(r"([0-9]{1,4})([-./])([0-9]{1,2})\2([0-9]{1,4})")
_MONTH = re.compile(r"([0-9]{1,4})[-. /]+([A-Za-z]{3})[a-z]*[-. /,]+([0-9]{1,4})(.*)")
_MONTHS = "jan feb mar apr may jun jul aug sep oct nov dec"
_GERMAN = {"mrz": "mar", "mai": "may", "okt": "oct", "dez": "dec"}
_ZONE = re.compile(r" ?(?:UTC|GMT)$| (?=[-+][0-9]{2}:?[0-9]{2}$)")
_CAMEL = re.compile(r"([a-z])([A-Z])")
_DAY_S = 86400.0
_ORDERS = {"dmy": (2, 1, 0), "mdy": (2, 0, 1), "ymd": (0, 1, 2)}


def is_format(unit: str) -> bool:
    """Return True for a form of clock times or dates in place of a unit, as ``hh:mm:ss``."""
    form = unit.strip("[]() ").lower()
    return _FORM.issuperset(form) and any(part in form for part in ("h:", "hh", "m:s", "mm:", "min:", "yy"))


def titled_times(titles: Sequence[str], units: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the columns whose whole title is a time's, and those with a word for it in any of the usual languages."""
    exact, partly = [], []
    for k, (title, unit) in enumerate(zip(titles, units, strict=True)):
        known = known_unit(unit)
        if known is not None and known not in TIME_S:
            continue
        plain = unicodedata.normalize("NFKC", title).lower().strip()
        name = channel_name(title)
        words = re.findall("[a-z]+", folded(_CAMEL.sub(r"\1 \2", title)))
        if {plain, name, name.removesuffix("_s"), name.removesuffix("_utc")} & {*_EXACT.split(), *NATIVE_TIMES}:
            exact.append(k)
        elif any(w in _WORDS.split() or w.endswith(_ENDINGS) for w in words) or any(w in plain for w in NATIVE_TIMES):
            partly.append(k)
    return exact, partly


def clock_times(cells: Sequence[str], unit: str) -> Float:
    """Return clock times ``hh:mm:ss`` in seconds from 0:00; NaN for others.

    Two numbers are hours and minutes or minutes and seconds by the unit, the latter if they have a fraction.
    """
    minutes = re.sub("[^hms]", "", unit.lower()).startswith("m")
    hours = "h" in unit.lower()
    found = np.full(len(cells), np.nan)
    for k, cell in enumerate(cells):
        text, half = _halved(cell)
        parted = _CLOCK.fullmatch(text)
        if parted is None:
            continue
        high, low, last, part = parted.groups()
        if last is None and (minutes or (part is not None and not hours)):
            high, low, last = "0", high, low
        elif last is None and not hours:
            continue
        found[k] = 3600.0 * (int(high) % 12 + half if half >= 0 else int(high)) + 60.0 * int(low)
        found[k] += int(last or 0) + float(f"0.{part or 0}")
    return found


def dates(cells: Sequence[str], order: str | None, zone: tzinfo) -> tuple[Float, RecordQuestion | None]:
    """Return dates with their clock times in seconds since the epoch; NaN for others, and an open question.

    Parameters
    ----------
    order
        ``dmy``, ``mdy`` or ``ymd``, of dates that are not ISO's; None: as the dates decide it.
    """
    found = np.full(len(cells), np.nan)
    parted: list[tuple[int, tuple[str, ...], str]] = []
    for k, written in enumerate(cells):
        cell = _ZONE.sub(lambda zone: "+00:00" if zone[0].strip() else "", _by_numbers(written))
        try:
            moment = datetime.fromisoformat(cell)
        except ValueError:
            date_part, _, clock = cell.replace("T", " ").replace(", ", " ").partition(" ")
            if (date := _DATE.fullmatch(date_part)) is not None:
                parted.append((k, date.group(1, 3, 4, 2), clock.strip()))
            continue
        found[k] = (moment if moment.tzinfo is not None else moment.replace(tzinfo=zone)).timestamp()
    question = None
    if parted and order is None:
        order, question = _order([numbers for _, numbers, _ in parted], cells[parted[0][0]])
    clocks = clock_times([clock or "0:00" for _, _, clock in parted], "hh:mm:ss")
    for (k, numbers, _), seconds in zip(parted, clocks, strict=True):
        year, month, day = (int(numbers[place]) for place in _ORDERS[order or "dmy"])
        try:
            midnight = datetime(year + 2000 if year < 100 else year, month, day, tzinfo=zone)
        except ValueError:
            continue
        found[k] = midnight.timestamp() + seconds
    return found, question


def _by_numbers(cell: str) -> str:
    """Return a date with its month as a number: ``1-Mar-2026 12:00`` as ``1.3.2026 12:00``."""
    named = _MONTH.fullmatch(cell)
    month = folded(named[2]) if named else ""
    place = _MONTHS.find(_GERMAN.get(month, month))
    return cell if named is None or place < 0 else f"{named[1]}.{place // 4 + 1}.{named[3]}{named[4]}"


def past_midnight(clock: Float) -> Float:
    """Return clock times that go on after midnight, if no more time went by there than between other readings."""
    held = np.flatnonzero(np.isfinite(clock))
    steps = np.diff(clock[held])
    days = (
        (steps < 0) & (steps + _DAY_S > 0) & (steps + _DAY_S <= 10 * np.median(np.abs(steps)) if steps.size else True)
    )
    found = clock.copy()
    found[held[1:]] += _DAY_S * np.cumsum(days)
    return found


def _order(parted: list[tuple[str, ...]], example: str) -> tuple[str, RecordQuestion | None]:
    if len(parted[0][0]) == 4:
        return "ymd", None
    if parted[0][3] == "." or any(int(one[0]) > 12 for one in parted):
        return "dmy", None
    if any(int(one[1]) > 12 for one in parted):
        return "mdy", None
    cause = f"The date {shown(example)!r} begins with the day or the month, and no other date decides it."
    return "dmy", RecordQuestion(option="date_order", cause=cause, choices=["dmy", "mdy"])


def _halved(cell: str) -> tuple[str, int]:
    """Return a clock time without its half of the day, and the hours that this adds; -1 for none."""
    text = cell.lower().replace(".m.", "m").rstrip()
    if text.endswith(("am", "pm")):
        return text[:-2].rstrip(), 12 * text.endswith("pm")
    return text, -1
