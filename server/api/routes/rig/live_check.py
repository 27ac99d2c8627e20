"""Check of the accepted calibration by the live pair."""

from __future__ import annotations

from dataclasses import asdict

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool

from stereorig.server.api.models import LiveCheckReply
from stereorig.server.api.protocol.problems import errors
from stereorig.server.workflows.live_check import LiveChecks

router = APIRouter(tags=["rig"])


@router.get(
    "/rig/calibration-check",
    summary="How far the cameras have moved since the calibration, by the live pair",
    responses=errors(409, 422, 503),
)
async def check_calibration(request: Request) -> LiveCheckReply:
    """Match the live pair, and hold its points against the newest accepted calibration's epipolar lines.

    It takes a second or more, and is not made while a job runs or a stage is off the calibrated place.
    """
    checks: LiveChecks = request.app.state.live_checks
    found = await run_in_threadpool(checks)
    return LiveCheckReply.model_validate(
        {"calibration_id": found.calibration_id, **asdict(found.finding), "checked_utc": found.checked_utc}
    )
