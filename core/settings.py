"""The settings of a measurement: each parameter with its bounds, default, unit and meaning, stated once.

Requests, the command line's options, the worker's tasks, result files, reports and reference pages derive from these
models; the functions of `core` take their bounds and defaults from here.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import Annotated, Any, Literal, NamedTuple, Self, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic.config import JsonDict
from pydantic_core import PydanticCustomError

PatchSetting = Literal["affine", "rigid", "quadratic", "auto"]
PATCH_SETTINGS: tuple[PatchSetting, ...] = get_args(PatchSetting)
Interpolation = Literal["cubic", "quintic"]
INTERPOLATIONS: tuple[Interpolation, ...] = get_args(Interpolation)
ReferenceUpdate = Literal["never", "auto", "always"]
REFERENCE_UPDATES: tuple[ReferenceUpdate, ...] = get_args(ReferenceUpdate)
StrainTensor = Literal["green_lagrange", "infinitesimal", "hencky"]
STRAIN_TENSORS: tuple[StrainTensor, ...] = get_args(StrainTensor)
StrainOrder = Literal[1, 2, "auto"]
STRAIN_ORDERS: tuple[StrainOrder, ...] = get_args(StrainOrder)
StartFrom = Literal["previous", "reference"]
SideBySide = Literal["auto", "never"]
Pattern = Literal["surface", "projected"]
DEFAULT_PATCH: PatchSetting = "auto"
DEFAULT_INTERPOLATION: Interpolation = "quintic"
DEFAULT_REFERENCE_UPDATE: ReferenceUpdate = "auto"
#: the nearest wrong match is a speckle of 3 px or more away, and a match starts to slip to it from half of that: 6 sd
DEFAULT_MAX_SIGMA_PX = 0.25
#: of one point among others that are surer: half a pixel is five of it
SINGLE_MAX_SIGMA_PX = 0.1


class Range(NamedTuple):
    """The whole numbers that a parameter can have, ends included."""

    low: int
    high: int
    odd: bool
    default: int

    def holds(self, value: Any) -> bool:
        """Return True for a whole number of the range."""
        whole = not isinstance(value, bool) and int(value) == value
        return whole and self.low <= value <= self.high and (not self.odd or value % 2 == 1)

    def __str__(self) -> str:
        return f"{'an odd' if self.odd else 'a'} whole number from {self.low} to {self.high}"


#: below 9 px a subset holds too few pixels for its twelve unknowns; above 401 px the kernels' sums lose digits
SUBSET_PX = Range(9, 401, True, 33)
SPACING_PX = Range(1, 1000, False, 10)
STRAIN_WINDOW = Range(3, 101, True, 9)
#: no default window: displacements are smoothed only on request
SMOOTHING_WINDOW = Range(3, 51, True, 5)
#: no default in a measurement: a dense field is made only on request; beyond 20 px it is no denser than a usual grid
DENSE_STEP_PX = Range(1, 20, False, 2)
#: a wider Gaussian would leave a handful of independent pixels in the subset
PREFILTER_OF_SUBSET = 0.25
#: beyond it a match is as likely one speckle off
MAX_SIGMA_PX = 1.0
#: the tails of a distribution are not known so far out
MAX_COVERAGE_FACTOR = 10.0
MAX_COVERAGE = 0.999999
MAX_SEEDS = MAX_CUTS = 100
MAX_CORNERS = 1000


def single_sigma_px(max_sigma_px: float) -> float:
    """Return the limit for a point by itself: the stricter one, unless more than the default was asked for."""
    return max_sigma_px if max_sigma_px > DEFAULT_MAX_SIGMA_PX else min(max_sigma_px, SINGLE_MAX_SIGMA_PX)


def _a_number(value: Any) -> Any:
    if isinstance(value, str):
        raise ValueError("must be a number, not text")
    # true would be taken for 1
    if isinstance(value, bool):
        raise ValueError("must be a number, not true or false")
    return value


#: the type keeps null, which every multipleOf holds for, from being excluded
ODD: JsonDict = {"not": {"type": "integer", "multipleOf": 2}}
Real = Annotated[float, BeforeValidator(_a_number)]
Whole = Annotated[int, BeforeValidator(_a_number)]
Pixel = Annotated[Real, Field(allow_inf_nan=False, ge=0.0, le=32767.0)]
SubsetPx = Annotated[
    Whole, Field(ge=SUBSET_PX.low, le=SUBSET_PX.high, description="Subset size, odd.", json_schema_extra=ODD)
]
SpacingPx = Annotated[
    Whole, Field(ge=SPACING_PX.low, le=SPACING_PX.high, description="Distance of neighbouring points, px.")
]
PixelPosition = tuple[Pixel, Pixel]
Rectangle = tuple[Pixel, Pixel, Pixel, Pixel]


def disagreement(text: str) -> PydanticCustomError:
    """Return the error for values that are right each by itself and cannot be together."""
    return PydanticCustomError("values_disagree", "{text}", {"text": text})


def require_odd(**values: int | None) -> None:
    """Raise ValueError for an even number, by its name."""
    for name, value in values.items():
        if value is not None and value % 2 == 0:
            raise ValueError(f"{name} must be odd, got {value}")


class Settings(BaseModel):
    """A closed group of parameters."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


