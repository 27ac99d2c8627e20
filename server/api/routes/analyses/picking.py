"""Checks before an analysis: speckle quality for the subsets, and a seed's two positions."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import Field, StringConstraints

from stereorig.core.errors import InputError
from stereorig.core.settings import SPACING_PX, SUBSET_PX, AnalysisSettings, Pixel, Real, SpacingPx, SubsetPx, Whole
from stereorig.server.api.models import Region, Reply, Request
from stereorig.server.api.protocol.dependencies import ServiceDep, StepNumber, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.analyses.analyses import mask_of
from stereorig.server.api.routes.analyses.previews import step_image
from stereorig.server.cell.images import mask as read_mask
from stereorig.server.compute.seeds import distances_px, epipolar_line
from stereorig.server.formats.calibrations.recognise import load_calibration
from stereorig.server.formats.images import read_image
from stereorig.server.formats.noise_json import load_noise
from stereorig.server.results.images.texture import speckle_quality

router = APIRouter(prefix="/tests/{test_id}", tags=["analyses"])


class TextureRequest(Request):
    """A region of camera 1's image, and the subset size and spacing to check its texture for."""

    region: Region = Field(description="Region of interest.")
    subset_px: SubsetPx = SUBSET_PX.default
    spacing_px: SpacingPx = SPACING_PX.default
    noise_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None, description="Noise measurement for camera 1's noise; 1 % of full scale is assumed without it."
    )
    noise_grey: Annotated[Real, Field(gt=0.0, le=65535.0)] | None = Field(
        None, description="Standard deviation of the noise, grey levels, in place of the above."
    )


class TextureSize(Reply):
    """Speckle quality with subsets of another width."""

    subset_px: int = Field(description="Width.", examples=[27])
    good_share: float = Field(description="Share of subsets with an expected error up to `good_px`.", examples=[0.97])
    usable_share: float = Field(description="Up to `usable_px`.", examples=[1.0])


class TextureReply(Reply):
    """Random error that the texture lets expect."""

    subset_px: int = Field(description="Width that was asked about.", examples=[33])
    subsets: int = Field(description="Subsets that were rated: the region's points.", examples=[841])
    noise_grey: float = Field(description="Noise that was taken.", examples=[2.55])
    level: str = Field(
        description="`good`, `usable` or `poor`: the level that 95 % of the subsets reach.", examples=["good"]
    )
    median_error_px: float | None = Field(None, description="Median of the expected error; null: no texture.")
    good_share: float = Field(description="Share of subsets with an expected error up to `good_px`.", examples=[0.99])
    usable_share: float = Field(description="Up to `usable_px`.", examples=[1.0])
    good_px: float = Field(description="Error up to which texture is called good.", examples=[0.01])
    usable_px: float = Field(description="Error up to which it is called usable.", examples=[0.05])
    proposed_subset_px: int | None = Field(
        None, description="Smallest width that is good, else usable, for 95 % of the subsets; null: none up to 91 px."
    )
    sizes: list[TextureSize] = Field(description="Other widths.")


class SeedsRequest(Request):
    """Positions of seeds."""

    seeds: Annotated[list[tuple[Pixel, Pixel]], Field(min_length=1, max_length=100)] = Field(
        description="Positions in camera 1's reference image.", examples=[[[250, 240]]]
    )
    seeds_cam2: Annotated[list[tuple[Pixel, Pixel] | None], Field(max_length=100)] | None = Field(
        None, description="The same points in camera 2's image: as many, null where not known."
    )
    reference: Annotated[Whole, Field(ge=0, le=9999)] = Field(0, description="Reference step.")


class SeedPosition(Reply):
    """Possible positions of a seed in camera 2."""

    line_px: list[list[float]] = Field(description="Points along the epipolar line in camera 2; empty: unseen there.")
    distance_px: float | None = Field(None, description="Distance of the position in camera 2 from that line.")


class SeedsReply(Reply):
    """Epipolar check of the seeds."""

    seeds: list[SeedPosition] = Field(description="One each.")


