"""The report of an analysis."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, Response
from starlette.concurrency import run_in_threadpool

from stereorig.server.api.protocol.dependencies import AnalysisId, CoverageDep, FrameText, ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.analyses.exports import finished
from stereorig.server.base.errors import NotFoundError
from stereorig.server.report.task import NAME, SECTIONS, ReportOptions, chosen_sections, report_task
from stereorig.server.workflows.analysis import start as analysis_start
from stereorig.server.workflows.analysis.framed import asked_of, results_in_frame
from stereorig.server.workflows.service import Service

_NAMES = "|".join(SECTIONS)
SectionsText = Annotated[
    str | None,
    Query(
        max_length=200,
        pattern=rf"^({_NAMES})(,({_NAMES}))*$",
        description=f"Sections of the report: {', '.join(SECTIONS)}; all if left out.",
        examples=["fields,histories"],
    ),
]
router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])


@router.get(
    "/report",
    summary="A report that a laboratory can file",
    response_class=HTMLResponse,
    responses=errors(404, 409, 422, 503, 507)
    | {
        200: {
            "description": "One HTML file that needs nothing else; X-Not-Stated: number of items without a statement.",
            "content": {"text/html": {"example": '<!doctype html><html lang="en">...'}},
        }
    },
)
async def get_report(
    request: Request,
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    coverage: CoverageDep,
    frame: FrameText = None,
    sections: SectionsText = None,
) -> Response:
    """Answer with the report of the finished steps: rig, settings, noise floor, calibration, pictures, tables, courses.

    Facts that no device reports come from `PUT /tests/{test_id}/metadata`; missing ones are listed as not stated. The
    logo is the data folder's report_logo.png, .jpg or .svg.
    """
    asked = tuple(SECTIONS) if sections is None else sections.split(",")
    options = ReportOptions(chosen_sections(asked), service_url=str(request.base_url))
    results, stale = await run_in_threadpool(_prepared, service, test_id, analysis_id)
    service.require_room()
    folder = await run_in_threadpool(service.exports.new_folder)
    try:
        framed = await run_in_threadpool(_framed, service, test_id, analysis_id, frame, folder / "frame")
        task = service.exports.run(report_task, results, str(folder), coverage, framed, options)
        policy, missing = await finished(request, task)
        page = await run_in_threadpool((folder / NAME).read_bytes)
    finally:
        await run_in_threadpool(shutil.rmtree, folder, ignore_errors=True)
    headers = {"Content-Security-Policy": policy, "X-Not-Stated": str(missing)}
    return HTMLResponse(page, headers=headers | ({"X-Stale": "; ".join(stale)} if stale else {}))


def _framed(service: Service, test_id: str, analysis_id: str, frame: str | None, folder: Path) -> list[str]:
    if asked_of(service, test_id, frame) is None:
        return []
    steps = service.tests.analyses.finished_steps(test_id, analysis_id)
    files = [service.tests.analyses.result_file(test_id, analysis_id, n) for n in steps]
    return [str(path) for path in results_in_frame(service, test_id, files, frame, folder)]


def _prepared(service: Service, test_id: str, analysis_id: str) -> tuple[str, list[str]]:
    document = service.tests.analyses.read(test_id, analysis_id)
    there = service.tests.analyses.finished_steps(test_id, analysis_id)
    if not there:
        raise NotFoundError(
            f"Analysis {analysis_id} has no finished step.",
            code="no_results",
            remedy="Wait for its job, or measure again.",
        )
    for n in there:
        service.tests.analyses.result_file(test_id, analysis_id, n)  # whose checksum is compared
    return str(service.tests.analyses.path(test_id, analysis_id)), analysis_start.stale_reasons(
        service, test_id, document
    )
