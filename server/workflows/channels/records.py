"""A load frame's record, aligned with a test's steps by time and kept with them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from stereorig.core.errors import InputError
from stereorig.server.documents.steps import StepRecord
from stereorig.server.formats.channel_table import ChannelTable, require_answers
from stereorig.server.formats.channel_units import FORCE_N
from stereorig.server.formats.load_frames.description import RecordRead
from stereorig.server.results.channels import step_time, units_of
from stereorig.server.store.indexing.entries import step_entry
from stereorig.server.workflows.service import Service

#: readings up to this many times their median distance from each other are joined by a straight line
_GAPS = 3.0


@dataclass(frozen=True)
class ClockTie:
    """Relation between a record's clock and the steps' clock.

    Attributes
    ----------
    starts_utc
        When the record's clock was zero; for records with times of their own that are not of the calendar.
    at_step, at_s
        Or: the record's time ``at_s`` is the time of step ``at_step``.
    offset_s
        Is added to the record's times: how much its clock is behind.
    max_gap_s
        Largest distance of readings that are joined; None: three times their median distance.
    load
        Channel that is the steps' load, in a unit of force.
    replace
        True: overwrite channels that a step has already.
    """

    starts_utc: datetime | None = None
    at_step: int | None = None
    at_s: float = 0.0
    offset_s: float = 0.0
    max_gap_s: float | None = None
    load: str | None = None
    replace: bool = False


@dataclass(frozen=True)
class AlignedRecord:
    """Result of aligning a record with a test's steps.

    Attributes
    ----------
    summary
        As the API shows it.
    steps
        For each step its number, the record's time, the channels at that time, and the reason for missing ones.
    refused
        Reason why the record cannot be imported so; empty if it can.
    """

    summary: Mapping[str, object]
    steps: Sequence[Mapping[str, object]]
    refused: str = ""


def preview_channels(
    service: Service, test_id: str, record: tuple[ChannelTable | None, RecordRead], how: ClockTie
) -> AlignedRecord:
    """Return the outcome of an import and the description of the record; change nothing."""
    table, read = record
    units = {} if table is None else table.units
    try:
        done = import_channels(service, test_id, record, how, keep=False)
    except InputError as error:
        return AlignedRecord({"channels": units, "read": read}, [], f"{error.cause} {error.remedy}")
    return done


def import_channels(
    service: Service, test_id: str, record: tuple[ChannelTable | None, RecordRead], how: ClockTie, *, keep: bool = True
) -> AlignedRecord:
    """Give each step the record's channels at its time; all steps or none.

    Parameters
    ----------
    record
        As :func:`stereorig.server.formats.channel_table.read_record` returns it.
    keep
        False: change nothing.

    Raises
    ------
    InputError
        ``channels_unsure`` if the file leaves something open; ``channels_unaligned`` if the relation of the clocks is
        not stated; ``channel_unknown``, ``load_unit``; ``channels_there`` for steps that have them already.
    """
    table = require_answers(*record)
    factor = _load_factor(table, how.load)
    steps = [
        service.tests.steps.read(test_id, int(str(one["n"]))).document
        for one in service.catalog.entries("step", test_id)
    ]
    times = {step.n: step_time(step.plain()) for step in steps}
    zero_s = _zero(table, how, times)
    gap_s = _GAPS * table.interval_s if how.max_gap_s is None else how.max_gap_s
    found: dict[int, dict[str, float]] = {}
    shown: list[dict[str, object]] = []
    for step in steps:
        taken = times[step.n]
        at_s = None if taken is None else taken.timestamp() - zero_s
        values = {} if at_s is None else table.at(at_s, gap_s)
        found[step.n] = values
        shown.append(
            {"n": step.n, "time_s": at_s, "channels": values, "missing": _why_missing(table, at_s, values, gap_s)}
        )
    if not any(found.values()):
        first = shown[0] if shown else {"n": 0, "time_s": None, "missing": "the test has none"}
        raise InputError(
            f"No step gets a value: the record reaches from {table.time_s[0]:.12g} to {table.time_s[-1]:.12g} s, step "
            f"{first['n']} is at {first['time_s']} s of its clock ({first['missing']}).",
            code="channels_unaligned",
            remedy="Correct starts_utc, at_step and at_s, the time zone or offset_s.",
        )
    _check_free(steps, found, table.units, how.replace)
    with service.changes:
        for step in steps if keep else ():
            if found[step.n]:
                _keep(service, test_id, step, found[step.n], table.units, how.load, factor)
    summary = {
        "channels": table.units,
        "read": record[1],
        "readings": int(table.time_s.size),
        "interval_s": table.interval_s,
        "max_gap_s": gap_s,
        "n_steps": len(shown),
        "n_aligned": sum(map(bool, found.values())),
        "reasons": dict(Counter(str(one["missing"]) for one in shown if one["missing"])),
    }
    return AlignedRecord(summary, shown)


def _load_factor(table: ChannelTable, load: str | None) -> float:
    if load is None:
        return 1.0
    if load not in table.channels:
        raise InputError(
            f"The record has no channel {load!r}; it has {', '.join(table.channels)}.",
            code="channel_unknown",
            remedy="Name one of these.",
        )
    unit = table.units[load]
    if unit not in FORCE_N:
        raise InputError(
            f"The channel {load} is in {unit}, not in a unit of force.",
            code="load_unit",
            remedy=f"Name a channel of forces as the load; known are {', '.join(FORCE_N)}.",
        )
    return FORCE_N[unit]


def _zero(table: ChannelTable, how: ClockTie, times: Mapping[int, datetime | None]) -> float:
    """Return when the record's clock was zero, seconds since the epoch."""
    if table.absolute:
        return -how.offset_s
    if how.starts_utc is not None:
        return how.starts_utc.timestamp() - how.offset_s
    if how.at_step is None:
        raise InputError(
            "The record's times are of its own clock, and its zero is not stated.",
            code="channels_unaligned",
            remedy="Give starts_utc, or at_step and at_s: which time of the record a step was taken at.",
        )
    taken = times.get(how.at_step)
    if taken is None:
        raise InputError(
            f"There is no step {how.at_step}, or its time is not known.",
            code="channels_unaligned",
            remedy="Name a step that was captured, or one that was imported with timestamp_utc.",
        )
    return taken.timestamp() - how.at_s - how.offset_s


