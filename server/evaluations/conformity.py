"""Conformity: which points are within limits, judged with each point's own uncertainty; histogram of the variable.

A point conforms if the probability that its true value is within the limits reaches the confidence, and does not
conform if the probability that it is outside does; between both it is undecided (JCGM 106:2012, 8.2 and 8.3, with a
normal distribution about the measured value).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.special import ndtr

from stereorig.core.arrays import Bool, Float
from stereorig.core.errors import MeasurementError
from stereorig.server.base.models import Number, Reply, Request, StepNumber
from stereorig.server.evaluations.door import Evaluated, GridValues, Results
from stereorig.server.formats.results.variables import described

_UNDECIDED, _CONFORMS, _FAILS = 0.0, 1.0, -1.0
_Share = Annotated[float, Field(gt=0.0, le=1.0, allow_inf_nan=False)]


class ConformitySettings(Request):
    """Limits of a variable."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"variable": "w_mm", "lower": -0.05, "upper": 0.05}]})

    variable: str = Field(description="Variable of the points, as w_mm or exx.", min_length=1, max_length=60)
    lower: Number | None = Field(None, description="Lower limit, in the variable's unit; null: none.")
    upper: Number | None = Field(None, description="Upper limit, in the variable's unit; null: none.")
    step: StepNumber | None = Field(None, description="Step to judge; null: the last one.")
    confidence: Annotated[float, Field(gt=0.5, lt=1.0)] = Field(
        0.95, description="Probability from which a point is said to conform, or not to."
    )
    share: _Share = Field(1.0, description="Share of the points that must conform.")
    bins: Annotated[int, Field(ge=2, le=500)] = Field(40, description="Bins of the histogram.")

    @model_validator(mode="after")
    def _limits(self) -> Self:
        if self.lower is None and self.upper is None:
            raise ValueError("needs lower, upper or both")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError(f"needs lower below upper, has {self.lower:g} and {self.upper:g}")
        return self


class Histogram(BaseModel):
    """Counts between edges."""

    edges: list[float] = Field(description="Edges of the bins, in the variable's unit; one more than counts.")
    counts: list[int] = Field(description="Points in each bin.")


class Conformity(Reply):
    """Verdict on a variable's limits over the points of a step."""

    verdict: Literal["conforms", "does not conform", "undecided"] = Field(
        description="Conforms if the share asked for does; does not if so many points fail that it cannot."
    )
    accepted: bool | None = Field(description="True if it conforms, false if it does not, null if undecided.")
    step: int = Field(description="The step.")
    variable: str = Field(description="The variable.")
    units: str = Field(description="Its unit.")
    points: int = Field(description="Points with a value and an uncertainty.")
    conforming: int = Field(description="Points that conform.")
    failing: int = Field(description="Points that do not conform.")
    undecided: int = Field(description="Points that are too near to a limit for their uncertainty.")
    mean: float = Field(description="Mean over the points.")
    sd: float = Field(description="Standard deviation over the points.")
    minimum: float = Field(description="Least value.")
    median: float = Field(description="Median.")
    maximum: float = Field(description="Largest value.")
    largest_sigma: float = Field(description="Largest standard uncertainty (k = 1) of a point.")
    histogram: Histogram = Field(description="Histogram over the points.")


class ConformityOfPoints:
    """The evaluation."""

    name = "conformity"
    title = "Conformity with limits"
    settings = ConformitySettings
    document = Conformity
    needs: frozenset[str] = frozenset()

    def run(self, results: Results, asked: ConformitySettings, progress: Callable[[str, int, int], None]) -> Evaluated:
        """Judge every point of the step.

        Raises
        ------
        InputError
            ``step_missing``, or ``evaluation_needs`` for a variable without values or uncertainty.
        MeasurementError
            ``no_valid_points``.
        """
        step = results.steps[-1] if asked.step is None else asked.step
        values, sigma = results.values(step, asked.variable), results.sigma(step, asked.variable)
        known = np.isfinite(values) & np.isfinite(sigma)
        if not known.any():
            raise MeasurementError(
                f"Step {step} has no point with a value of {asked.variable}.",
                code="no_valid_points",
                remedy="Look at the status of its points.",
            )
        progress("judging points", 0, 1)
        judged = judge(values, sigma, known, asked)
        counts = {state: int((judged == state).sum()) for state in (_CONFORMS, _FAILS, _UNDECIDED)}
        held = values[known]
        required = asked.share * held.size
        verdict: Literal["conforms", "does not conform", "undecided"] = "undecided"
        if counts[_CONFORMS] >= required:
            verdict = "conforms"
        elif held.size - counts[_FAILS] < required:
            verdict = "does not conform"
        number, edges = np.histogram(held, bins=asked.bins)
        document = Conformity(
            verdict=verdict,
            accepted={"conforms": True, "does not conform": False}.get(verdict),
            step=step,
            variable=asked.variable,
            units=described(asked.variable).units,
            points=held.size,
            conforming=counts[_CONFORMS],
            failing=counts[_FAILS],
            undecided=counts[_UNDECIDED],
            mean=float(held.mean()),
            sd=float(held.std()),
            minimum=float(held.min()),
            median=float(np.median(held)),
            maximum=float(held.max()),
            largest_sigma=float(sigma[known].max()),
            histogram=Histogram(edges=edges.tolist(), counts=number.tolist()),
        )
        text = f"1: {asked.variable} is within its limits, -1: it is not, 0: undecided"
        return Evaluated(document, step, {f"conformity_{asked.variable}": GridValues(judged, "1", text)})


def judge(values: Float, sigma: Float, known: Bool, asked: ConformitySettings) -> Float:
    """Return (r, c) 1 for a point that conforms, -1 for one that does not, 0 for an undecided one; NaN if not known."""
    below = np.zeros(values.shape) if asked.lower is None else _beyond(asked.lower - values, sigma)
    above = np.zeros(values.shape) if asked.upper is None else _beyond(values - asked.upper, sigma)
    outside = below + above
    judged = np.full(values.shape, _UNDECIDED)
    judged[1.0 - outside >= asked.confidence] = _CONFORMS
    judged[outside >= asked.confidence] = _FAILS
    return np.where(known, judged, np.nan)


def _beyond(distance: Float, sigma: Float) -> Float:
    """Return the probability that the true value is beyond a limit, which the measured one exceeds by ``distance``."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(sigma > 0.0, distance / sigma, np.where(distance > 0.0, np.inf, -np.inf))
    return np.asarray(ndtr(z))
