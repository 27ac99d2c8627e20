"""Measuring an analysis again, to see that it comes out the same."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool

from stereorig.server.api.models import Accepted
from stereorig.server.api.protocol.dependencies import AnalysisId, ServiceDep, TestId, Wait, job_reply
from stereorig.server.api.protocol.problems import errors
from stereorig.server.workflows.repetition.repeat import start_repetition
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}/analyses", tags=["analyses"])


@router.post(
    "/{analysis_id}:reproduce",
    summary="Measure an analysis again and compare",
    status_code=202,
    responses=errors(404, 409, 422, 503, 507),
)
async def reproduce_analysis(
    request: Request, service: ServiceDep, test_id: TestId, analysis_id: AnalysisId, wait: Wait = 0.0
) -> Accepted:
    """Measure the finished steps again from the stored images, settings and calibration, and compare.

    The job's result has the `verdict`: `equal` to the last bit; `within`, the same points and every difference at
    most `within_u` of its standard uncertainty; or `differs`. `changes` lists the differences since then in version,
    libraries and processor. The results of the analysis are not touched, and the repetition's are not kept.
    """
    job_id = await run_in_threadpool(_begin, service, test_id, analysis_id)
    return Accepted.model_validate(await job_reply(request, service, job_id, wait_s=wait))


def _begin(service: Service, test_id: str, analysis_id: str) -> str:
    service.require_room()
    return start_repetition(service, test_id, analysis_id).id
