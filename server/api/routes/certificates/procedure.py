"""A test's verification procedure: its plan, and the verb that takes the next step of it."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool

from stereorig.server.api.models.evidence.certificates import NextRequest, ProcedureReply
from stereorig.server.api.models.jobs import Accepted
from stereorig.server.api.protocol.dependencies import (
    Attached,
    KeyHeader,
    ServiceDep,
    TestId,
    Wait,
    get_service,
    job_reply,
    mark,
)
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Ids
from stereorig.server.results.certificate.procedure import PlannedProcedure
from stereorig.server.workflows.certificates.procedure import put_procedure, show_procedure, start_next
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/tests/{test_id}", tags=["certificates"])


@router.put("/certificate-plan", summary="Plan a verification procedure in a test", responses=errors(404, 422, 507))
def put_certificate_plan(service: ServiceDep, test_id: TestId, body: PlannedProcedure) -> ProcedureReply:
    """Keep the plan that is to be carried out; the numbers in it are those that the test will give its steps."""
    service.tests.path(test_id)
    put_procedure(service, test_id, body)
    return ProcedureReply.model_validate(show_procedure(service, test_id))


@router.get("/certificate-plan", summary="A test's verification procedure", responses=errors(404))
def get_certificate_plan(service: ServiceDep, test_id: TestId) -> ProcedureReply:
    """Return the plan, its steps with the person or device that acts, the steps taken, and the next one."""
    service.tests.path(test_id)
    return ProcedureReply.model_validate(show_procedure(service, test_id))


@router.post(
    "/certificate-plan:next",
    summary="Take the next step of a verification procedure",
    status_code=202,
    responses=errors(404, 409, 422, 503, 507),
)
async def take_next_step(
    request: Request,
    test_id: TestId,
    body: NextRequest | None = None,
    attached: Attached = False,
    wait: Wait = 0.0,
    key: KeyHeader = None,
) -> Accepted:
    """Move the stage if the step needs it, and capture; the job's result has the step's number.

    A step that is taken by hand is refused (`procedure_by_hand`, with the instruction) until `confirmed` states that
    it was done.
    """
    service = get_service(request)
    job_id = await run_in_threadpool(_begin, service, test_id, body or NextRequest(confirmed=False), key)
    return Accepted.model_validate(await job_reply(request, service, job_id, attached, wait))


def _begin(service: Service, test_id: str, body: NextRequest, key: str | None) -> str:
    service.tests.path(test_id)
    sent = mark(f"tests/{test_id}/certificate-plan", key, body)

    def make() -> Ids:
        return {"job_id": start_next(service, test_id, confirmed=body.confirmed, request=sent).id}

    made, _ = service.once(sent.scope, key, sent.body_sha256, make)
    return str(made["job_id"])
