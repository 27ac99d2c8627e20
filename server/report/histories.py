"""The course of the test: loads, mean motion and strain, and the gauges that were asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS
from stereorig.server.formats.channel_units import channel_title
from stereorig.server.formats.gauges.readings import LineReading, Number, StepReadings
from stereorig.server.formats.results.uncertainty import Statement
from stereorig.server.formats.results.variables import VARIABLES
from stereorig.server.report.floor import STRAINS
from stereorig.server.report.items import Value, rounded, shown_unit
from stereorig.server.report.page import SVG, PagePicture
from stereorig.server.report.pictures import Lines, course
from stereorig.server.report.source import Source
from stereorig.server.report.steps import MeasuredSteps, StepRow
from stereorig.server.report.uncertainty import BudgetRow, gauge_budgets
from stereorig.server.results.gauges.readings import read_gauges

#: a gauge's values in every step, or the reason why there are none
_Readings = Sequence[tuple[Mapping[str, Number], str]]
_EXTENSOMETER = ("elongation_mm", "strain")
#: shown in um/m or %
_STRAINS = {"strain", "true_strain"} | {name for name, one in VARIABLES.items() if one.kind == "strain"}
_FOLLOWS = 0.9  # correlation of the mean motion with the load or channel that drives it


@dataclass(frozen=True)
class GaugeTable:
    """A gauge over the steps; a value without a number has the reason."""

    name: str
    title: str
    columns: list[str]
    rows: list[tuple[int, list[Value]]]


@dataclass(frozen=True)
class Gauges:
    """All gauges; the curves are None if they could not be read at all.

    Attributes
    ----------
    budgets, budget_step
        Budgets of the gauges' uncertainties in one step, and the step's number.
    """

    curves: list[PagePicture] | None
    problems: list[str]
    tables: list[GaugeTable]
    budgets: list[BudgetRow] = field(default_factory=list)
    budget_step: int | None = None


@dataclass(frozen=True)
class _Axis:
    """Abscissa of the curves: the load or channel that drives the test, else the time, else the step."""

    positions: list[float]
    label: str
    name: str = ""  # of the load or channel that drives the test
    as_given: bool = False

    @staticmethod
    def of(steps: Sequence[StepRow]) -> _Axis:
        return _driving(steps) or _Axis.in_time(steps)

    @staticmethod
    def in_time(steps: Sequence[StepRow]) -> _Axis:
        """Return the time since the reference, or the steps' numbers."""
        times = [s.seconds for s in steps]
        known = [t for t in times if t is not None]
        if len(known) == len(times) and len(set(known)) == len(known) and np.isfinite(known).all():
            return _Axis(known, "time since the reference, s")
        return _Axis([float(s.n) for s in steps], "step")

    def only(self, chosen: Sequence[StepRow], of: Sequence[StepRow]) -> _Axis:
        """Return the same abscissa of some of the steps."""
        numbers = {s.n for s in chosen}
        return replace(self, positions=[x for x, s in zip(self.positions, of, strict=True) if s.n in numbers])

    def draw(self, lines: Lines, y_label: str, title: str, *, text: str, caption: str) -> PagePicture:
        against = f" against {self.name}" if self.name else ""
        data = course(self.positions, lines, x_label=self.label, y_label=y_label, title=title, as_given=self.as_given)
        return PagePicture(data, SVG, f"{text} over the steps", f"{caption}{against}")


def _driving(steps: Sequence[StepRow]) -> _Axis | None:
    """Return the load or the channel that the motion follows; None if none of those recorded in every step does."""
    spans = [[span.mean for span in (s.summary.displacement_mm or {}).values() if span] for s in steps]
    moved = np.array([float(np.linalg.norm(means)) if means else 0.0 for means in spans])
    if len(steps) < 3 or not np.ptp(moved):
        return None
    names = sorted({name for s in steps for name in s.channels})
    recorded = {"load": [s.load_n for s in steps], **{name: [s.channels.get(name) for s in steps] for name in names}}
    found = []
    for name, values in recorded.items():
        known = np.array([np.nan if v is None else v for v in values])
        if np.isfinite(known).all() and np.ptp(known):
            found.append((abs(float(np.corrcoef(np.abs(known - known[0]), moved)[0, 1])), name, known))
    # the load comes first: a temperature may happen to rise with it
    name, positions = next(((name, known) for follows, name, known in found if follows >= _FOLLOWS), ("", None))
    if positions is None:
        return None
    label = "load, N" if name == "load" else _title(name, steps)
    return _Axis(positions.tolist(), label, label.partition(",")[0], as_given=True)


