"""Readings of gauges as a table: one number a row, so that any program can filter and plot it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter

from stereorig.server.formats import csv_cells
from stereorig.server.formats.gauges.readings import AreaStatistics, GaugeReadings, Number, Numbers, StepReadings
from stereorig.server.formats.results.uncertainty import Statement

_OF_AREA = ("mean", "sd", "min", "max", "rms", "count")


@dataclass(frozen=True)
class GaugeRow:
    """One number of a gauge; its fields are the table's columns."""

    step: int
    label: str
    load_n: float | None
    gauge: str | None = None
    kind: str = ""
    x_px: float | None = None
    y_px: float | None = None
    distance_px: float | None = None
    quantity: str = ""
    value: float | None = None
    sigma: float | None = None
    units: str = ""
    missing: str = ""
    sigma_calibration: float | None = None
    expanded: float | None = None
    not_included: str = ""
    u_matching: float | None = None
    u_reference: float | None = None
    u_calibration: float | None = None
    u_stage: float | None = None
    u_target: float | None = None
    u_sensor: float | None = None
    time_s: float | None = None
    channels: Mapping[str, float] = field(default_factory=dict)
    channel_u: Mapping[str, float] = field(default_factory=dict)


_OWN = tuple(f.name for f in fields(GaugeRow) if f.name not in ("channels", "channel_u"))


def columns(readings: GaugeReadings) -> dict[str, Callable[[GaugeRow], str | float | None]]:
    """Return the table's columns by name; each recorded channel has one, after the columns that every table has."""
    found: dict[str, Callable[[GaugeRow], str | float | None]] = {name: attrgetter(name) for name in _OWN}
    for name in readings.channel_units:
        # a channel may have the name of another column
        found[name if name not in found else f"channel_{name}"] = lambda row, name=name: row.channels.get(name)  # type: ignore[misc]
    for name in sorted({name for step in readings.steps for name in step.channel_u}):
        found[f"{name}_u"] = lambda row, name=name: row.channel_u.get(name)  # type: ignore[misc]
    return found


def gauges_csv(readings: GaugeReadings) -> bytes:
    """Return the readings as CSV, settings and inputs in comment lines (#) above the header.

    Missing numbers are empty, with the reason in the column ``missing``; ``not_included`` states that the uncertainty
    lacks the calibration, ``u_matching`` ... are its parts by cause.
    """
    lines = [
        csv_cells.comment(f"{name}: {json.dumps(value, ensure_ascii=False, sort_keys=True)}")
        for name, value in readings.about().items()
    ]
    wanted = columns(readings)
    lines.append(csv_cells.row(wanted))
    # csv writes None as nothing, and a float with all of its digits
    lines.extend(csv_cells.row(value(row) for value in wanted.values()) for row in table_rows(readings))
    return "".join(lines).encode()


def table_rows(readings: GaugeReadings) -> Iterator[GaugeRow]:
    """Yield every number of every step; differences from step n have ``:since_step_<n>`` behind the quantity."""
    since = readings.settings.get("difference_from")
    for step in readings.steps:
        yield from _of_step(step)
        head = _head(step)
        for one in step.differences:
            values = {f"{quantity}:since_step_{since}": number for quantity, number in one.values.items()}
            yield from _rows(replace(head, gauge=one.gauge, kind=one.kind), values, "")


def _head(step: StepReadings) -> GaugeRow:
    head = GaugeRow(step.n, step.label, step.load_n, time_s=step.time_s)
    return replace(head, channels=step.channels, channel_u=step.channel_u)


