"""Calibrations: begin, list, read, residuals, views."""

from __future__ import annotations

from pathlib import Path as FilePath
from typing import Annotated, Literal

import cv2
from fastapi import APIRouter, File, Form, Path, Query, Request, UploadFile
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, Response

from stereorig.core.errors import StateError
from stereorig.server.api.models import (
    CalibrationAccepted,
    CalibrationList,
    CalibrationReply,
    CalibrationRequest,
    Label,
    ResidualsReply,
    ViewList,
)
from stereorig.server.api.models.calibrations import CalibrationFile
from stereorig.server.api.protocol.delivery import tagged
from stereorig.server.api.protocol.dependencies import (
    CalibrationId,
    Camera,
    KeyHeader,
    ServiceDep,
    Wait,
    job_reply,
    mark,
)
from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.models import Ids
from stereorig.server.cell.tables import calibration as read_calibration
from stereorig.server.documents.made import MadeState
from stereorig.server.formats.images import read_image
from stereorig.server.formats.manifest import checked_bytes, is_there
from stereorig.server.results.reader import read_residuals
from stereorig.server.store.calibrations import REJECTED
from stereorig.server.store.indexing.entries import calibration_entry
from stereorig.server.workflows.calibration.sequence import CalibrationPlan, begin
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/calibrations", tags=["calibrations"])