def courses(measured: MeasuredSteps) -> list[PagePicture] | None:
    """Draw loads, channels, and the means of displacement and strain; None with fewer than two steps."""
    steps = measured.steps
    if len(steps) < 2:
        return None
    axis, time = _Axis.of(steps), _Axis.in_time(steps)
    drawn = []
    if measured.loaded:
        lines: Lines = {"load": ([s.load_n for s in steps], None)}
        drawn.append(time.draw(lines, "load, N", "Load", text="load", caption="Load as recorded with the steps"))
    for name in measured.channels:
        lines = {name: ([s.channels.get(name) for s in steps], None)}
        label = _title(name, steps)
        title = label.partition(",")[0]
        drawn.append(time.draw(lines, label, title, text=title, caption=f"{title} as recorded with the steps"))

    # displacement and strain are relative to the reference, and zero there
    moving = [s for s in steps if s.summary.displacement_mm or s.n == measured.reference_step]
    if measured.moved:
        means: dict[str, list[float | None]] = {}
        for component in ("u", "v", "w"):
            spans = [(s.summary.displacement_mm or {}).get(component) for s in moving]
            means[component.upper()] = [
                (0.0 if s.n == measured.reference_step else None) if span is None else span.mean
                for s, span in zip(moving, spans, strict=True)
            ]
        title, caption = "Displacement, mean over the points", "Mean of U, V, W over all valid points"
        lines, unit = _scaled(means, "mm")
        along = axis.only(moving, steps)
        drawn.append(along.draw(lines, f"mean displacement, {unit}", title, text="mean displacement", caption=caption))
    strained = {s.n: s.strain for s in steps if s.strain is not None and s.strain.points}
    if strained:
        chosen = [s for s in steps if s.n in strained or s.n == measured.reference_step]
        of_steps = [None if s.n not in strained else strained[s.n].mean_microstrain for s in chosen]
        means = {e: [0.0 if mean is None else _times(mean[e], 1e-6) for mean in of_steps] for e in STRAINS}
        title, caption = "Strain, mean over the points", "Mean of the strains over all points that have it"
        lines, unit = _scaled(means, "1", strain=True)
        along = axis.only(chosen, steps)
        drawn.append(along.draw(lines, f"mean strain, {unit}", title, text="mean strain", caption=caption))
    return drawn + _against_temperature(steps)


def _against_temperature(steps: Sequence[StepRow]) -> list[PagePicture]:
    """Draw the mean epipolar offset against each camera's temperature: a rig that warms up drifts with it."""
    drawn = []
    for cam in CAMERAS:
        known = [s for s in steps if s.temperature_c(cam) is not None]
        axis = _Axis([float(s.temperature_c(cam) or 0.0) for s in known], f"temperature of {cam}, °C", as_given=True)
        if len(set(axis.positions)) < 2:
            continue
        lines: Lines = {"offset": ([s.summary.epipolar_offset_mean_px for s in known], None)}
        title, caption = f"Epipolar offset and temperature of {cam}", "Mean of the offset across the epipolar line"
        picture = axis.draw(lines, "mean epipolar offset, px", title, text="epipolar offset", caption=caption)
        drawn.append(replace(picture, caption=f"{caption} against the temperature that {cam} reported"))
    return drawn


