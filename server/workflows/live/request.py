"""Request of a live measurement: gauges, region and settings."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, model_validator

from stereorig.core.settings import (
    DEFAULT_INTERPOLATION,
    DEFAULT_REFERENCE_UPDATE,
    SPACING_PX,
    Interpolation,
    Outline,
    PatchSetting,
    PixelPosition,
    ReferenceUpdate,
    Region,
    SpacingPx,
    SubsetPx,
    Whole,
    disagreement,
)
from stereorig.server.base.models import Number, Request, StepNumber, Switch, given
from stereorig.server.results.gauges.request import Name

_MAX_GAUGES = 50
#: of 9 points and more a millisecond is little; at the default of a stored analysis a thousand points take two frames
_SUBSET_PX = 21


class _LiveGauge(Request):
    name: Name = Field(description="Its name, by which it is read.", examples=["e1"])


class LivePoint(_LiveGauge):
    """Displacement at a position."""

    xy_px: PixelPosition = Field(description="Position in camera 1's reference image.", examples=[[128.0, 120.0]])

    def positions(self) -> list[PixelPosition]:
        """Return its position."""
        return [self.xy_px]


class LiveExtensometer(_LiveGauge):
    """A virtual extensometer."""

    a_px: PixelPosition = Field(description="One end.", examples=[[128.0, 80.0]])
    b_px: PixelPosition = Field(description="The other end.", examples=[[128.0, 160.0]])

    @model_validator(mode="after")
    def _apart(self) -> Self:
        if self.a_px == self.b_px:
            raise disagreement("both ends of an extensometer are at one position")
        return self

    def positions(self) -> list[PixelPosition]:
        """Return both ends."""
        return [self.a_px, self.b_px]


class LiveArea(_LiveGauge, Outline):
    """Mean displacement and strain over a rectangle, a polygon or a circle, from a plane through its points."""

    def outline(self) -> Outline:
        """Return its outline."""
        return Outline(rectangle=self.rectangle, polygon=self.polygon, circle=self.circle)


class LiveRegion(Region):
    """Region of a live measurement, as of an analysis, without a mask."""


class LiveSettings(Request):
    """A live measurement: gauges, or a field of points, and how they are measured."""

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [
                {"required": ["points"], "properties": {"points": {"minItems": 1}}},
                {"required": ["extensometers"], "properties": {"extensometers": {"minItems": 1}}},
                {"required": ["areas"], "properties": {"areas": {"minItems": 1}}},
                {"allOf": [given("region"), {"required": ["field"], "properties": {"field": {"const": True}}}]},
            ]
        }
    )

    reference: StepNumber = Field(0, description="Step that everything is compared with; its images are stored.")
    points: list[LivePoint] = Field(default_factory=list, description="Points.", max_length=_MAX_GAUGES)
    extensometers: list[LiveExtensometer] = Field(
        default_factory=list, description="Virtual extensometers.", max_length=_MAX_GAUGES
    )
    areas: list[LiveArea] = Field(default_factory=list, description="Areas.", max_length=_MAX_GAUGES)
    region: LiveRegion | None = Field(None, description="Area of the points; about the gauges if left out.")
    field: Switch = Field(False, description="Measure and hand out all points of the region, as a coarse field.")
    subset_px: SubsetPx = _SUBSET_PX
    spacing_px: SpacingPx = SPACING_PX.default
    patch: PatchSetting = Field("affine", description="Patch model, as of an analysis.")
    interpolation: Interpolation = Field(DEFAULT_INTERPOLATION, description="B-spline order.")
    reference_update: ReferenceUpdate = Field(
        DEFAULT_REFERENCE_UPDATE,
        description="As of an analysis. A frame that is matched against a later reference takes as long as a step.",
    )
    noise_id: Annotated[str, Field(max_length=40)] | None = Field(
        None, description="Noise measurement that weighs the pixels; null: none."
    )
    silence_ms: Annotated[Number, Field(ge=20.0, le=60_000.0)] = Field(
        100.0, description="Values are marked invalid when no newer ones came for this long."
    )
    audit_every: Annotated[Whole, Field(ge=1, le=1_000_000)] = Field(
        500,
        description="Frames from one that has all the checks of a step to the next; the others have the quick ones.",
    )

    @model_validator(mode="after")
    def _named_once(self) -> Self:
        names = [gauge.name for gauge in (*self.points, *self.extensometers, *self.areas)]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise disagreement(f"two gauges have the name {twice}")
        if not names and not (self.field and self.region is not None):
            raise ValueError("give a gauge, or a region with field = true")
        return self

    def measuring(self) -> tuple[str, ...]:
        """Return the names of the fields that an analysis' settings have too."""
        return ("subset_px", "spacing_px", "patch", "interpolation", "reference_update")

    def plain_gauges(self) -> list[dict[str, Any]]:
        """Return the gauges as a task has them."""
        return [
            *({"name": g.name, "kind": "point", "ends_px": g.positions()} for g in self.points),
            *({"name": g.name, "kind": "extensometer", "ends_px": g.positions()} for g in self.extensometers),
            *({"name": g.name, "kind": "area", "outline": g.outline().model_dump()} for g in self.areas),
        ]
