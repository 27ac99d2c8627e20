"""Analyses and results, as they travel."""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, StringConstraints, field_validator, model_validator
from pydantic.config import JsonDict
from pydantic_core import PydanticKnownError

from stereorig.core import settings
from stereorig.core.settings import StoredSettings, disagreement
from stereorig.server.api.models.jobs import Accepted, JobProblem
from stereorig.server.api.models.tests import AnalysisEntry
from stereorig.server.api.models.warnings import AnalysisWarning, SystematicTerms
from stereorig.server.base.json_values import Nested
from stereorig.server.base.models import JobState, Label, Listing, Reply, Request, StepNumber, Switch, any_of, given
from stereorig.server.documents.results import FieldVariable, Probe, Uncertainty
from stereorig.server.documents.tests import CameraMotion
from stereorig.server.formats.gauges.readings import (
    AreaReading,
    DifferenceReading,
    ExtensometerReading,
    FrameReading,
    LineReading,
    PointReading,
    RigidMotionReading,
)
from stereorig.server.results.gauges.request import GaugeRequest

_FORMS: list[JsonDict] = [given("rectangle"), given("polygon"), given("outlines")]


class Region(settings.Region):
    """Region of interest: one of rectangle, polygon and outlines, a mask if wanted, cracks and holes.

    No subset, neighbour or start value reaches over a crack, a hole's border or the mask's black.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [*_FORMS, given("mask_png_base64")],
            "not": {"anyOf": [{"allOf": list(two)} for two in combinations(_FORMS, 2)]},
        }
    )

    mask_png_base64: Annotated[str, StringConstraints(max_length=20_000_000)] | None = Field(
        None, description="Image of camera 1's size, white where points are allowed."
    )

    @model_validator(mode="after")
    def _some_form(self) -> Self:
        forms = sum([self.rectangle is not None, self.polygon is not None, bool(self.outlines)])
        if forms > 1:
            raise ValueError("give a rectangle, a polygon or outlines, not several of them")
        if not forms and self.mask_png_base64 is None:
            raise ValueError("give a rectangle, a polygon, outlines or a mask")
        return self


#: in place of a region that neither the request nor a recipe gives
_MISSING: Any = type("Missing", (), {"__repr__": lambda _: "nothing"})()


def _none_yet() -> Any:
    """Return nothing, in place of the region that a recipe gives."""
    return None


class StrainRequest(settings.StrainSettings):
    """Strain over a virtual gauge, (window - 1) spacing_px + subset_px wide."""


class AnalysisRequest(settings.AnalysisSettings):
    """Analysis over a test's steps; a named recipe gives the settings that the request leaves out."""

    model_config = ConfigDict(json_schema_extra=any_of("region", "recipe"))

    recipe: Annotated[str, StringConstraints(min_length=1, max_length=120)] | None = Field(
        None,
        description="Id or name of a kept recipe, or `workspace`: the test's drawing and settings. It gives the "
        "fields that this request leaves out.",
        examples=["r000001-5d0a3f"],
    )
    kind: Literal["profile", "displacement"] = Field(
        "displacement",
        description="Shape only, of each step by itself, or shape and displacement. `profile` if left out with a "
        "projected pattern, which shows no displacement.",
    )
    region: Region = Field(default_factory=_none_yet, description="Region of interest.")
    calibration_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None,
        description="Calibration to measure with, of which the test keeps a copy; `latest`: the newest one accepted; "
        "left out: the test's.",
    )
    noise_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None, description="Noise measurement that weighs the pixels; without it, residuals give the noise."
    )
    steps: Annotated[list[StepNumber], Field(min_length=1, max_length=10000)] | None = Field(
        None, description="Steps to measure; all if left out. The reference is always measured."
    )
    reference: StepNumber = Field(0, description="Reference step.")
    strain: StrainRequest | None = Field(
        default_factory=lambda: StrainRequest.model_validate({}), description="Strain of a displacement; null: none."
    )
    follow: Switch = Field(
        False, description="Measure also each new step of the test, until the analysis is finished or cancelled."
    )
    label: Label = Field("", description="Free text.")

    @model_validator(mode="before")
    @classmethod
    def _of_a_recipe(cls, given: Any) -> Any:
        if isinstance(given, dict) and "region" not in given and given.get("recipe") is None:
            return {**given, "region": _MISSING}
        return given

    @field_validator("region", mode="before")
    @classmethod
    def _there(cls, given: Any) -> Any:
        if given is _MISSING:
            raise PydanticKnownError("missing")
        return given

    @model_validator(mode="before")
    @classmethod
    def _shapes_alone(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("pattern") == "projected":
            return {"kind": "profile", **given}
        return given

    @model_validator(mode="after")
    def _follows_or_names(self) -> Self:
        if self.follow and self.steps is not None:
            raise disagreement("give steps or follow, not both")
        return self

    def stored(self) -> StoredSettings:
        """Return the settings as results keep them, without the noise model."""
        asked = self.model_dump(exclude={"kind", "label", "steps", "noise_id", "calibration_id", "follow", "recipe"})
        mask = asked["region"].pop("mask_png_base64")
        asked["region"]["mask"] = None if mask is None else "mask.png"
        return StoredSettings.model_validate(asked)


class ContinueRequest(Request):
    """Continuation of an analysis."""

    other_version: Switch = Field(
        False, description="Continue although another version of the program began it: its steps might not agree."
    )


class AnalysisAccepted(Accepted):
    """An analysis was begun."""

    analysis_id: str = Field(description="Id of the analysis.", examples=["a000001-77d0b3"])


class DenseFigures(Reply):
    """A dense field in a few numbers."""

    method: str = Field(description="Name of the method.", examples=["dense, shared windows"])
    file: str | None = Field(None, description="Its file, in the analysis' folder; null: there is none.")
    reason: str | None = Field(None, description="Why there is none.")
    step_px: int | None = Field(None, description="Distance of vectors.")
    window_px: int | None = Field(None, description="Width of the window of each; neighbours share its pixels.")
    vectors: int | None = Field(None, description="Number of vectors.")
    valid: int | None = Field(None, description="Vectors with values.")


class StepFigures(Reply):
    """A field in a few numbers; `status`, `strain`, `patch` and further figures as in summary.json."""

    n: int = Field(description="Number of the step.")
    kind: Literal["shape", "displacement"] | None = Field(None, description="Kind of measurement.")
    points: int | None = Field(None, description="Points in the region.")
    valid: int | None = Field(None, description="Points with values.")
    valid_fraction: float | None = Field(None, description="Their share.")
    status: dict[str, int] | None = Field(None, description="Points by status.")
    camera_motion: CameraMotion | None = Field(
        None, description="Motion of a camera, by the epipolar offset; null: too few points."
    )
    systematic: SystematicTerms | None = Field(
        None, description="Errors that no standard uncertainty holds; null: not estimated."
    )
    dense: DenseFigures | None = Field(None, description="Its dense field; null: none was asked for.")
    wall_s: float | None = Field(None, description="Seconds that the step took.")


class AnalysisSummary(Reply):
    """Summary of an analysis; as summary.json."""

    state: JobState = Field("interrupted", description="Final state of its job.")
    steps: list[StepFigures] = Field(default_factory=list, description="An entry a finished step, in their order.")
    steps_failed: dict[str, JobProblem] = Field(
        default_factory=dict, description="The problem of each step that could not be measured, by its number."
    )


class AnalysisReply(Reply):
    """An analysis: its settings and its progress."""

    id: str = Field(description="Id.")
    test_id: str = Field(description="Its test.")
    kind: Literal["profile", "displacement"] = Field(description="Kind of computation.")
    state: JobState = Field(description="State of its job.")
    job_id: str | None = Field(None, description="Its job; the last one, if it was continued.")
    follow: bool = Field(False, description="True if it measures also each new step.")
    n_steps: int = Field(0, description="Number of the steps that it measures.")
    n_finished: int = Field(0, description="Number of the steps whose results can be read now.")
    n_failed: int = Field(0, description="Number of the steps that could not be measured.")
    steps: list[int] = Field(
        default_factory=list,
        description="Steps that it measures, the reference first. Of this list, of `steps_finished` and of "
        "`steps_failed` the first 100 are here, of `summary.steps` the first 50; the others come from "
        "GET .../analyses/{analysis_id}/steps.",
    )
    calibration_id: str | None = Field(None, description="Calibration that it is measured with; null: not known.")
    calibration_sha256: str | None = Field(None, description="Checksum of that calibration's file.")
    settings: StoredSettings = Field(description="Settings, fixed.")
    steps_finished: list[int] = Field(description="Steps whose results can be read now.")
    steps_failed: dict[str, JobProblem] = Field(
        default_factory=dict, description="The problem of each step that could not be measured, by its number."
    )
    summary: AnalysisSummary | None = Field(None, description="Counts, residuals and timings of each step.")
    stale: bool = Field(
        False, description="True if steps, the reference or the calibration are gone or were replaced since."
    )
    stale_reasons: list[str] = Field(default_factory=list, description="Inputs that are gone or were replaced.")
    warnings: list[AnalysisWarning] = Field(
        default_factory=list, description="Warnings about the results: failed checks first, each with its remedy."
    )


class AnalysisStep(Reply):
    """A step of an analysis."""

    n: int = Field(description="Number of the step.")
    state: Literal["finished", "failed", "waiting"] = Field(
        description="`finished`: its results can be read; `failed`: see `problem`; `waiting`: not measured yet, or not "
        "at all once the analysis' job has ended."
    )
    problem: JobProblem | None = Field(None, description="The reason why it could not be measured.")
    figures: StepFigures | None = Field(
        None, description="Counts, residuals and timings; null: not finished, or not asked for."
    )
    sha256: dict[str, str] | None = Field(None, description="Checksums of the images that it is measured from.")


class AnalysisStepList(Listing):
    """Steps of an analysis, in order of their numbers."""

    steps: list[AnalysisStep] = Field(description="Entry of each.")


class AnalysisList(Listing):
    """A test's analyses, oldest first."""

    analyses: list[AnalysisEntry] = Field(description="Short entry of each.")


class FieldList(Reply):
    """The variables of a step's result."""

    fields: list[FieldVariable] = Field(description="Every variable.")
    cuts_px: list[tuple[float, float, float, float]] = Field(
        description="Straight pieces x0, y0, x1, y1 of the cuts, px of camera 1's reference image; empty: none."
    )
    uncertainty: Uncertainty = Field(description="Terms that the step's uncertainties include.")
    frame: str = Field("", description="Frame of positions, displacements and strain.")


class FieldReply(Reply):
    """One variable of one step's result."""

    name: str = Field(description="Variable.")
    units: str = Field(description="Unit.")
    long_name: str = Field("", description="Meaning.")
    shape: list[int] = Field(description="Rows and columns (and further axes).")
    rows: str = Field("", description="Rows of the grid, start:stop:step.")
    cols: str = Field("", description="Columns of the grid, start:stop:step.")
    values: Nested = Field(description="Nested rows; null if the point failed.")
    uncertainty: Uncertainty | None = Field(None, description="Terms that the step's uncertainties include.")
    frame: str = Field("", description="Frame of the values; empty if they are the same in every frame.")


class ProbeReply(Probe):
    """Everything known about the measurement point nearest to a pixel."""

    step: int = Field(description="Step.")


class GaugeStep(Reply):
    """Gauge readings of one step."""

    n: int = Field(description="Number of the step.")
    kind: str = Field(description="`shape` or `displacement`.")
    label: str = Field(description="The step's label.")
    load_n: float | None = Field(None, description="The step's load in newton.")
    time_s: float | None = Field(None, description="Seconds since the reference; null where a time is not known.")
    channels: dict[str, float] = Field(default_factory=dict, description="The step's channels, by name.")
    channel_u: dict[str, float] = Field(
        default_factory=dict, description="Standard uncertainty of those that the rig file names."
    )
    rigid_motion: RigidMotionReading | None = Field(
        None, description="The motion that was taken out, with its covariance."
    )
    points: list[PointReading] = Field(default_factory=list, description="Values at positions.")
    extensometers: list[ExtensometerReading] = Field(default_factory=list, description="Lengths, elongations, strains.")
    lines: list[LineReading] = Field(default_factory=list, description="Values along lines; null where missing.")
    areas: list[AreaReading] = Field(default_factory=list, description="Statistics, with the mean's uncertainty.")
    not_told: list[str] = Field(
        default_factory=list, description="Causes that the budgets do not separate, and terms that they do not include."
    )
    differences: list[DifferenceReading] = Field(
        default_factory=list, description="From the step of `difference_from`; empty in that step itself."
    )
    problem: JobProblem | None = Field(None, description="Problem that left the step without readings.")


class MeasuredWith(Reply):
    """A calibration that results were measured with."""

    id: str | None = Field(None, description="Its id; null: not known.")
    sha256: str | None = Field(None, description="Checksum of its file.")


class GaugesReply(Reply):
    """Readings over the steps; each number with `value`, `sigma` (standard uncertainty) and `units`."""

    software_version: str = Field(description="Program that read them.")
    settings: GaugeRequest = Field(description="The request, with its defaults.")
    calibration: MeasuredWith = Field(description="Calibration that was measured with.")
    inputs_sha256: dict[str, str] = Field(description="Checksum of each result file.")
    stale: bool = Field(False, description="True if inputs or results are gone or were replaced since.")
    stale_reasons: list[str] = Field(default_factory=list, description="Inputs that are gone or were replaced.")
    frame: str = Field(description="Frame of all positions and displacements.")
    subset_px: float = Field(description="Subset of the measurement; determines which pixels neighbours share.")
    smoothing_window: int | None = Field(None, description="Points over which displacements were smoothed.")
    alignment: FrameReading | None = Field(None, description="The frame, and its uncertainty.")
    uncertainty: Uncertainty = Field(
        description="Meaning of the uncertainties, and the terms that they include in all steps."
    )
    channel_units: dict[str, str] = Field(
        default_factory=dict, description="Unit of each channel: stated by a record, else as its name ends."
    )
    steps: list[GaugeStep] = Field(description="Readings of each step of the page.")
    next_cursor: str | None = Field(None, description="Send it as `cursor` for the next page; null: that was all.")