@router.post("", summary="Calibrate the pair", status_code=202, responses=errors(409, 422, 503, 507))
async def create_calibration(
    request: Request,
    service: ServiceDep,
    body: CalibrationRequest | None = None,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> CalibrationAccepted:
    """Move both cameras through the plan before the grid, then fit; the rig file gives the parts left out."""
    return await accepted(request, service, await run_in_threadpool(_start, service, body, key), wait)


async def accepted(request: Request, service: Service, made: Ids, wait_s: float) -> CalibrationAccepted:
    """Answer with a calibration that was begun and its job, at once or after a wait."""
    reply = await job_reply(request, service, str(made["job_id"]), wait_s=wait_s)
    return CalibrationAccepted.model_validate({**reply, "calibration_id": made["calibration_id"]})


def _start(service: Service, body: CalibrationRequest | None, key: str | None) -> Ids:
    body = body or CalibrationRequest.model_validate({})
    usual = service.config.calibration
    plan = CalibrationPlan(
        positions_mm=tuple(usual.positions_mm if body.positions_mm is None else body.positions_mm),
        held_out_mm=tuple(usual.held_out_mm if body.held_out_mm is None else body.held_out_mm),
        frames=body.frames or usual.frames,
        localiser=body.localiser or usual.localiser,
        label=body.label,
    )
    request = mark("calibrations", key, body)

    made, _ = service.once(request.scope, key, request.body_sha256, lambda: begin(service, plan, request))
    return made


@router.get("", summary="Calibrations, oldest first", responses=errors(422))
def list_calibrations(
    service: ServiceDep,
    page: PageDep,
    accepted: Annotated[
        bool | None, Query(description="True: those that were accepted; false: those that were not, or not yet.")
    ] = None,
    state: Annotated[MadeState | None, Query(description="Those in this state.")] = None,
) -> CalibrationList:
    """Return every calibration that was begun, with its state and verdict; or those asked for.

    The calibration in force is the last of `?accepted=true`; requests name it `latest`.
    """
    found = [
        entry
        for entry in service.catalog.entries("calibration")
        if (state is None or entry["state"] == state)
        and (accepted is None or (entry.get("decision") == "accepted") is accepted)
    ]
    calibrations = page.of(found, lambda c: str(c["id"]))
    return CalibrationList.model_validate({"calibrations": calibrations, "next_cursor": page.next_cursor})


@router.get("/{calibration_id:plain_id}", summary="One calibration", responses=errors(404, 409))
def get_calibration(service: ServiceDep, calibration_id: CalibrationId, response: Response) -> CalibrationReply:
    """Return plan, views and, once complete, all of calibration.json; the header ETag names this state of it.

    One that failed its verdict has its refused content in the same fields, for inspection; `state` stays `failed`.
    """
    return CalibrationReply.model_validate(tagged(response, service.calibrations.read(calibration_id).plain()))


@router.post(
    ":import",
    summary="Import a calibration made elsewhere",
    status_code=201,
    responses=errors(404, 409, 413, 422, 507),  # 404: a repeated request, whose calibration was deleted since
)
def import_calibration(
    service: ServiceDep,
    file: Annotated[
        UploadFile,
        File(
            description="calibration.json, DICe XML or text, OpenCV YAML, MatchID caldat, VIC-3D XML or pyvale text of "
            "a stereo pair."
        ),
    ],
    label: Annotated[Label, Form(description="Free text.")] = "",
    unit: Annotated[
        str | None,
        Form(
            max_length=40,
            description="Unit of length of another program's file: um, mm, cm, m or in, or a size such as `25 mm` if "
            "it counts squares of a board; left out: mm, and a warning in `plan.check` if no rig has such "
            "distances.",
        ),
    ] = None,
    key: KeyHeader = None,
) -> CalibrationReply:
    """Store another program's stereo calibration, or one of another data folder, to measure imported steps with.

    `plan.check` has the epipolar residual of points in both images, and warnings.
    """
    data = file.file.read()
    stated = [] if unit is None else [unit.encode()]
    request = mark("calibrations:import", key, None, data, label.encode(), *stated)

    def make() -> Ids:
        content, checked = read_calibration(service.cell, data, unit=unit)
        plan = {"source": "import", "label": label, "check": checked, **request.document()}
        calibration_id = service.calibrations.add_imported(plan, content)
        entry = calibration_entry(service.calibrations, calibration_id)
        service.catalog.put_entry("calibration", "", calibration_id, entry)
        service.hub.publish("calibration", {"calibration_id": calibration_id})
        return {"calibration_id": calibration_id}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return CalibrationReply.model_validate(service.calibrations.read(str(made["calibration_id"])).plain())


def complete(service: ServiceDep, calibration_id: str) -> FilePath:
    """Return a complete calibration's folder.

    Raises
    ------
    StateError
        ``calibration_not_complete``.
    """
    path = service.calibrations.path(calibration_id)
    if not is_there(path / "calibration.json"):
        state = service.calibrations.read(calibration_id).state
        raise StateError(
            f"Calibration {calibration_id} is {state}.",
            code="calibration_not_complete",
            remedy="Wait for its job, or calibrate again.",
            state=state,
        )
    return path


@router.get(
    "/{calibration_id}/views",
    summary="Views that were taken",
    response_model_exclude_unset=True,
    responses=errors(404, 409),
)
def list_views(service: ServiceDep, calibration_id: CalibrationId) -> ViewList:
    """Return camera, role, read-back dZ and checksum of every view; empty until all are taken."""
    taken = service.calibrations.read(calibration_id).taken or []
    return ViewList.model_validate({"views": [view.plain() for view in taken]})


@router.get("/{calibration_id}/residuals", summary="Residuals of every view", responses=errors(404, 409))
def get_residuals(service: ServiceDep, calibration_id: CalibrationId) -> ResidualsReply:
    """Return, for each view, where every intersection was found and by how much the model misses it.

    A calibration that failed its verdict has them too, to find the cause.
    """
    path = service.calibrations.path(calibration_id)
    if not is_there(path / REJECTED):
        complete(service, calibration_id)
    path /= "residuals.nc"
    if not is_there(path):
        raise NotFoundError(f"Calibration {calibration_id} was imported and has no residuals.", kind="residuals")
    return ResidualsReply(views=read_residuals(path))


@router.get(
    "/{calibration_id}/file",
    summary="calibration.json as stored",
    response_class=FileResponse,
    responses=errors(404, 409) | {200: {"model": CalibrationFile, "description": "The file"}},
)
def get_calibration_file(service: ServiceDep, calibration_id: CalibrationId) -> Response:
    """Return the file, which `stereorig measure` reads."""
    path = complete(service, calibration_id) / "calibration.json"
    return Response(checked_bytes(path), media_type="application/json")


@router.get(
    "/{calibration_id}/views/{index}/{cam}",
    summary="One view's image",
    response_class=Response,
    responses=errors(404, 409, 422) | {200: {"content": {"image/tiff": {}, "image/png": {}}}},
)
def get_view(
    service: ServiceDep,
    calibration_id: CalibrationId,
    index: Annotated[int, Path(ge=0, le=999, description="Number of the view.")],
    cam: Camera,
    format: Annotated[Literal["tiff", "png"], Query(description="As stored, or for looking at.")] = "tiff",  # noqa: A002
) -> Response:
    """Return the image as stored (TIFF), or as PNG for looking at."""
    path = service.calibrations.view_file(calibration_id, index, cam)
    if format == "tiff":
        return Response(checked_bytes(path), media_type="image/tiff")
    _, data = cv2.imencode(".png", read_image(path))
    return Response(data.tobytes(), media_type="image/png")
