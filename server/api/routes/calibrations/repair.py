"""Calibrations after a bump: the cameras' relative orientation estimated again."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool

from stereorig.server.api.models import CalibrationAccepted, RepairRequest
from stereorig.server.api.protocol.dependencies import CalibrationId, KeyHeader, ServiceDep, Wait, mark
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.analyses.analyses import mask_of
from stereorig.server.api.routes.calibrations.calibrations import accepted
from stereorig.server.base.models import Ids
from stereorig.server.workflows.calibration.repair import begin
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/calibrations", tags=["calibrations"])


@router.post(
    "/{calibration_id}:repair",
    summary="Repair a calibration after a bump",
    status_code=202,
    responses=errors(404, 409, 422, 503, 507),
)
async def repair_calibration(
    request: Request,
    service: ServiceDep,
    calibration_id: CalibrationId,
    body: RepairRequest,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> CalibrationAccepted:
    """Make a new calibration: the cameras' relative orientation is estimated from the speckle of steps after the bump.

    The old one is kept as it is; `plan.repaired_from` of the new one names it, `repair` has the finding. The length of
    the baseline is kept, the covariance widened. The job fails with a `repair_...` code if a check refuses the repair.
    """
    made = await run_in_threadpool(_start, service, calibration_id, body, key)
    return await accepted(request, service, made, wait)


def _start(service: Service, calibration_id: str, body: RepairRequest, key: str | None) -> Ids:
    request = mark(f"calibrations/{calibration_id}:repair", key, body)
    region = body.region

    def make() -> Ids:
        return begin(
            service,
            calibration_id,
            request,
            test_id=body.test_id,
            steps=body.steps,
            region=None if region is None else region.model_dump(exclude={"mask_png_base64"}),
            mask=None if region is None else mask_of(region),
            subset_px=body.subset_px,
            spacing_px=body.spacing_px,
            limits={"turn_deg": body.max_turn_deg, "strain": 1e-6 * body.max_strain_microstrain},
            label=body.label,
        )

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return made
