"""Results: fields, probe, files."""

from __future__ import annotations

import io
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import Response
from pydantic_core import to_json

from stereorig.server.api.models import FieldList, FieldReply, ProbeReply
from stereorig.server.api.protocol.delivery import etag_of, tags_in
from stereorig.server.api.protocol.dependencies import (
    AnalysisId,
    Camera,
    CoverageDep,
    FrameText,
    ServiceDep,
    StepNumber,
    TestId,
)
from stereorig.server.api.protocol.problems import errors
from stereorig.server.formats.manifest import known_sha256
from stereorig.server.formats.results.reading import read_head
from stereorig.server.formats.results.uncertainty import Statement, read_included
from stereorig.server.formats.results.variables import described
from stereorig.server.results.field_forms import (
    MEDIA_TYPES,
    RANGE_PATTERN,
    FieldForm,
    Part,
    encode,
    image_positions,
    nested,
    take,
)
from stereorig.server.results.gauges.fields import AXES
from stereorig.server.results.gauges.frames import text_of
from stereorig.server.results.reader import list_variables, probe_result, read_cut_pieces
from stereorig.server.results.uncertainty import read_interval
from stereorig.server.workflows.analysis.framed import asked_of, result_in

router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])
FieldName = Annotated[str, Path(pattern=r"^[a-z][a-z0-9_]{0,63}$", description="Variable of the result file.")]


RangeText = Annotated[
    str | None,
    Query(
        max_length=13,
        pattern=RANGE_PATTERN,
        examples=["10:50"],
        description=("Part of the grid, start:stop from 0, stop not included; either can be left out."),
    ),
]


@router.get(
    "/steps/{n}/fields/{name}",
    summary="One variable of one step",
    response_model=FieldReply,
    responses=errors(404, 409, 422)
    | {
        200: {
            "description": "The values; the headers X-Shape, X-Units, X-Rows and X-Cols describe plain bytes.",
            "content": {media: {} for form, media in MEDIA_TYPES.items() if form != "json"},
        }
    },
)
def get_field(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    n: StepNumber,
    name: FieldName,
    request: Request,
    coverage: CoverageDep,
    format: Annotated[  # noqa: A002
        FieldForm,
        Query(
            description="json; npy; csv, one line a point; nc, NetCDF-4; f32, little-endian float32 row by row; png, "
            "a colour map with its bar."
        ),
    ] = "json",
    frame: FrameText = None,
    rows: RangeText = None,
    cols: RangeText = None,
    stride: Annotated[int, Query(ge=1, le=10000, description="Each so many-th row and column.")] = 1,
) -> Response:
    """Return values over the grid of points, or a part of it; null, NaN or nothing where a point failed.

    `sigma_NAME` is the standard uncertainty; with k or coverage there is `expanded_NAME` too. The header X-Uncertainty
    states the terms that they include.
    """
    path = result_in(service, test_id, analysis_id, n, frame, name)
    # a result never changes: the request and the file's checksum identify the answer
    etag = etag_of([known_sha256(path), name, format, rows, cols, stride, coverage.factor])
    headers = {"ETag": etag, "Cache-Control": "private, no-cache"}
    if etag in tags_in(request.headers.get("if-none-match", "")):
        return Response(status_code=304, headers=headers)
    statement = Statement(read_included(path), coverage)
    of_frame = "" if described(name).part == "none" else read_head(path).frame
    wanted = Part(rows, cols, stride)
    part = take(name, lambda one: read_interval(path, one, statement), wanted, statement.text, of_frame)
    headers |= part.headers | {"X-Uncertainty": statement.text}
    if format != "json":
        return Response(encode(part, format), media_type=MEDIA_TYPES[format], headers=headers)
    document = {
        "name": name,
        "units": part.variable.units,
        "long_name": part.variable.long_name,
        "shape": list(part.values.shape),
        "rows": headers["X-Rows"],
        "cols": headers["X-Cols"],
        "values": nested(part.values),
        "uncertainty": statement.document(),
        **({"frame": of_frame} if of_frame else {}),
    }
    return _json(document, headers)


def _json(document: dict[str, Any], headers: dict[str, str] | None = None) -> Response:
    # a hundred thousand numbers in a tenth of the time that the standard library takes
    return Response(to_json(document, inf_nan_mode="null"), media_type="application/json", headers=headers)


@router.get(
    "/steps/{n}/fields",
    summary="The variables of one step",
    response_model_exclude_none=True,
    responses=errors(404, 422),
)
def list_fields(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    n: StepNumber,
    coverage: CoverageDep,
    frame: FrameText = None,
) -> FieldList:
    """Return name, unit, meaning and dimensions of every variable; the meaning of status values; the cuts."""
    path = service.tests.analyses.result_file(test_id, analysis_id, n)
    fields, text = list_variables(path), read_head(path).frame
    asked = asked_of(service, test_id, frame)
    if asked is not None:
        text = f"{text_of(asked)}; before: {text}"
        fields = [v.model_copy(update={"long_name": v.long_name.replace("_sys", AXES)}) for v in fields]
    return FieldList.model_validate(
        {
            "fields": fields,
            "cuts_px": read_cut_pieces(path),
            "frame": text,
            "uncertainty": Statement(read_included(path), coverage).document(),
        }
    )


@router.get("/steps/{n}/places/{cam}", include_in_schema=False, response_model=FieldReply)  # its earlier address
@router.get(
    "/steps/{n}/positions/{cam}",
    summary="Positions of the points in a step's image",
    response_model=FieldReply,
    responses=errors(404, 409, 422) | {200: {"content": {"application/x-npy": {}}}},
)
def get_positions(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    n: StepNumber,
    cam: Camera,
    format: Annotated[Literal["json", "npy"], Query(description="Form of the answer.")] = "json",  # noqa: A002
) -> Response:
    """Return column and row of each point at that step, px, from the calibration; null if the point has none."""
    result = service.tests.analyses.result_file(test_id, analysis_id, n)
    measured = service.tests.analyses.read(test_id, analysis_id).inputs.calibration_sha256
    positions = image_positions(result, service.tests.calibration_file(test_id, measured), cam)
    if format == "npy":
        buffer = io.BytesIO()
        np.save(buffer, positions, allow_pickle=False)
        return Response(buffer.getvalue(), media_type="application/x-npy", headers={"X-Units": "pixel"})
    return _json(
        {
            "name": cam,
            "units": "pixel",
            "long_name": f"column and row of the point in {cam}'s image of step {n}",
            "shape": list(positions.shape),
            "values": nested(positions),
        }
    )


@router.get("/probe", summary="The measurement point nearest to a pixel", responses=errors(404, 422))
def get_probe(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    x_px: Annotated[float, Query(ge=0.0, le=32767.0, allow_inf_nan=False, description="Column in camera 1's image.")],
    y_px: Annotated[float, Query(ge=0.0, le=32767.0, allow_inf_nan=False, description="Row in camera 1's image.")],
    coverage: CoverageDep,
    step: Annotated[int, Query(ge=0, le=9999, description="Number of the step.")] = 0,
    frame: FrameText = None,
) -> ProbeReply:
    """Return every number of the nearest point, with its uncertainty."""
    path = result_in(service, test_id, analysis_id, step, frame)
    return ProbeReply.model_validate({"step": step, **dict(probe_result(path, x_px, y_px, coverage))})
