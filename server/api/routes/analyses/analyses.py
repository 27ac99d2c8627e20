"""Analyses of a test."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool

from stereorig.core.errors import InputError, RegionError
from stereorig.server.api.models import (
    AnalysisAccepted,
    AnalysisList,
    AnalysisReply,
    AnalysisRequest,
    AnalysisStepList,
    ContinueRequest,
    Region,
)
from stereorig.server.api.models.recipes import WORKSPACE, recipe_in
from stereorig.server.api.protocol.dependencies import AnalysisId, KeyHeader, ServiceDep, TestId, Wait, job_reply, mark
from stereorig.server.api.protocol.paging import FIGURES, WHOLE, PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.api.routes.tests.recipes import check_against_test
from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.models import Ids, JobState
from stereorig.server.base.problem import JobProblem
from stereorig.server.documents.tests import Finished, SummaryRecord
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.store.tests.steps import MAX_STEPS
from stereorig.server.workflows.analysis import start as analysis_start
from stereorig.server.workflows.analysis.listed import with_states
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}/analyses", tags=["analyses"])


@router.post("", summary="Measure a test's steps", status_code=202, responses=errors(404, 409, 422, 503, 507))
async def create_analysis(
    request: Request,
    service: ServiceDep,
    test_id: TestId,
    body: AnalysisRequest,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> AnalysisAccepted:
    """Compute shape and displacement over a region; results can be read step by step as they are finished."""
    made = await run_in_threadpool(_start, service, test_id, body, key)
    return await _accepted(request, service, made, wait)


def _start(service: Service, test_id: str, body: AnalysisRequest, key: str | None) -> Ids:
    request = mark(f"tests/{test_id}/analyses", key, body)

    def make() -> Ids:
        return _begin(service, test_id, _with_recipe(service, test_id, body), request)

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return made


def _with_recipe(service: Service, test_id: str, body: AnalysisRequest) -> AnalysisRequest:
    """Return a request with the recipe's values for the fields that it leaves out.

    Raises
    ------
    NotFoundError
        There is no such recipe.
    InputError
        ``recipe_invalid`` for one that cannot be used; ``recipe_other_size``, ``recipe_outside``.
    """
    if body.recipe is None:
        return body
    own = body.recipe == WORKSPACE
    recipe = recipe_in(
        service.tests.workspace(test_id) if own else service.recipes.find(body.recipe).recipe,
        name=f"The workspace of test {test_id}" if own else f"Recipe {body.recipe}",
    )
    check_against_test(service, test_id, recipe)
    stated = body.model_dump(mode="json", exclude_unset=True, exclude={"recipe"})
    whole = {**recipe.analysis(), **stated}
    if "region" not in whole:
        raise InputError(
            f"Neither the request nor recipe {body.recipe!r} has a region.",
            code="recipe_invalid",
            remedy="Give a region, or draw one and keep it with the recipe.",
        )
    return AnalysisRequest.model_validate(whole)


async def _accepted(request: Request, service: Service, made: Ids, wait_s: float) -> AnalysisAccepted:
    reply = await job_reply(request, service, str(made["job_id"]), wait_s=wait_s)
    return AnalysisAccepted.model_validate({**reply, "analysis_id": made["analysis_id"]})


def _begin(service: Service, test_id: str, body: AnalysisRequest, request: RequestMark) -> Ids:
    return analysis_start.begin(
        service,
        test_id,
        body.stored(),
        request,
        kind=body.kind,
        label=body.label,
        steps=body.steps,
        follow=body.follow,
        mask=mask_of(body.region),
        noise_id=body.noise_id,
        calibration_id=body.calibration_id,
    )


def mask_of(region: Region) -> bytes | None:
    """Return the PNG of a region's mask, or None.

    Raises
    ------
    RegionError
        ``mask_unreadable``.
    """
    text = region.mask_png_base64
    if text is None:
        return None
    try:
        return base64.b64decode(text, validate=True)
    except ValueError as error:  # binascii.Error, or letters beyond ASCII
        raise RegionError(
            f"The mask is no base64: {error}.", code="mask_unreadable", remedy="Send a PNG in base64."
        ) from error


@dataclass(frozen=True)
class _Course:
    """Course of an analysis: its last job, and the state of its steps."""

    job_id: str | None
    state: JobState
    problem: JobProblem | None
    failed: Mapping[str, JobProblem]
    summary: SummaryRecord | None


def _course(service: Service, test_id: str, analysis_id: str) -> _Course:
    summary = service.tests.analyses.summary(test_id, analysis_id)
    entry = service.catalog.entry("analysis", test_id, analysis_id) or {}
    job_id = entry.get("job_id")
    state: JobState = "interrupted" if summary is None else summary.state
    problem = None if summary is None else summary.problem
    failed: Mapping[str, JobProblem] = {} if summary is None else summary.steps_failed
    if summary is None or (summary.job_id or job_id) != job_id:  # killed, or at work, perhaps once more
        summary, problem, failed = None, None, {}
    if job_id is not None:
        try:
            job = service.jobs.document(str(job_id))
            state, problem = job.state, job.problem
            failed = failed or Finished.model_validate(job.result or {}).steps_failed
        except NotFoundError:
            job_id = None  # the catalogue was lost with its jobs; the files hold the rest
    return _Course(None if job_id is None else str(job_id), state, problem, failed, summary)


def analysis_reply(service: Service, test_id: str, analysis_id: str) -> AnalysisReply:
    """Return an analysis as the API shows it, with its first steps."""
    document = service.tests.analyses.read(test_id, analysis_id)
    course = _course(service, test_id, analysis_id)
    first = document.steps[:WHOLE]
    if course.summary is not None:
        shown: dict[str, object] | None = course.summary.model_copy(
            update={"steps": course.summary.steps[:FIGURES], "steps_failed": _first(course.summary.steps_failed)}
        ).plain()
    else:
        known = service.tests.analyses.step_summaries(test_id, analysis_id, first[:FIGURES])
        steps = [known[n].plain() for n in first[:FIGURES] if n in known]
        about = {"analysis_id": analysis_id, "state": course.state, "job_id": course.job_id}
        shown = {**about, "steps": steps} if steps else None
    finished = service.tests.analyses.finished_steps(test_id, analysis_id)
    checks = service.checks.of(test_id, analysis_id, course.failed)
    inputs = document.inputs.model_copy(update={"steps": dict(islice(document.inputs.steps.items(), WHOLE))})
    reply = {
        **document.model_copy(update={"steps": first, "inputs": inputs}).shown(),
        "calibration_sha256": document.inputs.calibration_sha256,
        "state": course.state,
        "job_id": course.job_id,
        "problem": course.problem,
        "n_steps": len(document.steps),
        "n_finished": len(finished),
        "n_failed": len(course.failed),
        "steps_finished": finished[:WHOLE],
        "steps_failed": _first(course.failed),
        "summary": shown,
        "stale": bool(checks.stale),
        "stale_reasons": list(checks.stale[:WHOLE]),
        "warnings": checks.plain_warnings(),
    }
    return AnalysisReply.model_validate(reply)


def _first(failed: Mapping[str, JobProblem]) -> dict[str, JobProblem]:
    return dict(islice(failed.items(), WHOLE))


@router.get("", summary="A test's analyses, oldest first", responses=errors(404, 422))
def list_analyses(service: ServiceDep, test_id: TestId, page: PageDep) -> AnalysisList:
    """Return the analyses of a test."""
    service.tests.path(test_id)
    rest = service.catalog.entries("analysis", test_id, after=page.after, limit=page.limit + 1)
    analyses_page = page.cut(rest, lambda a: str(a["id"]))
    shown = service.checks.with_warnings(test_id, with_states(service, test_id, analyses_page))
    return AnalysisList.model_validate({"analyses": shown, "next_cursor": page.next_cursor})


@router.get("/{analysis_id:plain_id}", summary="One analysis", responses=errors(404))
def get_analysis(service: ServiceDep, test_id: TestId, analysis_id: AnalysisId) -> AnalysisReply:
    """Return settings, state and summary, with the first 100 steps; see `GET .../analyses/{analysis_id}/steps`."""
    return analysis_reply(service, test_id, analysis_id)


@router.get("/{analysis_id}/steps", summary="An analysis' steps, in order", responses=errors(404, 422))
def list_analysis_steps(
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    page: PageDep,
    figures: Annotated[bool, Query(description="With the figures of each step's field.")] = True,
    first: Annotated[int, Query(ge=0, le=MAX_STEPS, description="Number of the first step in the answer.")] = 0,
) -> AnalysisStepList:
    """Return a page of the steps that an analysis measures, each with its state and figures."""
    document = service.tests.analyses.read(test_id, analysis_id)
    failed = _course(service, test_id, analysis_id).failed
    numbers = page.of(sorted(n for n in document.steps if n >= first), lambda n: f"{n:04d}")
    finished = set(service.tests.analyses.finished_steps(test_id, analysis_id))
    known = service.tests.analyses.step_summaries(test_id, analysis_id, numbers) if figures else {}
    steps = []
    for n in numbers:
        state = "finished" if n in finished else "failed" if str(n) in failed else "waiting"
        problem = failed.get(str(n)) if state == "failed" else None
        own = known[n].plain() if n in known else None
        sha256 = document.inputs.steps.get(str(n))
        steps.append({"n": n, "state": state, "problem": problem, "figures": own, "sha256": sha256})
    return AnalysisStepList.model_validate({"steps": steps, "next_cursor": page.next_cursor})


@router.post(
    "/{analysis_id}:continue",
    summary="Continue an analysis that stopped",
    status_code=202,
    responses=errors(404, 409, 422, 503, 507),
)
async def continue_analysis(
    request: Request,
    service: ServiceDep,
    test_id: TestId,
    analysis_id: AnalysisId,
    body: ContinueRequest | None = None,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> AnalysisAccepted:
    """Measure the open steps of an interrupted, cancelled or failed analysis, or of one with failed steps.

    Finished steps are kept, and the others are measured from them as they would have been: the results are the same as
    without the interruption. Steps that failed are tried again.
    """
    made = await run_in_threadpool(_go_on, service, test_id, analysis_id, body, key)
    return await _accepted(request, service, made, wait)


def _go_on(service: Service, test_id: str, analysis_id: str, body: ContinueRequest | None, key: str | None) -> Ids:
    body = body or ContinueRequest.model_validate({})
    service.tests.analyses.path(test_id, analysis_id)
    request = mark(f"tests/{test_id}/analyses/{analysis_id}:continue", key, body)

    def make() -> Ids:
        service.require_room()
        job = analysis_start.continue_analysis(service, test_id, analysis_id, request, other_version=body.other_version)
        return {"analysis_id": analysis_id, "job_id": job.id}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return {**made, "analysis_id": analysis_id}


@router.post(
    "/{analysis_id}:finish",
    summary="Let an analysis that follows its test come to its end",
    status_code=202,
    responses=errors(404, 409, 422),
)
async def finish_analysis(
    request: Request, service: ServiceDep, test_id: TestId, analysis_id: AnalysisId, wait: Wait = 0.0
) -> AnalysisAccepted:
    """Measure the steps committed so far, then end the job; cancelling it instead ends it at once."""
    made = await run_in_threadpool(_finish, service, test_id, analysis_id)
    return await _accepted(request, service, made, wait)


def _finish(service: Service, test_id: str, analysis_id: str) -> Ids:
    service.tests.analyses.path(test_id, analysis_id)
    runs = service.tests.analyses.jobs(test_id, analysis_id)
    job = service.jobs.finish(runs[-1].job_id if runs else "")
    return {"job_id": job.id, "analysis_id": analysis_id}
