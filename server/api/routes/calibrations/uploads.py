"""Calibrations from uploaded images, and from an earlier calibration's views without some."""

from __future__ import annotations

from hashlib import sha256
from typing import Annotated

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.concurrency import run_in_threadpool
from pydantic import ValidationError

from stereorig.core.errors import InputError
from stereorig.server.api.models import CalibrationAccepted
from stereorig.server.api.protocol.dependencies import CalibrationId, KeyHeader, ServiceDep, Wait, mark
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.calibrations.calibrations import accepted
from stereorig.server.base.models import Ids
from stereorig.server.wording import problems_in
from stereorig.server.workflows.calibration.uploaded import (
    MOST_PAIRS,
    Read,
    RefitRequest,
    UploadedPlan,
    begin_refit,
    begin_uploaded,
)

router = APIRouter(prefix="/calibrations", tags=["calibrations"])
_EXAMPLE = '{"target": {"kind": "checkerboard", "pitch_mm": 3.0, "size": [11, 8]}, "phd_px": 7000.0}'


@router.post(
    ":upload", summary="Calibrate from images of the target", status_code=202, responses=errors(404, 409, 413, 422, 507)
)
async def upload_views(
    request: Request,
    service: ServiceDep,
    cam1: Annotated[
        list[UploadFile],
        File(min_length=1, max_length=MOST_PAIRS, description="Camera 1's images: TIFF, PNG, BMP or JPEG."),
    ],
    cam2: Annotated[
        list[UploadFile], File(min_length=1, max_length=MOST_PAIRS, description="Camera 2's, in the same order.")
    ],
    plan: Annotated[
        str,
        Form(
            description="JSON: `target` (as `[target]` of a rig file), `phd_px` (focal length over the pixel's width), "
            "`moves` (`free`, `cameras`, `both_cameras`, `target`), `dz_mm`, `standoff_mm`, `angle_deg` of both "
            "cameras, `lens`, `localiser`, `label`; the first two are needed, and for `moves` other than `free` the "
            "next four.",
            examples=[_EXAMPLE],
            max_length=20_000,
            json_schema_extra={"contentMediaType": "application/json"},
        ),
    ],
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> CalibrationAccepted:
    """Fit both cameras to pairs of images of the target, in free poses or at known travels; no rig is needed."""
    made = await run_in_threadpool(_upload, service, cam1, cam2, plan, key)
    return await accepted(request, service, made, wait)


def _upload(service: ServiceDep, one: list[UploadFile], two: list[UploadFile], plan: str, key: str | None) -> Ids:
    try:
        asked = UploadedPlan.model_validate_json(plan)
    except ValidationError as error:
        raise InputError(
            f"plan: {problems_in(error)[0]}", code="plan_unreadable", remedy=f"Send JSON, as in {_EXAMPLE}."
        ) from error
    if len(one) != len(two):
        raise InputError(
            f"Camera 1 has {len(one)} images, camera 2 has {len(two)}.",
            code="counts_differ",
            remedy="Send as many images of each camera, in the same order.",
        )
    pairs = [_reader(first, second) for first, second in zip(one, two, strict=True)]
    digests = [sha256(data).digest() for read in pairs for data in read().values()]
    sent = mark("calibrations:upload", key, None, plan.encode(), *digests)
    made, _ = service.once(sent.scope, key, sent.body_sha256, lambda: begin_uploaded(service, asked, pairs, sent))
    return made


def _reader(one: UploadFile, two: UploadFile) -> Read:
    def read() -> dict[str, bytes]:
        found = {}
        for cam, upload in (("cam1", one), ("cam2", two)):
            upload.file.seek(0)
            found[cam] = upload.file.read()
        return found

    return read


@router.post(
    "/{calibration_id}:refit",
    summary="Calibrate again without some views",
    status_code=202,
    responses=errors(404, 409, 422, 507),
)
async def refit_calibration(
    request: Request,
    service: ServiceDep,
    calibration_id: CalibrationId,
    body: RefitRequest,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> CalibrationAccepted:
    """Make another calibration from the views of this one, without those named; this one is kept."""
    made = await run_in_threadpool(_refit, service, calibration_id, body, key)
    return await accepted(request, service, made, wait)


def _refit(service: ServiceDep, calibration_id: str, body: RefitRequest, key: str | None) -> Ids:
    service.calibrations.path(calibration_id)
    sent = mark(f"calibrations/{calibration_id}:refit", key, body)
    made, _ = service.once(sent.scope, key, sent.body_sha256, lambda: begin_refit(service, calibration_id, body, sent))
    return made
