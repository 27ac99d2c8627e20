"""A point's history: one variable over the steps, in columns, a page at a time."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import Field

from stereorig.server.api.protocol.dependencies import AnalysisId, FrameText, ServiceDep, TestId
from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.analyses.results import FieldName
from stereorig.server.base.models import Listing
from stereorig.server.results.point_history import nearest_point, point_history
from stereorig.server.workflows.analysis.framed import result_in

router = APIRouter(prefix="/tests/{test_id}/analyses/{analysis_id}", tags=["results"])


class HistoryReply(Listing):
    """A variable of one point over the steps; each list has an entry a step."""

    row: int = Field(description="Row of the point.")
    col: int = Field(description="Column of the point.")
    distance_px: float = Field(description="Distance of the pixel asked for from the point.")
    variable: str = Field(description="The variable.", examples=["w_mm"])
    units: str = Field(description="Its unit; `1` for a pure number.", examples=["mm"])
    n: list[int] = Field(description="Numbers of the steps.")
    value: list[float | None] = Field(description="Values; null where the point failed, or the step lacks it.")
    sigma: list[float | None] = Field(description="Standard uncertainties; null where not known.")
    status: list[str] = Field(description="Status of the point in each step.")


@router.get("/history/{name}", summary="One variable of one point over the steps", responses=errors(404, 409, 422))
def get_history(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    name: FieldName,
    x_px: Annotated[float, Query(ge=0.0, le=32767.0, allow_inf_nan=False, description="Column in camera 1's image.")],
    y_px: Annotated[float, Query(ge=0.0, le=32767.0, allow_inf_nan=False, description="Row in camera 1's image.")],
    page: PageDep,
    frame: FrameText = None,
) -> HistoryReply:
    """Return a variable of the nearest point in a page of the finished steps, with its standard uncertainty."""
    finished = sorted(service.tests.analyses.finished_steps(test_id, analysis_id))
    chosen = page.of(finished, lambda n: f"{n:04d}")
    first = service.tests.analyses.result_file(test_id, analysis_id, finished[0] if finished else 0)
    place = nearest_point(first, x_px, y_px)
    files = [result_in(service, test_id, analysis_id, n, frame, name) for n in chosen]
    found = point_history(files, name, place)
    columns = {"value": found.value, "sigma": found.sigma, "status": found.status}
    where = {"row": place.row, "col": place.col, "distance_px": place.distance_px}
    about = {"variable": name, "units": found.units, "n": chosen, "next_cursor": page.next_cursor}
    return HistoryReply.model_validate({**where, **about, **columns})
