"""A measured step compared with a finite element result."""

from __future__ import annotations

import shutil
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response
from starlette.concurrency import run_in_threadpool

from stereorig.server.api.protocol.dependencies import AnalysisId, ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.analyses.exports import finished
from stereorig.server.cell.models import model as read_model
from stereorig.server.exports.comparison import VTU, compare_task
from stereorig.server.formats.models.read import ModelFile
from stereorig.server.results.models.document import ModelComparisonReply
from stereorig.server.results.models.request import CompareRequest, ComparisonRequest
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])
_VTU = "application/vnd.vtk"


@router.post(
    "/comparison",
    operation_id="compare_with_model",
    summary="Compare a step with a model",
    response_model=ModelComparisonReply,
    responses=errors(404, 409, 422, 503, 507) | {200: {"content": {_VTU: {}}}},
)
async def compare(
    request: Request,
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    body: ComparisonRequest,
    format: Annotated[  # noqa: A002
        Literal["json", "vtu"], Query(description="vtu: the step's points with model, difference and z at each.")
    ] = "json",
) -> ModelComparisonReply | Response:
    """Place the model on the measured shape, filter it as the measurement is, and compare; nothing is stored.

    `accepted` is false if the model is refuted by the field as a whole, at the confidence asked for; `refuted` lists
    the regions, at that confidence for all of them together.
    """
    files, model, read, name, asked = await run_in_threadpool(_inputs, service, test_id, analysis_id, body)
    service.require_room()
    folder = await run_in_threadpool(service.exports.new_folder)
    try:
        out = str(folder) if format == "vtu" else None
        task = service.exports.run(compare_task, files, model, read, name, asked, out)
        found = await finished(request, task)
        if format == "json":
            return ModelComparisonReply.model_validate(found)
        content = await run_in_threadpool((folder / VTU).read_bytes)
    finally:
        await run_in_threadpool(shutil.rmtree, folder, ignore_errors=True)
    headers = {"Content-Disposition": f'attachment; filename="{test_id}_{analysis_id}_{body.model_id}.vtu"'}
    return Response(content, media_type=_VTU, headers=headers)


def _inputs(
    service: Service, test_id: str, analysis_id: str, body: ComparisonRequest
) -> tuple[list[str], str, ModelFile, str, CompareRequest]:
    steps = service.tests.analyses.finished_steps(test_id, analysis_id)
    wanted = steps if body.step is None or body.step not in steps else [body.step]
    files = [str(service.tests.analyses.result_file(test_id, analysis_id, n)) for n in wanted]
    record, path = service.models.read(test_id, body.model_id), service.models.file(test_id, body.model_id)
    asked = body.with_model(record.reading)
    how = asked.model_dump(include={"unit", "displacement", "time"})
    read = read_model(service.cell, {name: path.with_name(name) for name in record.files}, path.name, how)
    return files, str(path), read, record.name, asked