def _why_missing(table: ChannelTable, at_s: float | None, values: Mapping[str, float], gap_s: float) -> str:
    if at_s is None:
        return "its time is not known; import it with timestamp_utc"
    if not table.time_s[0] <= at_s <= table.time_s[-1]:
        return "it is outside the record"
    lacking = [name for name in table.channels if name not in values]
    unread = [name for name in lacking if table.is_unread(name, at_s)]
    apart = [name for name in lacking if name not in unread]
    reasons = [f"a cell or row could not be read there: {', '.join(unread)}"] if unread else []
    if apart:
        reasons.append(f"readings are more than {gap_s:.6g} s apart there: {', '.join(apart)}")
    return "; ".join(reasons)


def _check_free(
    steps: list[StepRecord], found: Mapping[int, Mapping[str, float]], units: Mapping[str, str], replace: bool
) -> None:
    for step in steps:
        had = units_of(step.channels, step.channel_units)
        other = [n for n in units if had.get(n, "1") not in ("1", units[n]) and not (replace and n in found[step.n])]
        if other:
            raise InputError(
                f"Step {step.n} has {other[0]} in {had[other[0]]} already; the record has it in {units[other[0]]}.",
                code="channels_there",
                remedy="Give the column another title.",
            )
        if replace:
            continue
        there = [n for n, value in found[step.n].items() if step.channels.get(n, value) != value]
        if there:
            raise InputError(
                f"Step {step.n} has {there[0]} = {step.channels[there[0]]:.6g} already; the record has "
                f"{found[step.n][there[0]]:.6g}.",
                code="channels_there",
                remedy="Send replace=true to write over it, or give the column another title.",
            )


def _keep(
    service: Service,
    test_id: str,
    step: StepRecord,
    values: Mapping[str, float],
    units: Mapping[str, str],
    load: str | None,
    factor: float,
) -> None:
    stated = {**step.channel_units, **{name: units[name] for name in values}}
    changes: dict[str, object] = {"channels": {**step.channels, **values}, "channel_units": stated}
    if step.channel_u:
        changes["channel_u"] = {name: u for name, u in step.channel_u.items() if name not in values}
    if load is not None and load in values:
        changes["load_n"] = factor * values[load]
    entry = step_entry(service.tests.steps.update(test_id, step.n, changes))
    service.catalog.put_entry("step", test_id, f"{step.n:04d}", entry)
    service.hub.publish("step", {"test_id": test_id, **entry})
