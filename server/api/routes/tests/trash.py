"""Deleting into the trash, the trash, and the acknowledgement that a copy exists elsewhere."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from stereorig.server.api.models.tests import ExportedReply, ExportedRequest, TrashList
from stereorig.server.api.protocol.dependencies import (
    AnalysisId,
    CalibrationId,
    ServiceDep,
    StepNumber,
    TestId,
    person_name,
)
from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.calibrations.noise import NoiseId
from stereorig.server.documents.made import TrashEntry
from stereorig.server.store.trash import Kind, acknowledge_export
from stereorig.server.workflows.deletion import delete, restore
from stereorig.server.workflows.service import Service

router = APIRouter(tags=["trash"])
TrashId = Annotated[str, Path(max_length=40, description="Id in the trash.")]
_ERRORS = errors(404, 409, 507)


def _delete(service: Service, request: Request, kind: Kind, **ids: str | int | float) -> TrashEntry:
    return delete(service, kind, ids, by=person_name(request))


@router.delete("/tests/{test_id:plain_id}", summary="Delete a test", responses=_ERRORS)
def delete_test(service: ServiceDep, request: Request, test_id: TestId) -> TrashEntry:
    """Move a test with its steps and analyses into the trash; refused while a job or a capture uses it."""
    return _delete(service, request, "test", test_id=test_id)


@router.delete("/tests/{test_id}/steps/{n}", summary="Delete a step", responses=_ERRORS | errors(422))
def delete_step(service: ServiceDep, request: Request, test_id: TestId, n: StepNumber) -> TrashEntry:
    """Move a step into the trash; its number is not given again, and analyses that used it read `stale`."""
    return _delete(service, request, "step", test_id=test_id, n=n)


@router.delete("/tests/{test_id}/analyses/{analysis_id:plain_id}", summary="Delete an analysis", responses=_ERRORS)
def delete_analysis(service: ServiceDep, request: Request, test_id: TestId, analysis_id: AnalysisId) -> TrashEntry:
    """Move an analysis with its results into the trash; refused while its job runs."""
    return _delete(service, request, "analysis", test_id=test_id, analysis_id=analysis_id)


@router.delete("/calibrations/{calibration_id}", summary="Delete a calibration", responses=_ERRORS)
def delete_calibration(service: ServiceDep, request: Request, calibration_id: CalibrationId) -> TrashEntry:
    """Move a calibration into the trash; tests made with it keep their own copy."""
    return _delete(service, request, "calibration", calibration_id=calibration_id)


@router.delete("/noise/{noise_id}", summary="Delete a noise measurement", responses=_ERRORS)
def delete_noise(service: ServiceDep, request: Request, noise_id: NoiseId) -> TrashEntry:
    """Move a noise measurement into the trash; analyses made with it keep their own copy."""
    return _delete(service, request, "noise", noise_id=noise_id)


@router.get("/trash", summary="Contents of the trash, oldest first", responses=errors(422))
def list_trash(service: ServiceDep, page: PageDep) -> TrashList:
    """Return the entries of the trash, with the room that it takes."""
    trash = page.of(sorted(service.trash.entries(), key=lambda entry: entry.id), lambda entry: entry.id)
    return TrashList(trash=trash, next_cursor=page.next_cursor)


@router.post("/trash/{trash_id}:restore", summary="Restore from the trash", responses=_ERRORS)
def restore_trash(service: ServiceDep, trash_id: TrashId) -> TrashEntry:
    """Move it back to its place; refused if that place is taken by now, or its test is in the trash too."""
    return restore(service, trash_id)


@router.delete(
    "/trash/{trash_id:plain_id}",
    summary="Remove for good",
    status_code=204,
    response_class=Response,
    responses=errors(404, 507),
)
def remove_trash(service: ServiceDep, trash_id: TrashId) -> None:
    """Remove an entry of the trash from the disk; nothing brings it back."""
    service.trash.remove(trash_id)


@router.post(
    "/tests/{test_id}:acknowledge-export",
    summary="Acknowledge that a copy exists elsewhere",
    responses=errors(404, 409, 422, 507),
)
def acknowledge_exported(
    service: ServiceDep, request: Request, test_id: TestId, body: ExportedRequest
) -> ExportedReply:
    """Record that all of the test was copied elsewhere; the test shows it as `exported`, and nothing is deleted.

    The copy's contents are compared with the test's: a test that has grown since is refused.
    """
    return ExportedReply.model_validate(
        acknowledge_export(service.tests, test_id, steps=body.steps, results=body.results, by=person_name(request))
    )
