"""Drawing and settings of a test: stored as they are drawn, read and replaced as a whole."""

from __future__ import annotations

import base64

from fastapi import APIRouter, Response

from stereorig.server.api.models.recipes import Recipe, RecipeSettings, Workspace
from stereorig.server.api.protocol.delivery import IfMatch, etag_of, require_match, tagged
from stereorig.server.api.protocol.dependencies import AnalysisId, ServiceDep, TestId
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.tests.recipes import check_against_test, reference_size_px
from stereorig.server.formats.manifest import checked_bytes, is_there
from stereorig.server.formats.results.layout import stored_settings
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}", tags=["tests"])


@router.get(
    "/workspace",
    summary="Drawing and settings of a test",
    response_model_exclude_unset=True,
    responses=errors(404, 422),
)
def get_workspace(service: ServiceDep, test_id: TestId, response: Response) -> Workspace:
    """Return region, settings, gauges and display as they were drawn last; the header ETag names this state."""
    return Workspace.model_validate(tagged(response, service.tests.workspace(test_id)))


@router.put(
    "/workspace",
    summary="Store the drawing and settings of a test",
    response_model_exclude_unset=True,
    responses=errors(404, 412, 422, 507),
)
def put_workspace(
    service: ServiceDep, test_id: TestId, body: Workspace, response: Response, if_match: IfMatch = None
) -> Workspace:
    """Replace it; durable when this answers. If-Match, with the ETag of GET, refuses if another window drew since.

    A new analysis is not begun, and nothing that was measured changes. A report shows its gauges where the metadata
    name none.
    """
    service.tests.path(test_id)
    check_against_test(service, test_id, body)
    document = body.document()
    with service.changes:  # no other change comes between the check and this one
        before = etag_of(service.tests.workspace(test_id))
        require_match(if_match, before, f"the workspace of test {test_id}", required=False)
        service.tests.put_workspace(test_id, document)
    return Workspace.model_validate(tagged(response, document))


@router.get(
    "/analyses/{analysis_id}/recipe",
    summary="An analysis' region and settings, to be taken again",
    response_model_exclude_unset=True,
    responses=errors(404, 422),
)
def get_analysis_recipe(service: ServiceDep, test_id: TestId, analysis_id: AnalysisId) -> Recipe:
    """Return region and settings of an analysis, and the gauges and display of its test, as a recipe."""
    return Recipe.model_validate(_recipe_of(service, test_id, analysis_id))


def _recipe_of(service: Service, test_id: str, analysis_id: str) -> dict[str, object]:
    made = service.tests.analyses.read(test_id, analysis_id)
    stored = stored_settings(made.settings)
    kept = {
        k: v for k, v in stored.model_dump(mode="json").items() if k in RecipeSettings.model_fields and k != "region"
    }
    kept |= {"kind": made.kind or "displacement", "noise_id": None if stored.noise is None else stored.noise.noise_id}
    region = {k: v for k, v in stored.region.model_dump(mode="json", exclude={"mask"}).items() if v is not None}
    mask = service.tests.analyses.path(test_id, analysis_id) / "mask.png"
    if is_there(mask):
        region["mask_png_base64"] = base64.b64encode(checked_bytes(mask)).decode()
    drawn = {k: v for k, v in service.tests.workspace(test_id).items() if k in ("gauges", "display")}
    size = reference_size_px(service, test_id, stored.reference)
    return {"image_size_px": size, "region": region, "settings": kept, **drawn}
