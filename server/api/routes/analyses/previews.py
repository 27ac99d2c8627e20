"""Previews: grey value of a pixel, 8-bit pictures, maps over an image."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query
from fastapi.responses import Response
from pydantic import Field

from stereorig.core.errors import InputError
from stereorig.core.settings import SUBSET_PX
from stereorig.server.api.protocol.dependencies import CalibrationId, Camera, ServiceDep, StepNumber, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Reply
from stereorig.server.formats.images import GrayImage, read_image
from stereorig.server.results.images.previews import MapKind, overlay, preview
from stereorig.server.workflows.service import Service

router = APIRouter(tags=["previews"])
Kind = Annotated[MapKind, Path(description="Kind of map.")]
Index = Annotated[int, Path(ge=0, le=9999, description="Number of the position.")]
Subset = Annotated[
    int,
    Query(ge=SUBSET_PX.low, le=SUBSET_PX.high, description="Width of the subset that the texture is rated for, px."),
]
Width = Annotated[int | None, Query(ge=16, le=8192, description="Width in px; the image's own if left out.")]
_KEPT = "private, max-age=86400"  # the images of a step or a view never change
_JPEG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": {}}, "description": "8-bit JPEG."}}
_PNG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {}}, "description": "RGBA PNG; its legend is in `X-Legend`."}
}


class PixelsReply(Reply):
    """A rectangle of a step's image, as stored."""

    x_px: int = Field(description="Column of the first value.", examples=[192])
    y_px: int = Field(description="Row of the first value.", examples=[128])
    values: list[list[int]] = Field(description="Row by row, as stored.", examples=[[[118, 121], [97, 103]]])
    grey_scale: float = Field(
        description="Stored value of one grey level of the camera: more than 1 where frames were averaged.",
        examples=[1.0],
    )
    full_scale: float = Field(
        description="Largest value; of images from elsewhere the largest that their type holds.", examples=[255.0]
    )


class PixelReply(Reply):
    """One pixel of a live image."""

    x_px: int = Field(description="Column.", examples=[255])
    y_px: int = Field(description="Row.", examples=[239])
    value: int = Field(description="Grey level as the camera gave it.", examples=[142])
    bit_depth: int = Field(description="Significant bits.", examples=[8])
    sequence: int = Field(description="Number of the frame.", examples=[17])


@router.get(
    "/cameras/{cam}/pixel",
    summary="Grey level of a pixel of the newest frame",
    response_model=PixelReply,
    responses=errors(409, 422, 503),
)
def get_pixel(
    service: ServiceDep,
    cam: Camera,
    x_px: Annotated[int, Query(ge=0, le=32767, description="Column.")],
    y_px: Annotated[int, Query(ge=0, le=32767, description="Row.")],
) -> PixelReply:
    """Return the grey level with every bit that the camera gave."""
    frame = service.rig.pair.live(cam, max_age_s=0.2)
    _within(frame.pixels, x_px, y_px)
    return PixelReply(
        x_px=x_px, y_px=y_px, value=int(frame.pixels[y_px, x_px]), bit_depth=frame.bit_depth, sequence=frame.sequence
    )


@router.get(
    "/cameras/{cam}/maps/{kind}",
    summary="Saturation or texture of the newest frame, to draw over it",
    response_class=Response,
    responses=errors(409, 422, 503) | _PNG,
)
def get_live_map(service: ServiceDep, cam: Camera, kind: Kind, subset_px: Subset = SUBSET_PX.default) -> Response:
    """Return a picture of any size that covers the whole image; `X-Legend` has the meaning of its colours."""
    frame = service.rig.pair.live(cam, max_age_s=0.2)
    return _overlay(kind, frame.pixels, float(2**frame.bit_depth - 1), subset_px)


@router.get(
    "/tests/{test_id}/steps/{n}/{cam}/preview",
    summary="A step's image as JPEG, for looking at",
    response_class=Response,
    responses=errors(404, 409, 422) | _JPEG,
)
def get_step_preview(
    service: ServiceDep, test_id: TestId, n: StepNumber, cam: Camera, width_px: Width = None
) -> Response:
    """Return it in 8 bit and no wider than asked for."""
    pixels, full_scale = step_image(service, test_id, n, cam)
    return _jpeg(preview(pixels, full_scale, width_px))