_FORMS = ("rectangle", "polygon", "circle")


class Outline(Settings):
    """A closed outline: a rectangle, a polygon or a circle, in camera 1's reference image."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": [form], "properties": {form: {"not": {"type": "null"}}}} for form in _FORMS]
        }
    )

    rectangle: Rectangle | None = Field(None, description="x0, y0, x1, y1, inclusive.", examples=[[120, 100, 400, 380]])
    polygon: list[PixelPosition] | None = Field(None, description="Corners.", min_length=3, max_length=MAX_CORNERS)
    circle: tuple[Pixel, Pixel, Annotated[Pixel, Field(gt=0.0)]] | None = Field(
        None, description="x and y of its centre, and its radius.", examples=[[240, 180, 60]]
    )

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if sum(getattr(self, form) is not None for form in _FORMS) != 1:
            raise ValueError("give a rectangle, a polygon or a circle for each outline, and only one of them")
        return self


class Region(Settings):
    """Region of interest: a rectangle, a polygon or several outlines, or a mask alone; cracks and holes.

    No subset, neighbour or start value crosses a crack, a hole's border or the mask's black.
    """

    rectangle: Rectangle | None = Field(
        None, description="x0, y0, x1, y1 in camera 1's reference image, inclusive.", examples=[[120, 100, 400, 380]]
    )
    polygon: list[PixelPosition] | None = Field(None, description="Corners.", min_length=3, max_length=MAX_CORNERS)
    outlines: list[Outline] = Field(
        [],
        description="Rectangles, polygons and circles, in place of a single rectangle or polygon: points lie where any "
        "of them is. They need not touch.",
        max_length=MAX_CUTS,
        examples=[[{"circle": [240, 180, 60]}, {"rectangle": [300, 120, 420, 240]}]],
    )
    cracks: list[Annotated[list[PixelPosition], Field(min_length=2, max_length=MAX_CORNERS)]] = Field(
        [],
        description="Lines in camera 1's reference image, each the points that it goes through.",
        max_length=MAX_CUTS,
        examples=[[[[150, 240], [260, 238.5], [362, 241]]]],
    )
    holes: list[Annotated[list[PixelPosition], Field(min_length=3, max_length=MAX_CORNERS)]] = Field(
        [],
        description="Corners of polygons in camera 1's reference image inside which nothing is measured.",
        max_length=MAX_CUTS,
        examples=[[[[200, 180], [240, 180], [240, 220], [200, 220]]]],
    )


class StrainSettings(Settings):
    """Strain over a virtual gauge, (window - 1) spacing_px + subset_px wide."""

    window: Annotated[Whole, Field(ge=STRAIN_WINDOW.low, le=STRAIN_WINDOW.high)] = Field(
        STRAIN_WINDOW.default, description="Points across the gauge, odd.", json_schema_extra=ODD
    )
    order: StrainOrder = Field(
        "auto",
        description="Fit planes (1) or quadratics (2); they differ only where an edge, a hole or a cut takes points "
        "away. auto: there whichever has the smaller total error, point by point.",
    )
    tensor: StrainTensor = Field("green_lagrange", description="Which strain is reported.")

    @model_validator(mode="after")
    def _odd(self) -> Self:
        require_odd(window=self.window)
        return self


class AnalysisSettings(Settings):
    """Settings of a measurement, except its images and its calibration."""

    region: Region = Field(description="Where points may lie.")
    subset_px: SubsetPx = SUBSET_PX.default
    spacing_px: SpacingPx = SPACING_PX.default
    patch: PatchSetting = Field(
        DEFAULT_PATCH,
        description="Patch model: affine and rigid are planes; quadratic has a second-order shape and motion and about "
        "twice the noise; auto takes affine or quadratic, whichever has the smaller total error, shape and motion "
        "separately; each step's summary has the choice and its reason under patch.",
    )
    interpolation: Interpolation = Field(DEFAULT_INTERPOLATION, description="B-spline order.")
    prefilter_px: Annotated[Real, Field(ge=0.0, le=PREFILTER_OF_SUBSET * SUBSET_PX.high)] = Field(
        0.0,
        description="Sd of a Gaussian that all images are blurred with, px, at most a quarter of subset_px; 0: none.",
    )
    max_sigma_px: Annotated[Real, Field(gt=0.0, le=MAX_SIGMA_PX)] = Field(
        DEFAULT_MAX_SIGMA_PX,
        description="Standard deviation of a point's match in any image, in depth too, px, beyond which it is "
        "rejected: larger keeps what is uncertain, with its standard deviation; smaller keeps what is sure. Up to the "
        f"default, a single point that is less sure than the field's usual one is rejected from "
        f"{SINGLE_MAX_SIGMA_PX:g} px on.",
    )
    keep_rejected: bool = Field(
        False,
        description="Keep what was measured at rejected points, apart and without uncertainty: `rejected_*` of the "
        "result files. To look at, not to use.",
    )
    seeds: Annotated[list[PixelPosition], Field(min_length=1, max_length=MAX_SEEDS)] | None = Field(
        None, description="Start points in camera 1's reference image; found automatically if left out."
    )
    seeds_cam2: Annotated[list[PixelPosition | None], Field(max_length=MAX_SEEDS)] | None = Field(
        None,
        description="The same points in camera 2's reference image, where known: as many as `seeds`, null where not. "
        "They start the search there; one further than 8 px from its epipolar line is refused.",
    )
    reference_update: ReferenceUpdate = Field(
        DEFAULT_REFERENCE_UPDATE,
        description="never: match every step against the reference (total); always: against the step before "
        "(incremental); auto: against the reference, or a later one where that fails. Displacements are totals in any "
        "case; each step's summary has what it was matched against under reference_step.",
    )
    start_from: StartFrom = Field(
        "previous",
        description="Where a step's start values come from. previous: the step before, and steps are measured one "
        "after another. reference: the reference alone; steps need one another for nothing, and a cluster measures as "
        "many at once as it has workers. It needs reference_update = never, which is then the default.",
    )
    side_by_side: SideBySide = Field(
        "auto",
        description="Whether steps that start from the one before are measured several at once. auto: where there is "
        "more than one worker, in blocks; each block's first step starts from seeds and is measured again from the "
        "step before it, and what does not agree with that is measured anew, so that results are those of steps one "
        "after another within 2 % of their standard uncertainty. never, and always with reference_update = always: "
        "one after another.",
    )
    pattern: Pattern = Field(
        "surface",
        description="What the cameras see. surface: a texture that moves with the surface. projected: light that stays "
        "where it is as the surface moves through it: the shape of every step can be measured, displacement and strain "
        "cannot, and are refused.",
    )
    strain: StrainSettings | None = Field(
        default_factory=lambda: StrainSettings.model_validate({}), description="Strain of a displacement; null: none."
    )
    smoothing_window: Annotated[Whole, Field(ge=SMOOTHING_WINDOW.low, le=SMOOTHING_WINDOW.high)] | None = Field(
        None,
        description="Points across the square window over which a quadratic smooths the displacement, odd; strain and "
        "gauges then take its value. null: as measured.",
        json_schema_extra=ODD,
    )
    dense_step_px: Annotated[Whole, Field(ge=DENSE_STEP_PX.low, le=DENSE_STEP_PX.high)] | None = Field(
        None,
        description="Distance of the vectors of a dense field, px, at most spacing_px: beside each step a field of "
        "vectors in one step from the ordinary field, each over the whole subset about it; neighbours correlate by the "
        "pixels they share. null: none.",
    )

    @model_validator(mode="before")
    @classmethod
    def _shape_alone(cls, given: Any) -> Any:
        # settings that are left out take the values that a projected pattern allows; a setting against it is refused
        # with the reason
        if isinstance(given, dict) and given.get("pattern") == "projected":
            return {"strain": None, "reference_update": "never", **given}
        return given

    @model_validator(mode="before")
    @classmethod
    def _starts_alone(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("start_from") == "reference":
            if given.get("reference_update", "never") != "never":
                raise disagreement("start_from = 'reference' needs reference_update = 'never'")
            return {**given, "reference_update": "never"}
        return given

    @model_validator(mode="after")
    def _agree(self) -> Self:
        require_odd(subset_px=self.subset_px, smoothing_window=self.smoothing_window)
        if self.seeds_cam2 is not None and len(self.seeds_cam2) != len(self.seeds or []):
            raise disagreement(f"seeds_cam2 has {len(self.seeds_cam2)} positions for {len(self.seeds or [])} seeds")
        if self.prefilter_px > PREFILTER_OF_SUBSET * self.subset_px:
            raise disagreement(f"prefilter_px must be at most a quarter of subset_px, {self.subset_px}")
        if self.dense_step_px is not None and self.dense_step_px > self.spacing_px:
            raise disagreement(
                f"dense_step_px is {self.dense_step_px}; it must be at most spacing_px, {self.spacing_px}"
            )
        return self


class NoiseRecord(BaseModel):
    """The noise models that weighed the pixels: the numbers used, and their source."""

    model_config = ConfigDict(extra="allow", frozen=True)

    sha256: str = Field(description="Checksum of the noise models.")
    noise_id: str | None = Field(None, description="Id of the noise measurement; null where it came from a file.")


class StoredOutline(Outline):
    """An outline as stored in results."""

    rectangle: tuple[float, float, float, float] | None = Field(None, description="x0, y0, x1, y1; null: another form.")
    polygon: list[tuple[float, float]] | None = Field(None, description="Corners x, y; null: another form.")
    circle: tuple[float, float, float] | None = Field(None, description="x, y, radius; null: another form.")


class StoredRegion(Region):
    """A region as stored in results; checked against its image when it was made."""

    rectangle: tuple[float, float, float, float] | None = Field(None, description="x0, y0, x1, y1; null: none.")
    polygon: list[tuple[float, float]] | None = Field(None, description="Corners x, y; null: none.")
    outlines: list[StoredOutline] = Field(default=[], description="Rectangles, polygons and circles, all of them.")  # type: ignore[assignment]
    cracks: list[list[tuple[float, float]]] = Field(default=[], description="Lines of points x, y along cracks.")
    holes: list[list[tuple[float, float]]] = Field(default=[], description="Polygons of corners x, y without points.")
    mask: str | None = Field(None, description="Record of the mask; null: none.")


class StoredSettings(AnalysisSettings):
    """Settings as stored in results, with records in place of files."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    region: StoredRegion = Field(description="Region of interest.")
    reference: int = Field(0, description="Reference step.")
    noise: NoiseRecord | None = Field(None, description="Noise models that weighed the pixels; null: none.")


