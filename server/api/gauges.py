"""Gauges: extensometers, lines, areas, rigid motion and frames over an analysis' results."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Body

from server.api.dependencies import AnalysisId, ServiceDep, TestId
from server.api.models import GaugesReply
from server.api.problems import errors
from server.gauge_request import GaugeRequest
from server.gauging import read_gauges

router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])
_EXAMPLES = {
    "extensometer": {
        "summary": "An extensometer and the mean displacement of an area, rigid motion taken out",
        "value": {
            "extensometers": [{"name": "axial", "a_px": [150.0, 200.0], "b_px": [350.0, 200.0]}],
            "areas": [{"rectangle_px": [150, 100, 350, 300]}],
            "variables": ["u_mm", "w_mm"],
            "remove_rigid": {},
        },
    },
    "line": {
        "summary": "Deflection along a line in the frame of the best-fit plane",
        "value": {
            "lines": [{"vertices_px": [[150.0, 200.0], [350.0, 200.0]], "count": 50}],
            "align": {"kind": "plane"},
            "steps": [3],
        },
    },
}


@router.post(
    "/gauges", summary="Read gauges in every step", response_model=GaugesReply, responses=errors(404, 409, 422)
)
def read(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    body: Annotated[GaugeRequest, Body(openapi_examples=_EXAMPLES)],
) -> dict[str, Any]:
    """Answer at once with what points, extensometers, lines and areas read in the finished steps; nothing is stored."""
    steps = service.tests.finished_steps(test_id, analysis_id)
    return read_gauges([service.tests.result_file(test_id, analysis_id, n) for n in steps], body)
