"""Analyses and results, as they travel."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, StringConstraints, model_validator

from core.field.points.patch import DEFAULT_PATCH, PatchSetting
from core.field.points.smoothing_record import WIDEST_SMOOTHING
from core.field.prefilter import MOST_OF_SUBSET
from core.field.reference_update import DEFAULT_REFERENCE_UPDATE, ReferenceUpdate
from core.strain.options import DEFAULT_WINDOW, WIDEST_WINDOW, StrainTensor
from server.api.models.jobs import Accepted, JobProblem
from server.api.models.tests import AnalysisEntry
from server.base.models import (
    ODD,
    JobState,
    Label,
    Listing,
    Pixel,
    Real,
    Reply,
    Request,
    StepNumber,
    Switch,
    Whole,
    any_of,
    disagreement,
    not_both,
)


class Region(Request):
    """Where points may lie: one of rectangle and polygon, a mask if wanted, cracks and holes.

    No subset, neighbour or start value reaches over a crack, a hole's border or the mask's black.
    """

    model_config = ConfigDict(
        json_schema_extra={**any_of("rectangle", "polygon", "mask_png_base64"), **not_both("rectangle", "polygon")}
    )

    rectangle: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        None, description="x0, y0, x1, y1 in camera 1's reference image, inclusive.", examples=[[120, 100, 400, 380]]
    )
    polygon: list[tuple[Pixel, Pixel]] | None = Field(None, description="Corners.", min_length=3, max_length=1000)
    mask_png_base64: Annotated[str, StringConstraints(max_length=20_000_000)] | None = Field(
        None, description="Image of camera 1's size, white where points may lie."
    )
    cracks: list[Annotated[list[tuple[Pixel, Pixel]], Field(min_length=2, max_length=1000)]] = Field(
        [],
        description="Lines in camera 1's reference image, each the points that it goes through.",
        max_length=100,
        examples=[[[[150, 240], [260, 238.5], [362, 241]]]],
    )
    holes: list[Annotated[list[tuple[Pixel, Pixel]], Field(min_length=3, max_length=1000)]] = Field(
        [],
        description="Corners of polygons in camera 1's reference image inside which nothing is measured.",
        max_length=100,
        examples=[[[[200, 180], [240, 180], [240, 220], [200, 220]]]],
    )

    @model_validator(mode="after")
    def _some_form(self) -> Self:
        if self.rectangle is not None and self.polygon is not None:
            raise ValueError("give a rectangle or a polygon, not both")
        if self.rectangle is None and self.polygon is None and self.mask_png_base64 is None:
            raise ValueError("give a rectangle, a polygon or a mask")
        return self


class StrainRequest(Request):
    """Strain over a virtual gauge, (window - 1) step_px + subset_px wide."""

    window: Annotated[Whole, Field(ge=3, le=WIDEST_WINDOW)] = Field(
        DEFAULT_WINDOW, description="Points across the gauge, odd.", json_schema_extra=ODD
    )
    order: Literal[1, 2] = Field(
        1, description="Fit planes or quadratics; they differ only where an edge, a hole or a cut takes points away."
    )
    tensor: StrainTensor = Field("green_lagrange", description="Which strain is told.")

    @model_validator(mode="after")
    def _odd(self) -> Self:
        if self.window % 2 == 0:
            raise ValueError(f"window must be odd, got {self.window}")
        return self


class AnalysisRequest(Request):
    """What to compute over a test's steps."""

    kind: Literal["profile", "displacement"] = Field(
        "displacement", description="Shape only, or shape and displacement."
    )
    region: Region = Field(description="Where points may lie.")
    subset_px: Annotated[Whole, Field(ge=5, le=255)] = Field(33, description="Subset size, odd.", json_schema_extra=ODD)
    step_px: Annotated[Whole, Field(ge=1, le=1000)] = Field(10, description="Distance of neighbouring points.")
    patch: PatchSetting = Field(
        DEFAULT_PATCH,
        description="Patch model: stretch and rigid are planes; curved has a second-order shape and motion and about "
        "twice the noise; auto takes stretch or curved, whichever errs less on the field in all, shape and motion "
        "apart; each step's summary has the choice and its reason under patch.",
    )
    interpolation: Literal["cubic", "quintic"] = Field("quintic", description="B-spline order.")
    prefilter_px: Annotated[Real, Field(ge=0.0, le=64.0)] = Field(
        0.0,
        description="Sd of a Gaussian that all images are blurred with, px, at most a quarter of subset_px; 0: none.",
    )
    seeds: Annotated[list[tuple[Pixel, Pixel]], Field(min_length=1, max_length=100)] | None = Field(
        None, description="Start points in camera 1's reference image; found automatically if left out."
    )
    seeds_cam2: Annotated[list[tuple[Pixel, Pixel] | None], Field(max_length=100)] | None = Field(
        None,
        description="The same points in camera 2's reference image, where known: as many as `seeds`, null where not. "
        "They start the search there; one further than 8 px from its epipolar line is refused.",
    )
    noise_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None, description="Noise measurement whose models weigh the pixels; without it, residuals tell the noise."
    )
    steps: Annotated[list[StepNumber], Field(min_length=1, max_length=10000)] | None = Field(
        None, description="Steps to measure; all if left out. The reference is always measured."
    )
    reference: StepNumber = Field(0, description="Reference step.")
    reference_update: ReferenceUpdate = Field(
        DEFAULT_REFERENCE_UPDATE,
        description="never: match every step against the reference (total); always: against the step before "
        "(incremental); auto: against the reference, or a later one where that fails. Displacements are totals in any "
        "case; each step's summary has what it was matched against under reference_step.",
    )
    start_from: Literal["previous", "reference"] = Field(
        "previous",
        description="Where a step's start values come from. previous: the step before, and steps are measured one "
        "after another. reference: the reference alone; steps need one another for nothing, and a cluster measures as "
        "many at once as it has workers. It needs reference_update = never, which is then the default.",
    )
    strain: StrainRequest | None = Field(
        default_factory=lambda: StrainRequest.model_validate({}), description="Strain of a displacement; null: none."
    )
    smoothing_window: Annotated[Whole, Field(ge=3, le=WIDEST_SMOOTHING)] | None = Field(
        None,
        description="Points across the square window over which a quadratic smooths the displacement, odd; strain and "
        "gauges then take its value. null: as measured.",
        json_schema_extra=ODD,
    )
    follow: Switch = Field(
        False, description="Go on with each step of the test as it lands, until the analysis is finished or cancelled."
    )
    label: Label = Field("", description="Free text.")

    @model_validator(mode="after")
    def _starts_alone(self) -> Self:
        if self.start_from == "reference" and self.reference_update != "never":
            if "reference_update" in self.model_fields_set:
                raise disagreement("start_from = 'reference' needs reference_update = 'never'")
            self.reference_update = "never"
        return self

    @model_validator(mode="after")
    def _follows_or_names(self) -> Self:
        if self.follow and self.steps is not None:
            raise disagreement("give steps or follow, not both")
        return self

    @model_validator(mode="after")
    def _odd(self) -> Self:
        if self.subset_px % 2 == 0:
            raise ValueError(f"subset_px must be odd, got {self.subset_px}")
        if self.smoothing_window is not None and self.smoothing_window % 2 == 0:
            raise ValueError(f"smoothing_window must be odd, got {self.smoothing_window}")
        if self.seeds_cam2 is not None and len(self.seeds_cam2) != len(self.seeds or []):
            raise disagreement(f"seeds_cam2 has {len(self.seeds_cam2)} places for {len(self.seeds or [])} seeds")
        if self.prefilter_px > MOST_OF_SUBSET * self.subset_px:
            raise disagreement(f"prefilter_px must be at most a quarter of subset_px, {self.subset_px}")
        return self


