"""The statement with each number of a gauge: its expanded uncertainty, and that the calibration is not included."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from stereorig.server.formats.gauges.readings import AreaStatistics, Number, Numbers, StepReadings
from stereorig.server.formats.results.uncertainty import Statement


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
