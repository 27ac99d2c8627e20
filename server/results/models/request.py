"""Request for a comparison with a model; the same for the command line and the API."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, StringConstraints, TypeAdapter

from stereorig.core.settings import Real
from stereorig.server.base.json_values import asked_in
from stereorig.server.base.models import Number, Request, StepNumber, Switch
from stereorig.server.formats.models.read import UNITS, Unit
from stereorig.server.results.gauges.request import GivenAlignment, PositionPx, PositionXyz

_Small = Annotated[Real, Field(ge=0.0, le=1e3, allow_inf_nan=False)]
ArrayName = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f]+$")]


class GivenPlacement(GivenAlignment):
    """The model's axes and origin are known in the system frame."""

    kind: Literal["given"] = Field(description="Written out.")
    rotation: tuple[PositionXyz, PositionXyz, PositionXyz] = Field(
        ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        description="The model's axes X, Y, Z as rows, in the system frame.",
    )
    sigma_mm: _Small = Field(0.0, description="Standard uncertainty of each shift.")
    sigma_deg: _Small = Field(0.0, description="Standard uncertainty of each turn, about the measured points' middle.")


class ThreeTwoOnePlacement(Request):
    """Six measured positions: three on a plane, two on its X axis, one at X = 0."""

    kind: Literal["3-2-1"] = Field(description="3-2-1.")
    positions_px: Annotated[list[PositionPx], Field(min_length=6, max_length=6)] = Field(
        description="Six positions of camera 1's reference image: plane, plane, plane, from, to, origin."
    )
    model_mm: Annotated[list[PositionXyz], Field(min_length=6, max_length=6)] | None = Field(
        None, description="The same six positions on the model; left out, the frame through them is the model's own."
    )


class Marker(Request):
    """A point that is found in the image and on the model."""

    xy_px: PositionPx = Field(description="In camera 1's reference image.", examples=[[210.0, 180.5]])
    model_mm: PositionXyz = Field(description="On the model.", examples=[[0.0, 12.5, 0.0]])


class MarkersPlacement(Request):
    """Least squares through markers."""

    kind: Literal["markers"] = Field(description="Through markers.")
    markers: Annotated[list[Marker], Field(min_length=3, max_length=1000)] = Field(
        description="Three or more that span an area."
    )
    sigma_mm: _Small = Field(
        0.0, description="Standard uncertainty of finding a marker, each axis, besides the measurement's own."
    )


Start = Annotated[GivenPlacement | ThreeTwoOnePlacement | MarkersPlacement, Field(discriminator="kind")]


class BestFitPlacement(Request):
    """The model's surface fitted to the measured shape; motions that the shape leaves open stay as in `start`."""

    kind: Literal["best-fit"] = Field(description="Best fit of the shapes.")
    start: Start = Field(
        default_factory=lambda: GivenPlacement(kind="given"),
        description="First placement of the model; its frame is the system frame if left out.",
    )


ModelPlacement = Annotated[
    GivenPlacement | ThreeTwoOnePlacement | MarkersPlacement | BestFitPlacement, Field(discriminator="kind")
]


_PLACEMENT: TypeAdapter[ModelPlacement] = TypeAdapter(ModelPlacement)


class ModelReading(Request):
    """Reading options of a model's file, and the model's placement."""

    model_config = ConfigDict(protected_namespaces=())

    unit: Unit | None = Field(None, description=f"Unit of length of the file, if it states none: {', '.join(UNITS)}.")
    displacement: ArrayName | None = Field(
        None,
        description="Name of the nodes' displacement, or of its two or three components, with commas between; if left "
        "out, the array whose name means a displacement.",
        examples=["U", "ux,uy,uz"],
    )
    time: Number | None = Field(None, description="Time of the state to take from a series; the last if left out.")
    align: ModelPlacement = Field(
        default_factory=lambda: GivenPlacement(kind="given"),
        description="Placement of the model; in the system frame if left out.",
    )


class Judging(Request):
    """Step to compare with a model, and limits of the judgement."""

    step: StepNumber | None = Field(None, description="Step to compare; the last one measured if left out.")
    tile_px: Annotated[Real, Field(gt=0.0, le=1e5)] | None = Field(
        None, description="Width of a region; an eighth of the field, two subsets at least, if left out."
    )
    confidence: Annotated[Real, Field(ge=0.5, lt=1.0)] = Field(
        0.95, description="Share of right models that are accepted."
    )
    remove_rigid: Switch = Field(
        False, description="Take out the rigid motion between both displacements, as of a rig that moved."
    )
    load_uncertainty: Annotated[Real, Field(ge=0.0, le=1.0)] = Field(
        0.0, description="Relative standard uncertainty of the load; the model's displacement is in proportion to it."
    )
    interpolation: Switch = Field(
        True, description="Count the estimated bias of interpolation, where the result has it, as an uncertainty."
    )


class CompareRequest(ModelReading, Judging):
    """A comparison of one step with a model."""


class ComparisonRequest(Judging):
    """A comparison with a model that is kept with the test."""

    model_config = ConfigDict(protected_namespaces=())

    model_id: Annotated[str, StringConstraints(max_length=40)] = Field(
        description="Id of the model.", examples=["m000001-4b1e09"]
    )
    align: ModelPlacement | None = Field(None, description="Placement of the model; as stored with it if left out.")

    def with_model(self, reading: Mapping[str, object]) -> CompareRequest:
        """Return the whole request, with how the model is read as it is kept."""
        own = self.model_dump(exclude={"model_id", "align"})
        align = {} if self.align is None else {"align": self.align.model_dump()}
        return CompareRequest.model_validate({**reading, **own, **align})


def placement_in(text: str | None) -> ModelPlacement:
    """Return the placement that JSON states; the system frame without any.

    Raises
    ------
    InputError
        ``alignment_invalid``.
    """
    if text is None:
        return GivenPlacement(kind="given")
    remedy = 'Give JSON such as {"kind": "given", "origin_mm": [1, 0, 0]}; or 3-2-1, markers, best-fit.'
    return asked_in(text, _PLACEMENT, named="alignment of a model", code="alignment_invalid", remedy=remedy)