class ContinueRequest(Request):
    """How to go on with an analysis."""

    other_version: Switch = Field(
        False, description="Go on although another version of the program began it: its steps might not agree."
    )


class AnalysisAccepted(Accepted):
    """An analysis was begun."""

    analysis_id: str = Field(description="Id of the analysis.", examples=["a000001-77d0b3"])


class AnalysisReply(Reply):
    """An analysis: its settings, and what is finished."""

    id: str = Field(description="Id.")
    test_id: str = Field(description="Its test.")
    kind: Literal["profile", "displacement"] = Field(description="What it computes.")
    state: JobState = Field(description="State of its job.")
    job_id: str | None = Field(None, description="Its job; the last one, where it was continued.")
    follow: bool = Field(False, description="Whether it goes on with each step that lands.")
    steps: list[int] = Field(default_factory=list, description="Steps that it measures, the reference first.")
    settings: dict[str, Any] = Field(description="Settings, fixed.")
    steps_finished: list[int] = Field(description="Steps whose results can be read now.")
    summary: dict[str, Any] | None = Field(None, description="Counts, residuals and timings of each step.")
    stale: bool = Field(
        False, description="Whether steps, the reference or the calibration are gone or were replaced since."
    )
    stale_reasons: list[str] = Field(default_factory=list, description="What is gone or was replaced.")


