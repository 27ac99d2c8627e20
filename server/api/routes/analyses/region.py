"""The region to begin with: the specimen, found in the reference images."""

from __future__ import annotations

import base64
from typing import Annotated, Self

from fastapi import APIRouter
from pydantic import Field, model_validator

from stereorig.core.settings import SUBSET_PX, SubsetPx, Whole, require_odd
from stereorig.server.api.models import Region, Reply, Request
from stereorig.server.api.protocol.dependencies import ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.images import encode_png, read_image
from stereorig.server.formats.results.summary import region_found
from stereorig.server.results.images.texture import region_to_edit

router = APIRouter(prefix="/tests/{test_id}", tags=["analyses"])


class FindRegionRequest(Request):
    """A pair of images, and the size of the subsets to be placed on the specimen."""

    reference: Annotated[Whole, Field(ge=0, le=9999)] = Field(0, description="Reference step.")
    subset_px: SubsetPx = SUBSET_PX.default

    @model_validator(mode="after")
    def _odd(self) -> Self:
        require_odd(subset_px=self.subset_px)
        return self


class FoundRegionReply(Reply):
    """The specimen, as a region to measure or to correct."""

    region: Region = Field(description="Its largest part: a polygon with holes, simplified to be corrected by hand.")
    mask_png_base64: str = Field(description="All of it: image of camera 1's size, white on the specimen.")
    outlines_px: list[list[list[float]]] = Field(description="Corners of its parts, the largest first.")
    holes_px: list[list[list[float]]] = Field(description="Corners of the holes in them.")
    share: float = Field(description="Share of camera 1's image.", examples=[0.48])
    matches: int = Field(description="Feature matches with camera 2 on it.", examples=[2364])
    text: str = Field(description="How it was found, with figures.")


@router.post("/region:find", summary="Find the specimen, if no region is drawn yet", responses=errors(404, 409, 422))
def find_region(service: ServiceDep, test_id: TestId, body: FindRegionRequest) -> FoundRegionReply:
    """Find the specimen by its texture: as far as camera 2 sees and matches it. Nothing is kept."""
    from stereorig.core.field.points.images import MeasureImage  # slow to load, and not every start needs it
    from stereorig.core.field.seeding.specimen import find_specimen  # slow to load, and not every start needs it

    pair = load_calibration(service.tests.calibration_file(test_id)).pair
    step = service.tests.steps.verified(test_id, body.reference)
    one, two = (
        MeasureImage(read_image(path), f"{cam} of step {body.reference}")
        for cam, path in (("cam1", step.cam1), ("cam2", step.cam2))
    )
    specimen = find_specimen(pair, one, two, subset_px=body.subset_px)
    return FoundRegionReply.model_validate(
        {
            "region": region_to_edit(specimen, body.subset_px),
            "mask_png_base64": base64.b64encode(encode_png(specimen.mask)).decode(),
            **region_found(specimen),
        }
    )
