"""Request for a set of gauges; the same for the command line and the API."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import ConfigDict, Field, StringConstraints, model_validator

from stereorig.core.settings import CoverageFields, Pixel, Whole, disagreement
from stereorig.server.base.models import Number, Request, StepNumber, Switch, any_of, given, not_both, one_of

PositionPx = tuple[Pixel, Pixel]
PositionMm = tuple[Number, Number]
PositionXyz = tuple[Number, Number, Number]
Name = Annotated[str, StringConstraints(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f,;\"]+$")]
Variable = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
_MAX_GAUGES = 200


class _Named(Request):
    name: Name | None = Field(None, description="Its name in the answer; p1, e1, l1, a1 ... if left out.")


class PointGauge(_Named):
    """Values at one position."""

    model_config = ConfigDict(json_schema_extra=one_of("xy_px", "xy_mm"))

    xy_px: PositionPx | None = Field(
        None, description="Position in camera 1's reference image.", examples=[[210.0, 180.5]]
    )
    xy_mm: PositionMm | None = Field(
        None, description="Position, as X and Y of the reference in the frame asked for; instead of xy_px."
    )

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        if (self.xy_px is None) == (self.xy_mm is None):
            raise ValueError("give xy_px or xy_mm")
        return self

    def positions(self) -> tuple[list[PositionMm], bool]:
        """Return the position, and True if it is given in mm."""
        return [p for p in (self.xy_px, self.xy_mm) if p is not None], self.xy_px is None


class ExtensometerGauge(_Named):
    """A virtual extensometer."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"allOf": [given("a_px"), given("b_px")], "not": given("ends_mm")},
                {**given("ends_mm"), "not": any_of("a_px", "b_px")},
            ]
        }
    )

    a_px: PositionPx | None = Field(None, description="One end.", examples=[[150.0, 200.0]])
    b_px: PositionPx | None = Field(None, description="The other end.", examples=[[350.0, 200.0]])
    ends_mm: tuple[PositionMm, PositionMm] | None = Field(
        None, description="Both ends as X and Y of the reference in the frame asked for; instead of a_px and b_px."
    )

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        given = [v is not None for v in (self.a_px, self.b_px, self.ends_mm)]
        if given not in ([True, True, False], [False, False, True]):
            raise ValueError("give a_px and b_px, or ends_mm")
        return self

    def positions(self) -> tuple[list[PositionMm], bool]:
        """Return both ends, and True if they are given in mm."""
        if self.a_px is not None and self.b_px is not None:
            return [self.a_px, self.b_px], False
        return list(self.ends_mm or ()), True


class LineGauge(_Named):
    """Values along a polyline."""

    vertices_px: list[PositionPx] = Field(
        description="Its corners.", min_length=2, max_length=1000, examples=[[[150.0, 200.0], [350.0, 200.0]]]
    )
    count: Annotated[Whole, Field(ge=2, le=100_000)] | None = Field(
        None, description="Number of positions, both ends included; one a grid spacing if left out."
    )


class _Area(Request):
    model_config = ConfigDict(json_schema_extra=not_both("rectangle_px", "polygon_px"))

    rectangle_px: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        None, description="x0, y0, x1, y1, inclusive.", examples=[[150, 100, 350, 300]]
    )
    polygon_px: list[PositionPx] | None = Field(None, description="Corners.", min_length=3, max_length=1000)

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if self.rectangle_px is not None and self.polygon_px is not None:
            raise ValueError("give rectangle_px or polygon_px, not both")
        if self.rectangle_px is not None:
            x0, y0, x1, y1 = self.rectangle_px
            if x1 <= x0 or y1 <= y0:
                raise disagreement("rectangle_px is empty; give the upper left corner first")
        return self

    def corners(self) -> list[tuple[float, float]] | None:
        """Return the corners; None for the whole field."""
        if self.rectangle_px is None:
            return self.polygon_px
        x0, y0, x1, y1 = self.rectangle_px
        return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


class AreaGauge(_Area, _Named):
    """Statistics over a rectangle or polygon; over the whole field if neither is given."""


class RigidRemoval(_Area):
    """Remove the best-fit rigid motion from every step, fitted over an area or the whole field."""

    robust: Switch = Field(False, description="Fit robustly: outliers have little weight.")


