"""Gauges: extensometers, lines, areas, rigid motion and frames over an analysis' results."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Query
from fastapi.responses import Response

from stereorig.core.errors import InputError, MeasurementError
from stereorig.server.api.models import GaugesReply
from stereorig.server.api.protocol.dependencies import AnalysisId, FrameText, ServiceDep, TestId
from stereorig.server.api.protocol.paging import Page, ShortPageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.formats.gauges.matlab import gauges_mat
from stereorig.server.formats.gauges.table import gauges_csv
from stereorig.server.formats.results.folder import number_of
from stereorig.server.results.gauges.fields import FieldWriter
from stereorig.server.results.gauges.readings import read_gauges, steps_asked
from stereorig.server.results.gauges.request import GaugeRequest
from stereorig.server.workflows.analysis.framed import asked_of
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])
_MATLAB = "application/x-matlab-data"
_TABLES = ("text/csv", _MATLAB)


@router.post(
    "/gauges/field",
    operation_id="make_gauge_field",
    summary="One step's field in another frame, or without its rigid motion",
    response_class=Response,
    responses=errors(404, 409, 422) | {200: {"content": {"application/x-netcdf": {}}}},
)
def field(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    body: GaugeRequest,
    step: Annotated[int, Query(ge=0, le=9999, description="Number of the step.")],
) -> Response:
    """Answer with a result file (NetCDF-4) of the step as `align` and `remove_rigid` ask for; nothing is stored."""
    source = service.tests.analyses.result_file(test_id, analysis_id, step)
    reference = service.tests.analyses.read(test_id, analysis_id).steps[0]
    # the reference's shape defines a frame
    steps = {reference, step} if reference in service.tests.analyses.finished_steps(test_id, analysis_id) else {step}
    files = [service.tests.analyses.result_file(test_id, analysis_id, n) for n in sorted(steps)]
    with tempfile.TemporaryDirectory() as folder:
        writer = FieldWriter(Path(folder), source.parent, body)
        readings = read_gauges(files, body.model_copy(update={"steps": None}), writer)
        problem = next(s.problem for s in readings.steps if s.n == step)
        if problem is not None:
            raise MeasurementError(problem.detail, code=problem.code, remedy=problem.remedy)
        content = (Path(folder) / source.name).read_bytes()
    headers = {"Content-Disposition": f'attachment; filename="{test_id}_{analysis_id}_{source.name}"'}
    return Response(content, media_type="application/x-netcdf", headers=headers)


@router.post(
    "/gauges",
    operation_id="read_gauges",
    summary="Read gauges in every step",
    response_model=GaugesReply,
    responses=errors(404, 409, 422) | {200: {"content": {media: {} for media in _TABLES}}},
)
def read(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    body: GaugeRequest,
    format: Annotated[  # noqa: A002
        Literal["json", "csv", "mat"], Query(description="mat: a MATLAB file with the CSV table's columns.")
    ] = "json",
    frame: FrameText = None,
    *,
    page: ShortPageDep,
) -> dict[str, object] | Response:
    """Answer with the readings of points, extensometers, lines and areas in the finished steps; nothing is stored.

    JSON holds a page of the steps, 100 or `limit` of them; `next_cursor` leads to the next page. A table is a
    file with all of them.
    """
    steps = service.tests.analyses.finished_steps(test_id, analysis_id)
    asked = asked_of(service, test_id, frame)
    if asked is not None and body.align is not None:
        raise InputError(
            "The frame is given twice, in `align` and in frame=.", code="option_conflict", remedy="Give one of them."
        )
    body = body if asked is None else body.model_copy(update={"align": asked})
    if format == "json":
        return _page(service, test_id, analysis_id, steps, body, page)
    readings = read_gauges([service.tests.analyses.result_file(test_id, analysis_id, n) for n in steps], body)
    headers = {"Content-Disposition": f'attachment; filename="{test_id}_{analysis_id}_gauges.{format}"'}
    if format == "csv":
        return Response(gauges_csv(readings), media_type="text/csv; charset=utf-8", headers=headers)
    return Response(gauges_mat(readings), media_type=_MATLAB, headers=headers)


def _page(
    service: Service, test_id: str, analysis_id: str, steps: Sequence[int], body: GaugeRequest, page: Page
) -> dict[str, object]:
    """Read the gauges in a page of the steps; the files of the others are not touched."""
    folder = service.tests.analyses.path(test_id, analysis_id)
    asked = [number_of(path) for path in steps_asked([folder / f"step_{n:04d}.nc" for n in steps], body)]
    shown = [n for n in asked if body.steps is None or n in body.steps]
    only = page.of(shown, lambda n: f"{n:04d}")
    needed = sorted({*only, asked[0], *(() if body.difference_from is None else (body.difference_from,))})
    files = [service.tests.analyses.result_file(test_id, analysis_id, n) for n in needed]
    readings = read_gauges(files, body.model_copy(update={"steps": needed}), only=only)
    whole = {"settings": body.model_dump(mode="json"), "next_cursor": page.next_cursor}
    return readings.document() | whole