def gauges(source: Source, measured: MeasuredSteps) -> Gauges | None:
    """Read the gauges of the metadata in every step, and draw their courses; None if none were asked for."""
    if source.metadata.gauges is None:
        return None
    try:
        asked = source.metadata.gauges.model_copy(update=measured.statement.asked.model_dump(include={"k", "coverage"}))
        readings = read_gauges(list(source.files.values()), asked)
    except StereorigError as error:
        return Gauges(None, [f"The gauges could not be read: {error.cause}"], [])
    problems = [f"Step {s.n}: {s.problem.detail}" for s in readings.steps if s.problem is not None]
    steps = readings.read
    if not steps:
        return Gauges([], problems, [])
    figures = {s.n: s for s in measured.steps}
    read_ = [figures[s.n] for s in steps]
    axis = _Axis.of(measured.steps).only(read_, measured.steps)
    at_rest = [s.n == measured.reference_step for s in read_]
    curves: list[PagePicture] = []
    tables = []
    for k, extensometer in enumerate(steps[0].extensometers):
        read: _Readings = [(s.extensometers[k].values, s.extensometers[k].missing) for s in steps]
        title = f"Extensometer {extensometer.name}"
        tables.append(_table(extensometer.name, title, _EXTENSOMETER, steps, read))
        curves += _curves(title, _EXTENSOMETER[-1:], [values for values, _ in read], axis, at_rest, measured.statement)
        curves += _against_loads(title, read_, [values for values, _ in read], measured.statement, axis.label)
    others: list[tuple[str | None, str, _Readings]] = []
    for k, point in enumerate(steps[0].points):
        others.append((point.name, "Point", [(s.points[k].values, s.points[k].missing) for s in steps]))
    for k, area in enumerate(steps[0].areas):
        means = [({n: v.mean_number for n, v in s.areas[k].values.items()}, s.areas[k].missing) for s in steps]
        others.append((area.name, "Area", means))
    for name, kind, read in others:
        last = read[-1][0]
        tables.append(_table(name, f"{kind} {name}", list(last), steps, read))
        moved = [n for n in last if n in ("u_mm", "v_mm", "w_mm")]
        curves += _curves(f"{kind} {name}", moved, [values for values, _ in read], axis, at_rest, measured.statement)
    for line in steps[-1].lines:
        curves += _line(line, steps[-1].n, asked.variables)
    return Gauges(curves, problems, tables, gauge_budgets(steps[-1], measured.statement), steps[-1].n)


def _title(channel: str, steps: Sequence[StepRow]) -> str:
    stated = [getattr(s, "units", {}).get(channel) for s in steps]
    return channel_title(channel, next((unit for unit in stated if unit), None))


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _scaled(
    values: Mapping[str, Sequence[float | None]],
    units: str,
    sigma: Mapping[str, Sequence[float | None]] | None = None,
    *,
    strain: bool = False,
) -> tuple[Lines, str]:
    """Return the lines of a plot in the unit that the page shows them in, and that unit."""
    known = [abs(v) for line in values.values() for v in line if v is not None and np.isfinite(v)]
    factor, unit = shown_unit(units, max(known, default=0.0), strain=strain)
    return {
        name: ([_times(v, factor) for v in line], None if sigma is None else [_times(u, factor) for u in sigma[name]])
        for name, line in values.items()
    }, unit


def _against_loads(
    title: str, steps: Sequence[StepRow], read: Sequence[Mapping[str, Number]], statement: Statement, drawn_over: str
) -> list[PagePicture]:
    """Draw the strain of an extensometer against the load and each channel; steps without a value are left out.

    Parameters
    ----------
    drawn_over
        Label of the abscissa that the strain is drawn over already.
    """
    names = sorted({name for s in steps for name in s.channels})[:4]
    loads = {_title(name, steps): [s.channels.get(name) for s in steps] for name in names}
    loads = {"load, N": [s.load_n for s in steps], **loads}
    drawn = []
    for label, values in loads.items():
        points = [
            (x, 0.0 if v is None or v.value is None else v.value, None if v is None else v.sigma)
            for s, x, v in zip(steps, values, (numbers.get("strain") for numbers in read), strict=True)
            # strain is relative to the reference, and zero there
            if x is not None and ((v is not None and v.value is not None) or not s.summary.displacement_mm)
        ]
        if label == drawn_over or len({x for x, _, _ in points}) < 2:
            continue
        sigma = [_times(s, statement.k) for _, _, s in points]
        lines, unit = _scaled({"strain": [y for _, y, _ in points]}, "1", {"strain": sigma}, strain=True)
        name = label.partition(",")[0]
        data = course(
            [x for x, _, _ in points],
            lines,
            x_label=label,
            y_label=f"strain, {unit}",
            title=f"{title} against {name}",
            as_given=True,
        )
        caption = f"{title} against {name}; bars are \u00b1 {statement.text}"
        drawn.append(PagePicture(data, SVG, f"{title} against {name}", caption))
    return drawn