class ScaleReply(Reply):
    """Scale of camera 1's image at the surface; null where too few features match."""

    mm_per_px: float | None = Field(
        None, description="Across the line of sight, at the matches' median depth.", examples=[0.0169]
    )
    distance_mm: float | None = Field(None, description="That depth from camera 1.", examples=[301.2])
    matches: int = Field(0, description="Matches that it comes from.", examples=[412])


@router.post(
    "/steps/{n}/texture", summary="Speckle quality of a region for a subset size", responses=errors(404, 409, 422)
)
def rate_texture(service: ServiceDep, test_id: TestId, n: StepNumber, body: TextureRequest) -> TextureReply:
    """Return the share of the region's subsets with an expected random error below 0.01 and 0.05 px, and a proposal."""
    from stereorig.core.field.region.lay_points import make_grid  # slow to load, and not every start needs it

    if body.subset_px % 2 == 0:
        raise InputError(
            f"subset_px must be odd, got {body.subset_px}.",
            code="subset_invalid",
            remedy=f"Give {SUBSET_PX.default}, for example.",
        )
    pixels, full_scale = step_image(service, test_id, n, "cam1")
    mask = mask_of(body.region)
    settings = AnalysisSettings.model_validate(
        {"region": body.region, "spacing_px": body.spacing_px, "subset_px": body.subset_px}
    )
    grid = make_grid(
        settings, None if mask is None else read_mask(service.cell, mask), (pixels.shape[0], pixels.shape[1])
    )
    noise = body.noise_grey
    if noise is None and body.noise_id is not None:
        model = load_noise(service.noise.file(body.noise_id)).models[0]
        noise = None if model is None else math.sqrt(float(model.variance(float(pixels.mean()))))
    return TextureReply.model_validate(
        asdict(speckle_quality(pixels, full_scale, grid.xy_px[grid.allowed], body.subset_px, noise))
    )


@router.get("/scale", summary="Scale of camera 1's image at the surface", responses=errors(404, 409, 422))
def show_scale(
    service: ServiceDep,
    test_id: TestId,
    step: Annotated[int, Query(ge=0, le=9999, description="Step whose images are looked at.")] = 0,
) -> ScaleReply:
    """Return the length of a pixel of camera 1 on the surface, from feature matches with camera 2."""
    from stereorig.core.field.points.images import MeasureImage  # slow to load, and not every start needs it
    from stereorig.core.field.seeding.scattered_matches import image_scale  # slow to load, and not every start needs it

    pair = load_calibration(service.tests.calibration_file(test_id)).pair
    images = service.tests.steps.verified(test_id, step)
    one, two = (
        MeasureImage(read_image(path), f"{cam} of step {step}")
        for cam, path in (("cam1", images.cam1), ("cam2", images.cam2))
    )
    found = image_scale(pair, one, two)
    return ScaleReply() if found is None else ScaleReply.model_validate(asdict(found))


@router.post("/seeds:check", summary="Possible positions of seeds in camera 2", responses=errors(404, 409, 422))
def check_seeds(service: ServiceDep, test_id: TestId, body: SeedsRequest) -> SeedsReply:
    """Return each seed's epipolar line in camera 2, and the distance of the position given there from it."""
    from stereorig.core.field.seeding.seeds import Seed  # slow to load, and not every start needs it

    two = [None] * len(body.seeds) if body.seeds_cam2 is None else body.seeds_cam2
    if len(two) != len(body.seeds):
        raise InputError(
            f"There are {len(body.seeds)} seeds, but {len(two)} positions in camera 2.",
            code="seeds_do_not_match",
            remedy="Give as many, null where a position is not known.",
        )
    pair = load_calibration(service.tests.calibration_file(test_id)).pair
    rows, cols = read_image(service.tests.steps.read(test_id, body.reference).cam2).shape
    seeds = [Seed(one, other) for one, other in zip(body.seeds, two, strict=True)]
    off = distances_px(pair, seeds)
    return SeedsReply.model_validate(
        {
            "seeds": [
                {"line_px": epipolar_line(pair, s.xy_px, (cols, rows)), "distance_px": None if d != d else float(d)}
                for s, d in zip(seeds, off, strict=True)
            ]
        }
    )
