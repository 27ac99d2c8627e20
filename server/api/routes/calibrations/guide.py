"""Guided acquisitions: begin, see, take, finish."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Request
from fastapi.concurrency import run_in_threadpool

from stereorig.server.api.models import Accepted, CalibrationAccepted
from stereorig.server.api.models.guide import GuideReply, GuideRequest
from stereorig.server.api.protocol.dependencies import CalibrationId, KeyHeader, ServiceDep, Wait, job_reply, mark
from stereorig.server.api.protocol.problems import errors
from stereorig.server.workflows.calibration.guided import GuidePlan, Guides

router = APIRouter(prefix="/calibrations", tags=["calibrations"])


def get_guides(request: Request) -> Guides:
    """Return the guided acquisitions of this service."""
    guides: Guides = request.app.state.guides
    return guides


GuidesDep = Annotated[Guides, Depends(get_guides)]


@router.post(":guide", summary="Begin a guided acquisition", status_code=202, responses=errors(409, 422, 503, 507))
def begin_guide(
    service: ServiceDep, guides: GuidesDep, body: GuideRequest | None = None, key: KeyHeader = None
) -> CalibrationAccepted:
    """Hold the cameras, find the target in live pairs, and take a view whenever it is at rest in a new pose.

    Nothing moves, even if the rig file has a stage: the target is shown by hand in free poses. Hold it first
    where the specimen will be: that pose is the system frame.
    """
    body = body or GuideRequest.model_validate({})
    plan = GuidePlan(
        quantity=body.quantity,
        goal_um=body.goal_um,
        frames=body.frames,
        automatic=body.automatic,
        rest_px=body.rest_px,
        localiser=body.localiser or service.config.calibration.localiser,
        label=body.label,
    )
    request = mark("calibrations:guide", key, body)
    made, _ = service.once(request.scope, key, request.body_sha256, lambda: guides.begin(plan, request))
    return CalibrationAccepted.model_validate(
        {"job": service.jobs.document(str(made["job_id"])).plain(), "calibration_id": made["calibration_id"]}
    )


@router.get("/{calibration_id}/guide", summary="A guided acquisition, now", responses=errors(404, 409))
def get_guide(guides: GuidesDep, calibration_id: CalibrationId) -> GuideReply:
    """Return the target in the newest live pair, the cover by the views taken, and the next most useful view.

    The event `guide` reports each view taken.
    """
    return GuideReply.model_validate(guides.state(calibration_id))


@router.post("/{calibration_id}/guide/views", summary="Take a view now", status_code=202, responses=errors(404, 409))
def take_view(guides: GuidesDep, calibration_id: CalibrationId) -> GuideReply:
    """Take the next live pair in which both cameras show the target, at rest or not, new or not."""
    guides.take(calibration_id)
    return GuideReply.model_validate(guides.state(calibration_id))


@router.post(
    "/{calibration_id}/guide:finish",
    summary="Finish a guided acquisition",
    status_code=202,
    responses=errors(404, 409, 422, 503, 507),
)
async def finish_guide(
    request: Request, service: ServiceDep, guides: GuidesDep, calibration_id: CalibrationId, wait: Wait = 0.0
) -> Accepted:
    """Let the cameras go and fit the views; the views of an interrupted acquisition are fitted, too."""
    job_id = await run_in_threadpool(guides.finish, calibration_id)
    return Accepted.model_validate(await job_reply(request, service, job_id, wait_s=wait))