@router.get(
    "/tests/{test_id}/steps/{n}/{cam}/pixels",
    summary="Grey levels of a rectangle of a step's image",
    response_model=PixelsReply,
    responses=errors(404, 409, 422),
)
def get_step_pixels(
    service: ServiceDep,
    response: Response,
    test_id: TestId,
    n: StepNumber,
    cam: Camera,
    x_px: Annotated[int, Query(ge=0, le=32767, description="First column.")],
    y_px: Annotated[int, Query(ge=0, le=32767, description="First row.")],
    columns: Annotated[int, Query(ge=1, le=256, description="Number of them; fewer come where the image ends.")] = 1,
    rows: Annotated[int, Query(ge=1, le=256, description="Number of them; fewer come where the image ends.")] = 1,
) -> PixelsReply:
    """Return them to the bit, without the scaling of a preview."""
    pixels, full_scale = step_image(service, test_id, n, cam)
    _within(pixels, x_px, y_px)
    response.headers["Cache-Control"] = _KEPT
    return PixelsReply(
        x_px=x_px,
        y_px=y_px,
        values=pixels[y_px : y_px + rows, x_px : x_px + columns].tolist(),
        grey_scale=float(service.tests.steps.read(test_id, n).document.grey_scale or 1),
        full_scale=full_scale,
    )


@router.get(
    "/tests/{test_id}/steps/{n}/{cam}/maps/{kind}",
    summary="Saturation or texture of a step's image, to draw over it",
    response_class=Response,
    responses=errors(404, 409, 422) | _PNG,
)
def get_step_map(
    service: ServiceDep, test_id: TestId, n: StepNumber, cam: Camera, kind: Kind, subset_px: Subset = SUBSET_PX.default
) -> Response:
    """Return a picture of any size that covers the whole image; `X-Legend` has the meaning of its colours."""
    pixels, full_scale = step_image(service, test_id, n, cam)
    return _overlay(kind, pixels, full_scale, subset_px)


@router.get(
    "/calibrations/{calibration_id}/views/{index}/{cam}/preview",
    summary="A calibration view as JPEG, for looking at",
    response_class=Response,
    responses=errors(404, 422) | _JPEG,
)
def get_view_preview(
    service: ServiceDep, calibration_id: CalibrationId, index: Index, cam: Camera, width_px: Width = None
) -> Response:
    """Return it in 8 bit and no wider than asked for."""
    path = service.calibrations.view_file(calibration_id, index, cam)
    taken = service.calibrations.read(calibration_id).taken or []
    view = next((v for v in taken if v.index == index and v.camera == cam), None)
    pixels = read_image(path)
    return _jpeg(preview(pixels, _full_scale(pixels, None if view is None else view.full_scale), width_px))


def _within(pixels: GrayImage, x_px: int, y_px: int) -> None:
    rows, cols = pixels.shape
    if y_px >= rows or x_px >= cols:
        raise InputError(
            f"There is no pixel ({x_px}, {y_px}) in an image of {cols} x {rows} px.",
            remedy=f"Give x_px up to {cols - 1} and y_px up to {rows - 1}.",
        )


def _full_scale(pixels: GrayImage, stated: float | None) -> float:
    """Return the largest grey level; of images from elsewhere the one that their type can hold."""
    return float(stated) if stated else (255.0 if pixels.dtype.itemsize == 1 else 65535.0)


def step_image(service: Service, test_id: str, n: int, cam: str) -> tuple[GrayImage, float]:
    """Return a step's image, its checksum checked, and its largest grey level."""
    step = service.tests.steps.verified(test_id, n)
    pixels = read_image(step.cam1 if cam == "cam1" else step.cam2)
    depth = (step.document.bit_depth or {}).get(cam)
    full_scale = None if depth is None else (2**depth - 1) * (step.document.grey_scale or 1)
    return pixels, _full_scale(pixels, full_scale)


def _jpeg(data: bytes) -> Response:
    return Response(data, media_type="image/jpeg", headers={"Cache-Control": _KEPT})


def _overlay(kind: MapKind, pixels: GrayImage, full_scale: float, subset_px: int) -> Response:
    made = overlay(kind, pixels, full_scale, subset_px)
    return Response(made.png, media_type="image/png", headers={"X-Legend": made.legend, "Cache-Control": "no-store"})
