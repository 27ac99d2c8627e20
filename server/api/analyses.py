"""Analyses of a test."""

from __future__ import annotations

import base64
import binascii
from typing import Any

from fastapi import APIRouter

from core.errors import RegionError
from server import analyses
from server.api.dependencies import AnalysisId, KeyHeader, ServiceDep, TestId, mark
from server.api.models import AnalysisAccepted, AnalysisReply, AnalysisRequest
from server.api.problems import errors
from server.errors import NotFoundError
from server.io.noise_json import load_noise
from server.jobs import Phase
from server.service import Service
from server.store.index import analysis_entry
from server.version import software_version

router = APIRouter(prefix="/tests/{test_id}/analyses", tags=["analyses"])


@router.post(
    "",
    summary="Measure a test's steps",
    response_model=AnalysisAccepted,
    status_code=202,
    responses=errors(404, 409, 422, 503, 507),
)
def create_analysis(
    service: ServiceDep, test_id: TestId, body: AnalysisRequest, key: KeyHeader = None
) -> dict[str, Any]:
    """Compute shape and displacement over a region; results can be read step by step as they are finished."""
    calibration = service.tests.calibration_file(test_id)
    steps = analyses.steps_to_measure(service, test_id, body.reference, body.steps)
    mask = _mask_bytes(body)
    settings = body.model_dump(exclude={"kind", "label", "steps", "noise_id"})
    noise = None if body.noise_id is None else service.noise.file(body.noise_id)
    settings["noise"] = None if noise is None else {"noise_id": body.noise_id, **load_noise(noise).record()}
    settings["region"].pop("mask_png_base64")
    analyses.check_region(service, test_id, steps[0], settings, mask)
    request = mark(f"tests/{test_id}/analyses", key, body)

    def make() -> dict[str, Any]:
        made: dict[str, Any] = {}
        document = {
            "kind": body.kind,
            "label": body.label,
            "settings": settings,
            "steps": steps,
            "software": software_version(),
            "inputs": analyses.inputs_of(service, test_id, steps, calibration),
            **request.document(),
        }

        def prepare() -> dict[str, Any]:
            stored = service.tests.create_analysis(test_id, document, mask, noise)
            made["analysis_id"] = stored["id"]
            return {"test_id": test_id, **made}

        job = service.jobs.submit(
            "analysis",
            "an analysis",
            {"test_id": test_id},
            [Phase("compute", lambda job: analyses.run_analysis(service, job, test_id, made["analysis_id"]))],
            prepare=prepare,
            on_end=lambda job, state: analyses.close(service, job, test_id, made["analysis_id"], state),
        )
        stored = service.tests.analysis(test_id, made["analysis_id"])
        service.catalog.put_entry(
            "analysis", test_id, made["analysis_id"], analysis_entry({**stored, "job_id": job.id})
        )
        return {**made, "job_id": job.id}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return {"job": service.jobs.document(made["job_id"]), "analysis_id": made["analysis_id"]}


def _mask_bytes(body: AnalysisRequest) -> bytes | None:
    text = body.region.mask_png_base64
    if text is None:
        return None
    try:
        return base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise RegionError(
            f"The mask is no base64: {error}.", code="mask_unreadable", remedy="Send a PNG in base64."
        ) from error


def analysis_reply(service: Service, test_id: str, analysis_id: str) -> dict[str, Any]:
    """Return an analysis as the API shows it."""
    document = service.tests.analysis(test_id, analysis_id)
    summary = service.tests.summary(test_id, analysis_id)
    entries = service.catalog.entries("analysis", test_id)
    job_id = next((e.get("job_id") for e in entries if e["id"] == analysis_id), None)
    state = summary["state"] if summary else "interrupted"
    job: dict[str, Any] | None = None
    if job_id is not None:
        try:
            job = service.jobs.document(job_id)
            state = job["state"]
        except NotFoundError:
            job_id = None  # the catalogue was lost with its jobs; the files tell the rest
    problem = job["problem"] if job else (summary or {}).get("problem")
    return {
        **{k: v for k, v in document.items() if k != "request"},
        "state": state,
        "job_id": job_id,
        "problem": problem,
        "steps_finished": service.tests.finished_steps(test_id, analysis_id),
        "summary": summary,
    }


@router.get("", summary="A test's analyses, oldest first", responses=errors(404))
def list_analyses(service: ServiceDep, test_id: TestId) -> dict[str, Any]:
    """Return the analyses of a test."""
    service.tests.path(test_id)
    return {"analyses": service.catalog.entries("analysis", test_id)}


@router.get("/{analysis_id}", summary="One analysis", response_model=AnalysisReply, responses=errors(404))
def get_analysis(service: ServiceDep, test_id: TestId, analysis_id: AnalysisId) -> dict[str, Any]:
    """Return settings, state and summary."""
    return analysis_reply(service, test_id, analysis_id)