def _table(
    name: str | None, title: str, wanted: Sequence[str], steps: Sequence[StepReadings], read: _Readings
) -> GaugeTable:
    wanted = [n for n in wanted if n in read[-1][0]]
    columns, of_steps = ["step"], [list[Value]() for _ in steps]
    for n in wanted:
        numbers = [values.get(n) for values, _ in read]
        known = [abs(v.value) for v in numbers if v is not None and v.value is not None]
        units = next((v.units for v in numbers if v is not None), "")
        factor, unit = shown_unit(units, max(known, default=0.0), strain=n in _STRAINS)
        columns.append(f"{n.removesuffix('_mm').replace('_', ' ')}{f', {unit}' if unit else ''}")
        for row, number, (_, missing) in zip(of_steps, numbers, read, strict=True):
            row.append(_value(number, missing, factor))
    return GaugeTable(str(name), title, columns, [(step.n, row) for step, row in zip(steps, of_steps, strict=True)])


def _value(number: Number | None, missing: str, factor: float) -> Value:
    if number is None or number.value is None:
        return Value(missing or "no value")
    u = number.sigma if number.expanded is None else number.expanded
    return Value(rounded(factor * number.value, _times(u, factor)), number.value)


def _curves(
    title: str,
    wanted: Sequence[str],
    read: Sequence[Mapping[str, Number]],
    axis: _Axis,
    at_rest: Sequence[bool],
    statement: Statement,
) -> list[PagePicture]:
    if not wanted:
        return []
    lengths = wanted[0].endswith("_mm")
    values: dict[str, list[float | None]] = {}
    sigma: dict[str, list[float | None]] = {}
    for n in wanted:
        numbers = [found.get(n) for found in read]
        name = n.removesuffix("_mm")
        values[name] = [
            (0.0 if rest else None) if v is None or v.value is None else v.value
            for v, rest in zip(numbers, at_rest, strict=True)
        ]
        sigma[name] = [None if v is None else _times(v.sigma, statement.k) for v in numbers]
    lines, unit = _scaled(values, "mm" if lengths else "1", sigma, strain=not lengths)
    caption = f"{title}; bars are \u00b1 {statement.text}"
    label = f"{'displacement' if lengths else 'strain'}, {unit}"
    return [axis.draw(lines, label, title, text=title, caption=caption)]


def _line(line: LineReading, n: int, asked: Sequence[str] | None) -> list[PagePicture]:
    """Draw one plot of a line: the only strain or displacement that was asked for, else W, else Z."""
    moving = [name for name in asked or () if name in _STRAINS or name in ("u_mm", "v_mm", "w_mm")]
    names = [*(moving if len(moving) == 1 else ()), "w_mm", *moving, "z_mm", *line.values]
    names = [name for name in names if name in line.values]
    if not names:
        return []
    name, read = names[0], line.values[names[0]]
    lines, unit = _scaled({name: read.value}, read.units, {name: read.sigma}, strain=name in _STRAINS)
    data = course(
        line.distance_px,
        lines,
        x_label="distance along the line, px",
        y_label=f"{name.removesuffix('_mm')}{f', {unit}' if unit else ''}",
        title=f"Line {line.name}, step {n}",
    )
    caption = f"Line {line.name}: {name.removesuffix('_mm')} in step {n}; bars are one standard uncertainty"
    return [PagePicture(data, SVG, f"{name} along line {line.name}", caption)]
