"""Results: fields, probe, files."""

from __future__ import annotations

import io
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Path, Query
from fastapi.responses import FileResponse, JSONResponse, Response

from server.api.dependencies import AnalysisId, ServiceDep, StepNumber, TestId
from server.api.models import FieldReply, ProbeReply
from server.api.problems import errors
from server.results import list_variables, probe_result, read_variable

router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])
FieldName = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,63}$", description="Variable of the result file.")]


def _nested(values: np.ndarray[Any, Any]) -> list[Any]:
    """Return nested lists with None for NaN."""
    if np.issubdtype(values.dtype, np.floating):
        held = values.astype(object)
        held[~np.isfinite(values)] = None
        return list(held.tolist())
    return list(values.tolist())


@router.get(
    "/steps/{n}/fields/{name}",
    summary="One variable of one step",
    response_model=FieldReply,
    responses=errors(404, 422) | {200: {"content": {"application/x-npy": {}}}},
)
def get_field(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    n: StepNumber,
    name: FieldName,
    format: Annotated[Literal["json", "npy"], Query()] = "json",  # noqa: A002
) -> Response:
    """Return values over the grid of points; null (NaN in npy) where a point failed."""
    variable = read_variable(service.tests.result_file(test_id, analysis_id, n), name)
    if format == "npy":
        buffer = io.BytesIO()
        np.save(buffer, variable.values, allow_pickle=False)
        headers = {"X-Units": variable.units}
        return Response(buffer.getvalue(), media_type="application/x-npy", headers=headers)
    return JSONResponse({
        "name": name,
        "units": variable.units,
        "long_name": variable.long_name,
        "shape": list(variable.values.shape),
        "values": _nested(variable.values),
    })  # fmt: skip


@router.get("/steps/{n}/fields", summary="The variables of one step", responses=errors(404, 422))
def list_fields(service: ServiceDep, test_id: TestId, analysis_id: AnalysisId, n: StepNumber) -> dict[str, Any]:
    """Return name, unit, meaning and dimensions of every variable."""
    return {"fields": list_variables(service.tests.result_file(test_id, analysis_id, n))}


@router.get(
    "/probe", summary="The measurement point nearest to a pixel", response_model=ProbeReply, responses=errors(404, 422)
)
def get_probe(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    x_px: Annotated[float, Query(ge=0.0, le=32767.0, allow_inf_nan=False)],
    y_px: Annotated[float, Query(ge=0.0, le=32767.0, allow_inf_nan=False)],
    step: Annotated[int, Query(ge=0, le=9999)] = 0,
) -> dict[str, Any]:
    """Return every number of the nearest point."""
    return {"step": step, **probe_result(service.tests.result_file(test_id, analysis_id, step), x_px, y_px)}


@router.get("/export", summary="A result as a file", response_class=FileResponse, responses=errors(404, 422))
def export(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    step: Annotated[int, Query(ge=0, le=9999)],
    format: Annotated[Literal["nc"], Query()] = "nc",  # noqa: A002, ARG001 - one format so far
) -> FileResponse:
    """Return the step's NetCDF-4 file as stored."""
    path = service.tests.result_file(test_id, analysis_id, step)
    return FileResponse(path, media_type="application/x-netcdf", filename=f"{test_id}_{analysis_id}_{path.name}")