class CoverageFields(BaseModel):
    """Width of the interval that is stated with a value; by default one standard uncertainty."""

    k: Annotated[Real, Field(gt=0.0, le=MAX_COVERAGE_FACTOR)] | None = Field(
        None,
        description="Coverage factor: expanded uncertainties are k standard uncertainties. 1 if left out.",
        examples=[2.0],
    )
    coverage: Annotated[Real, Field(gt=0.0, le=MAX_COVERAGE)] | None = Field(
        None,
        description="In place of k: the share of a normal distribution (infinite degrees of freedom) that the interval "
        "is to hold; 0.95 is k = 1.96.",
    )

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if self.k is not None and self.coverage is not None:
            raise disagreement("give k or coverage, not both")
        return self

    @property
    def factor(self) -> float:
        """The coverage factor k."""
        if self.coverage is not None:
            return NormalDist().inv_cdf(0.5 * (1.0 + self.coverage))
        return 1.0 if self.k is None else self.k

    @property
    def share(self) -> float:
        """The share of a normal distribution within k standard uncertainties."""
        return 2.0 * NormalDist().cdf(self.factor) - 1.0 if self.coverage is None else self.coverage


class Coverage(CoverageFields, Settings):
    """A coverage factor, given by itself or by the share of a normal distribution."""
