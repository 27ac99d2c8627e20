"""Calibrations before and after: expected uncertainty of a plan; decisions."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from stereorig.core.plan.settings import PlannedMeasurement, PlannedRig
from stereorig.server.api.models import CalibrationReply
from stereorig.server.api.models.calibrations import ExpectReply, ExpectRequest, ReviewRequest
from stereorig.server.api.protocol.delivery import IfMatch, etag_of, require_match, tagged
from stereorig.server.api.protocol.dependencies import CalibrationId, ServiceDep, person_name
from stereorig.server.api.protocol.problems import errors
from stereorig.server.workflows.calibration import review as calibration_review
from stereorig.server.workflows.calibration.sequence import CalibrationPlan

router = APIRouter(prefix="/calibrations", tags=["calibrations"])


@router.post(":expect", summary="Expected uncertainty of a plan", responses=errors(409, 422, 503))
def expect_calibration(service: ServiceDep, body: ExpectRequest | None = None) -> ExpectReply:
    """Predict the uncertainties that a calibration and a measurement will have; nothing moves, nothing is stored.

    The rig file's nominal cameras image the target; the adjustment's own derivatives there give the covariance. Points
    on the target's plane, with the noise of an assumed pattern, give a measurement's uncertainties.
    """
    body = body or ExpectRequest.model_validate({})
    usual = service.config.calibration
    plan = CalibrationPlan(
        positions_mm=tuple(usual.positions_mm if body.positions_mm is None else body.positions_mm),
        held_out_mm=tuple(usual.held_out_mm if body.held_out_mm is None else body.held_out_mm),
        frames=usual.frames,
        localiser=body.localiser or usual.localiser,
    )
    found = calibration_review.expectation(
        service,
        plan,
        noise_px=body.noise_px,
        roll_deg=body.roll_deg,
        rig=body.rig or PlannedRig(),
        measurement=body.measurement or PlannedMeasurement.model_validate({}),
    )
    return ExpectReply.model_validate(found)


@router.put(
    "/{calibration_id}/review", summary="Accept or discard a calibration", responses=errors(404, 409, 412, 422, 507)
)
def put_review(
    service: ServiceDep,
    request: Request,
    calibration_id: CalibrationId,
    body: ReviewRequest,
    response: Response,
    if_match: IfMatch = None,
) -> CalibrationReply:
    """Keep a decision: tests that name `latest` take the newest accepted; none can be made with a discarded one.

    If-Match, with the ETag of the calibration, is refused (412) if another client decided since.
    """
    service.calibrations.path(calibration_id)
    with service.changes:  # no other decision comes between the check and this one
        if if_match is not None:
            now = etag_of(service.calibrations.read(calibration_id).plain())
            require_match(if_match, now, f"calibration {calibration_id}")
        calibration_review.decide(service, calibration_id, body.decision, body.note, person_name(request))
    return CalibrationReply.model_validate(tagged(response, service.calibrations.read(calibration_id).plain()))
