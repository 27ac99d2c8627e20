"""Evaluations of an analysis' results, by this program or by an installed package."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Path, Request
from starlette.concurrency import run_in_threadpool

from stereorig.server.api.models.evidence.evaluations import EvaluationList, EvaluationReply, EvaluationRequest
from stereorig.server.api.protocol.dependencies import AnalysisId, ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.analyses.exports import finished
from stereorig.server.evaluations.door import described, evaluate_named
from stereorig.server.workflows.service import Service

router = APIRouter(tags=["results"])


@router.get("/evaluations", operation_id="list_evaluations", summary="List evaluations", responses=errors(503))
async def listed(request: Request, service: ServiceDep) -> EvaluationList:
    """List each evaluation with the schemas of its settings and its document."""
    # a package of others is loaded in the process of exports alone: one that hangs or ends it does not stop the service
    found = await finished(request, service.exports.run(described))
    return EvaluationList.model_validate({"evaluations": [asdict(one) for one in found]})


@router.post(
    "/tests/{test_id}/analyses/{analysis_id}/evaluations/{name}",
    operation_id="evaluate",
    summary="Evaluate an analysis",
    responses=errors(404, 409, 422, 503),
)
async def evaluate(
    request: Request,
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    name: Annotated[str, Path(max_length=40, description="Name of an evaluation.")],
    body: EvaluationRequest,
) -> EvaluationReply:
    """Run an evaluation over the finished steps and answer with its document; nothing is stored."""
    files = await run_in_threadpool(_files, service, test_id, analysis_id)
    document = await finished(request, service.exports.run(evaluate_named, files, name, body.settings))
    return EvaluationReply(name=name, document=document)


def _files(service: Service, test_id: str, analysis_id: str) -> list[str]:
    analyses = service.tests.analyses
    steps = analyses.finished_steps(test_id, analysis_id)
    return [str(analyses.result_file(test_id, analysis_id, n)) for n in steps]