class PlaneAlignment(_Area):
    """Z = 0 in the best-fit plane of the reference's points in an area or the whole field."""

    kind: Literal["plane"] = Field(description="Best-fit plane.")
    x_direction: tuple[Number, Number, Number] | Literal["image_rows"] = Field(
        (1.0, 0.0, 0.0),
        description="Direction in the system frame whose part along the plane becomes X; `image_rows`: along camera "
        "1's image rows.",
    )
    x_line_px: tuple[PositionPx, PositionPx] | None = Field(
        None, description="X runs from the first to the second of these positions; instead of x_direction."
    )


class ThreeTwoOneAlignment(Request):
    """Three positions on the plane Z = 0, two on the X axis, one at X = 0."""

    kind: Literal["3-2-1"] = Field(description="3-2-1.")
    positions_px: Annotated[list[PositionPx], Field(min_length=6, max_length=6)] = Field(
        description="Six positions: plane, plane, plane, from, to, origin."
    )


class GivenAlignment(Request):
    """A frame that is written out."""

    kind: Literal["given"] = Field(description="Written out.")
    rotation: tuple[PositionXyz, PositionXyz, PositionXyz] = Field(
        description="Its axes X, Y, Z as rows, in the system frame.", examples=[[[0, 1, 0], [-1, 0, 0], [0, 0, 1]]]
    )
    origin_mm: PositionXyz = Field((0.0, 0.0, 0.0), description="Its origin in the system frame.")


Alignment = Annotated[PlaneAlignment | ThreeTwoOneAlignment | GivenAlignment, Field(discriminator="kind")]


class GaugeRequest(CoverageFields, Request):
    """A set of gauges, read in every step."""

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [
                {"required": ["points"], "properties": {"points": {"minItems": 1}}},
                {"required": ["extensometers"], "properties": {"extensometers": {"minItems": 1}}},
                {"required": ["lines"], "properties": {"lines": {"minItems": 1}}},
                {"required": ["areas"], "properties": {"areas": {"minItems": 1}}},
                given("align"),
                given("remove_rigid"),
            ]
        }
    )

    points: list[PointGauge] = Field(default_factory=list, description="Points.", max_length=_MAX_GAUGES)
    extensometers: list[ExtensometerGauge] = Field(
        default_factory=list, description="Virtual extensometers.", max_length=_MAX_GAUGES
    )
    lines: list[LineGauge] = Field(default_factory=list, description="Lines.", max_length=_MAX_GAUGES)
    areas: list[AreaGauge] = Field(default_factory=list, description="Areas.", max_length=_MAX_GAUGES)
    variables: Annotated[list[Variable], Field(min_length=1, max_length=50)] | None = Field(
        None,
        description="Variables of the result files to read at points, lines and areas; position and displacement if "
        "left out.",
        examples=[["u_mm", "w_mm"]],
    )
    align: Alignment | None = Field(None, description="Frame to express everything in; the system frame if left out.")
    remove_rigid: RigidRemoval | None = Field(None, description="Remove the rigid motion first; null keeps it.")
    steps: Annotated[list[StepNumber], Field(min_length=1, max_length=10_000)] | None = Field(
        None, description="Steps to read; all if left out."
    )
    difference_from: StepNumber | None = Field(
        None,
        description="Step whose readings of points, extensometers and areas' means are also subtracted from each "
        "other step's: the uncertainty that both share cancels. null: no differences.",
        examples=[1],
    )

    @model_validator(mode="after")
    def _something_named_once(self) -> Self:
        lists: dict[str, Sequence[_Named]] = {
            "p": self.points,
            "e": self.extensometers,
            "l": self.lines,
            "a": self.areas,
        }
        names: set[str] = set()
        for letter, gauges in lists.items():
            for k, gauge in enumerate(gauges):
                gauge.name = gauge.name or f"{letter}{k + 1}"
                if gauge.name in names:
                    raise disagreement(f"two gauges have the name {gauge.name}")
                names.add(gauge.name)
        if not names and self.align is None and self.remove_rigid is None:
            raise ValueError("give a point, an extensometer, a line, an area, align or remove_rigid")
        return self
