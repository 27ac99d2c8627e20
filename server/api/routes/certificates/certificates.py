"""Certificates: made from an analysis' results, listed with their state, shown, withdrawn."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse, Response

from stereorig.server.api.models.evidence.certificates import (
    CertificateList,
    CertificateReply,
    CertificateRequest,
    WithdrawRequest,
)
from stereorig.server.api.models.jobs import Accepted
from stereorig.server.api.protocol.dependencies import KeyHeader, ServiceDep, Wait, job_reply, mark, person_name
from stereorig.server.api.protocol.paging import PageDep
from stereorig.server.api.protocol.problems import errors
from stereorig.server.base.models import Ids
from stereorig.server.documents.made import CertificateRecord
from stereorig.server.report.task import certificate_task
from stereorig.server.workflows.certificates.job import start_certificate, state_of
from stereorig.server.workflows.service import Service

router = APIRouter(prefix="/certificates", tags=["certificates"])
CertificateId = Annotated[str, Path(max_length=40, description="Id of a certificate.")]
_ENTRY = ("id", "title", "outcome", "created_utc", "valid_until_utc")


@router.post("", summary="Make a certificate", status_code=202, responses=errors(404, 409, 422, 503, 507))
async def create_certificate(
    request: Request, service: ServiceDep, body: CertificateRequest, wait: Wait = 0.0, key: KeyHeader = None
) -> Accepted:
    """Judge the measuring system by the steps of an analysis and the known values in the plan.

    The job's result has `certificate_id` and `outcome`. The certificate's inputs cannot be deleted until it is
    withdrawn. The job fails with a `certificate_...` code, and nothing is stored, if a step, a picture or a reading
    is missing.
    """
    made = await run_in_threadpool(_begin, service, body, key)
    return Accepted.model_validate(await job_reply(request, service, str(made["job_id"]), wait_s=wait))


def _begin(service: Service, body: CertificateRequest, key: str | None) -> Ids:
    request = mark("certificates", key, body)

    def make() -> Ids:
        plan = body.plan.model_dump_json(exclude_unset=True)
        job = start_certificate(service, body.test_id, body.analysis_id, plan, certificate_task, request)
        return {"job_id": job.id}

    made, _ = service.once(request.scope, key, request.body_sha256, make)
    return made


@router.get("", summary="Certificates, oldest first", responses=errors(422))
def list_certificates(service: ServiceDep, page: PageDep) -> CertificateList:
    """Return a page of the certificates, each with its state now."""
    chosen = page.of(service.certificates.ids(), lambda one: one)
    shown = [_entry(service, service.certificates.read(certificate_id)) for certificate_id in chosen]
    return CertificateList.model_validate({"certificates": shown, "next_cursor": page.next_cursor})


@router.get("/{certificate_id:plain_id}", summary="One certificate", responses=errors(404))
def get_certificate(service: ServiceDep, certificate_id: CertificateId) -> CertificateReply:
    """Return verdict, reasons, suspected causes, and every table."""
    return _reply(service, certificate_id)


@router.get(
    "/{certificate_id}/report",
    summary="A certificate as a page",
    response_class=HTMLResponse,
    responses=errors(404)
    | {
        200: {
            "description": "The page as it was made: one HTML file that needs nothing else.",
            "content": {"text/html": {"example": '<!doctype html><html lang="en">...'}},
        }
    },
)
def get_certificate_report(service: ServiceDep, certificate_id: CertificateId) -> Response:
    """Return the certificate's page; a browser prints it as PDF."""
    record = service.certificates.read(certificate_id)
    headers = {"Content-Security-Policy": record.policy} if record.policy else {}
    return HTMLResponse(service.certificates.page(certificate_id), headers=headers)


@router.post("/{certificate_id}:withdraw", summary="Withdraw a certificate", responses=errors(404, 409, 422, 507))
def withdraw_certificate(
    request: Request, service: ServiceDep, certificate_id: CertificateId, body: WithdrawRequest
) -> CertificateReply:
    """Withdraw a certificate: it stays, with the reason, and its inputs can be deleted again."""
    service.certificates.withdraw(certificate_id, body.reason, person_name(request))
    service.hub.publish("certificate", {"certificate_id": certificate_id, "state": "withdrawn"})
    return _reply(service, certificate_id)


def _reply(service: Service, certificate_id: str) -> CertificateReply:
    record = service.certificates.read(certificate_id)
    rest = {name: value for name, value in record.plain().items() if name != "policy"}
    return CertificateReply.model_validate({**rest, **_entry(service, record)})


def _entry(service: Service, record: CertificateRecord) -> dict[str, object]:
    state, why = state_of(service, record)
    made_of = record.made_of
    return {
        **{name: getattr(record, name) for name in _ENTRY},
        "state": state,
        "why": why,
        "test_id": made_of.test_id,
        "analysis_id": made_of.analysis_id,
    }