class AnalysisList(Listing):
    """A test's analyses, oldest first."""

    analyses: list[AnalysisEntry] = Field(description="What there is to know of each in short.")


class FieldVariable(Reply):
    """A variable of a result."""

    name: str = Field(description="Name.", examples=["w_mm"])
    units: str = Field(description="Unit.", examples=["mm"])
    long_name: str = Field(description="Meaning.")
    dimensions: list[str] = Field(description="Names of its dimensions.", examples=[["row", "col"]])
    shape: list[int] = Field(description="Length of each dimension.", examples=[[4, 6]])
    flags: dict[str, str] | None = Field(None, description="Of a status: what each value means.")
    comparisons: list[str] | None = Field(None, description="Of a correlation: which images its last axis compares.")


class FieldList(Reply):
    """The variables of a step's result."""

    fields: list[FieldVariable] = Field(description="Every variable.")
    cuts_px: list[tuple[float, float, float, float]] = Field(
        description="Straight pieces x0, y0, x1, y1 of the cuts, px of camera 1's reference image; empty: none."
    )


class FieldReply(Reply):
    """One variable of one step's result."""

    name: str = Field(description="Variable.")
    units: str = Field(description="Unit.")
    long_name: str = Field("", description="Meaning.")
    shape: list[int] = Field(description="Rows and columns (and further axes).")
    rows: str = Field("", description="Rows of the grid, start:stop:step.")
    cols: str = Field("", description="Columns of the grid, start:stop:step.")
    values: list[Any] = Field(description="Nested rows; null where the point failed.")


class ProbeValue(Reply):
    """A number, or several, of a point."""

    value: float | int | list[Any] | None = Field(description="The value; null where the point failed.")
    units: str = Field(description="Its unit; `1` of what has none.", examples=["mm"])


class ProbeReply(Reply):
    """Everything known about the measurement point nearest to a pixel."""

    row: int = Field(description="Row of the point.")
    col: int = Field(description="Column of the point.")
    step: int = Field(description="Step.")
    distance_px: float = Field(description="Distance of the pixel asked for from the point.")
    status: str = Field(description="Status of the point.")
    values: dict[str, ProbeValue] = Field(description="Its numbers, by variable.")


class GaugeStep(Reply):
    """What the gauges read in one step."""

    n: int = Field(description="Number of the step.")
    kind: str = Field(description="`shape` or `displacement`.")
    label: str = Field(description="The step's label.")
    load_n: float | None = Field(None, description="The step's load in newton.")
    rigid_motion: dict[str, Any] | None = Field(None, description="The motion that was taken out, with its covariance.")
    points: list[dict[str, Any]] = Field(default_factory=list, description="Values at places.")
    extensometers: list[dict[str, Any]] = Field(default_factory=list, description="Lengths, elongations, strains.")
    lines: list[dict[str, Any]] = Field(default_factory=list, description="Values along lines; null where missing.")
    areas: list[dict[str, Any]] = Field(default_factory=list, description="Statistics, with the mean's uncertainty.")
    problem: JobProblem | None = Field(None, description="Why the step has no readings.")


class GaugesReply(Reply):
    """Readings over the steps; each number with `value`, `sigma` (standard uncertainty) and `units`."""

    software_version: str = Field(description="Program that read them.")
    settings: dict[str, Any] = Field(description="The request, with its defaults.")
    inputs_sha256: dict[str, str] = Field(description="Checksum of each result file.")
    stale: bool = Field(False, description="Whether inputs or results are gone or were replaced since.")
    stale_reasons: list[str] = Field(default_factory=list, description="What is gone or was replaced.")
    frame: str = Field(description="Frame of all positions and displacements.")
    subset_px: float = Field(description="Subset of the measurement; tells which pixels neighbours share.")
    smoothing_window: int | None = Field(None, description="Points over which displacements were smoothed.")
    alignment: dict[str, Any] | None = Field(None, description="The frame that was laid, and its uncertainty.")
    steps: list[GaugeStep] = Field(description="Readings of each step.")