def _of_step(step: StepReadings) -> Iterator[GaugeRow]:
    head = _head(step)
    if step.problem is not None:
        yield replace(head, kind="step", missing=step.problem.detail)
    if step.rigid_motion is not None:
        motion = replace(head, gauge="rigid motion", kind="rigid_motion")
        yield from _rows(motion, step.rigid_motion.values, "")
    for point in step.points:
        x, y = point.xy_px
        yield from _rows(replace(head, gauge=point.name, kind="point", x_px=x, y_px=y), point.values, point.missing)
    for gauge in step.extensometers:
        yield from _rows(replace(head, gauge=gauge.name, kind="extensometer"), gauge.values, gauge.missing)
    for area in step.areas:
        for quantity, v in area.values.items():
            parts = {f"{quantity}:{part}": Number(getattr(v, part), None, v.units) for part in _OF_AREA}
            parts[f"{quantity}:mean"] = v.mean_number
            parts[f"{quantity}:count"] = Number(v.count, None, "1")
            yield from _rows(replace(head, gauge=area.name, kind="area"), parts, area.missing)
    for line in step.lines:
        for quantity, numbers in line.values.items():
            for k, (x, y, at) in enumerate(zip(line.x_px, line.y_px, line.distance_px, strict=True)):
                position = replace(head, gauge=line.name, kind="line", x_px=x, y_px=y, distance_px=at)
                number = Number(
                    numbers.value[k],
                    numbers.sigma[k],
                    numbers.units,
                    numbers.sigma_calibration[k] if numbers.sigma_calibration else None,
                    _at(numbers.budget, k),
                    expanded=numbers.expanded[k] if numbers.expanded else None,
                    not_included=numbers.not_included,
                )
                yield from _rows(position, {quantity: number}, line.missing[k])


def _at(budget: Mapping[str, Sequence[float | None]] | None, k: int) -> dict[str, float] | None:
    found = {name: values[k] for name, values in (budget or {}).items()}
    return {name: value for name, value in found.items() if value is not None}


def _rows(head: GaugeRow, values: Mapping[str, Number], missing: str) -> Iterator[GaugeRow]:
    for quantity, number in values.items():
        # the position may be valid, but this variable has no value there
        why = missing or ("no value" if number.value is None else "")
        budget = number.budget or {}
        yield replace(
            head,
            quantity=quantity,
            value=number.value,
            sigma=number.sigma,
            units=number.units,
            missing=why,
            sigma_calibration=number.sigma_calibration,
            expanded=number.expanded,
            not_included="" if number.sigma is None else number.not_included,
            u_matching=budget.get("matching"),
            u_reference=budget.get("reference"),
            u_calibration=budget.get("calibration"),
            u_stage=budget.get("stage"),
            u_target=budget.get("target"),
            u_sensor=budget.get("sensor"),
        )


# The statement with each number of a gauge: its expanded uncertainty, and that the calibration is not included.


def stated(step: StepReadings, statement: Statement) -> StepReadings:
    """Return a step's readings with the requested interval, and the terms that it does not include, in every number."""
    k = statement.k if statement.expanded else None
    lacking = statement.included.lacking

    def each(values: Mapping[str, Number]) -> dict[str, Number]:
        return {n: replace(v, expanded=_times(k, v.sigma), not_included=lacking) for n, v in values.items()}

    def along(v: Numbers) -> Numbers:
        expanded = () if k is None else [_times(k, sigma) for sigma in v.sigma]
        return replace(v, expanded=expanded, not_included=lacking)

    def over(v: AreaStatistics) -> AreaStatistics:
        return replace(v, mean_expanded=_times(k, v.mean_sigma), not_included=lacking)

    motion = step.rigid_motion
    return replace(
        step,
        rigid_motion=None if motion is None else replace(motion, values=each(motion.values)),
        points=[replace(g, values=each(g.values)) for g in step.points],
        extensometers=[replace(g, values=each(g.values)) for g in step.extensometers],
        lines=[replace(g, values={n: along(v) for n, v in g.values.items()}) for g in step.lines],
        differences=[replace(g, values=each(g.values)) for g in step.differences],
        areas=[replace(g, values={n: over(v) for n, v in g.values.items()}) for g in step.areas],
    )


def _times(k: float | None, sigma: float | None) -> float | None:
    return None if k is None or sigma is None else k * sigma
