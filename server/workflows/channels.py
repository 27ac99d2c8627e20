"""A load frame's record, aligned with a test's steps by time and kept with them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from core.errors import InputError
from server.formats.channel_table import ChannelTable
from server.formats.channel_units import unit_of
from server.results.channels import step_time
from server.store.documents import StepRecord
from server.store.indexing.entries import step_entry
from server.workflows.service import Service

#: readings may lie this many times their median distance apart and still be joined by a straight line
_GAPS = 3.0
_TO_NEWTON = {"N": 1.0, "kN": 1e3}


@dataclass(frozen=True)
class Alignment:
    """How the clocks belong together.

    Attributes
    ----------
    starts_utc
        When the record's clock was zero; for records with times of their own that are not of the calendar.
    at_step, at_s
        Or: the record's time ``at_s`` is that of step ``at_step``.
    offset_s
        Is added to the record's times: how much its clock is behind.
    max_gap_s
        Readings further apart are not joined; None: three times their median distance.
    load
        Channel that is the steps' load, in N or kN.
    replace
        Whether channels that a step has already are written over.
    """

    starts_utc: datetime | None = None
    at_step: int | None = None
    at_s: float = 0.0
    offset_s: float = 0.0
    max_gap_s: float | None = None
    load: str | None = None
    replace: bool = False


@dataclass(frozen=True)
class Aligned:
    """What came of a record.

    Attributes
    ----------
    summary
        As the API shows it.
    steps
        Of each step: its number, the record's time, the channels that it has now, and why it lacks some.
    """

    summary: Mapping[str, object]
    steps: Sequence[Mapping[str, object]]


def import_channels(service: Service, test_id: str, table: ChannelTable, how: Alignment) -> Aligned:
    """Give each step the record's channels at its time; all steps or none.

    Raises
    ------
    InputError
        ``channels_unaligned`` where it is not said how the clocks belong together; ``channel_unknown``, ``load_unit``;
        ``channels_there`` for steps that have them already.
    """
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
        first = shown[0] if shown else {"n": 0, "time_s": None}
        raise InputError(
            f"No step lies in the record: it reaches from {table.time_s[0]:.12g} to {table.time_s[-1]:.12g} s, step "
            f"{first['n']} is at {first['time_s']} s of its clock.",
            code="channels_unaligned",
            remedy="Correct starts_utc, at_step and at_s, the time zone or offset_s.",
        )
    _check_free(steps, found, how.replace)
    with service.changes:
        for step in steps:
            if found[step.n]:
                _keep(service, test_id, step, found[step.n], how.load, factor)
    summary = {
        "channels": {name: unit_of(name) for name in table.channels},
        "readings": int(table.time_s.size),
        "interval_s": table.interval_s,
        "max_gap_s": gap_s,
        "n_steps": len(shown),
        "n_aligned": sum(map(bool, found.values())),
        "reasons": dict(Counter(str(one["missing"]) for one in shown if one["missing"])),
    }
    return Aligned(summary, shown)


def _load_factor(table: ChannelTable, load: str | None) -> float:
    if load is None:
        return 1.0
    if load not in table.channels:
        raise InputError(
            f"The record has no channel {load!r}; it has {', '.join(table.channels)}.",
            code="channel_unknown",
            remedy="Name one of these.",
        )
    if unit_of(load) not in _TO_NEWTON:
        raise InputError(
            f"The channel {load} is in {unit_of(load)}, not in N or kN.",
            code="load_unit",
            remedy="Name a channel of forces as the load.",
        )
    return _TO_NEWTON[unit_of(load)]


def _zero(table: ChannelTable, how: Alignment, times: Mapping[int, datetime | None]) -> float:
    """Return when the record's clock was zero, seconds since the epoch."""
    if table.absolute:
        return -how.offset_s
    if how.starts_utc is not None:
        return how.starts_utc.timestamp() - how.offset_s
    if how.at_step is None:
        raise InputError(
            "The record's times are of its own clock, and it is not said when that was zero.",
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
        return "it lies outside the record"
    lacking = [name for name in table.channels if name not in values]
    return f"readings are more than {gap_s:.6g} s apart there: {', '.join(lacking)}" if lacking else ""


def _check_free(steps: list[StepRecord], found: Mapping[int, Mapping[str, float]], replace: bool) -> None:
    if replace:
        return
    for step in steps:
        there = [n for n, value in found[step.n].items() if step.channels.get(n, value) != value]
        if there:
            raise InputError(
                f"Step {step.n} has {there[0]} = {step.channels[there[0]]:.6g} already; the record says "
                f"{found[step.n][there[0]]:.6g}.",
                code="channels_there",
                remedy="Send replace=true to write over it, or give the column another title.",
            )


def _keep(
    service: Service, test_id: str, step: StepRecord, values: Mapping[str, float], load: str | None, factor: float
) -> None:
    changes: dict[str, object] = {"channels": {**step.channels, **values}}
    if load is not None and load in values:
        changes["load_n"] = factor * values[load]
    entry = step_entry(service.tests.steps.update(test_id, step.n, changes))
    service.catalog.put_entry("step", test_id, f"{step.n:04d}", entry)
    service.hub.publish("step", {"test_id": test_id, **entry})
