"""A certificate as a job: read and judged in a process of its own, then stored."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from stereorig.core.errors import StereorigError
from stereorig.server.documents.made import CertificateRecord
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.service import Service
from stereorig.server.workflows.waiting import result_of

DOCUMENT, PAGE = "certificate.json", "certificate.html"
#: analysis' folder, plan, id and folder for both files -> the verdict
Task = Callable[[str, str, str, str], str]


def start_certificate(
    service: Service, test_id: str, analysis_id: str, plan_json: str, task: Task, request: RequestMark
) -> Job:
    """Begin to make a certificate; the job's result has its id and verdict.

    Raises
    ------
    NotFoundError
        There is no such test or analysis.
    QueueFullError
        ``exports_waiting`` if four are on their way.
    """
    service.require_room()
    service.exports.check_room()
    folder = service.tests.analyses.path(test_id, analysis_id)

    def run(job: Job) -> dict[str, object]:
        for n in service.tests.analyses.finished_steps(test_id, analysis_id):
            service.tests.analyses.result_file(test_id, analysis_id, n)  # whose checksum is compared
        certificate_id = service.certificates.new_id()
        out = service.exports.new_folder()
        try:
            outcome = result_of(service.exports.run(task, str(folder), plan_json, certificate_id, str(out)), job)
            document = json.loads((Path(out) / DOCUMENT).read_bytes())
            with service.tests.still():  # prevents deletion of its inputs while it is stored
                service.certificates.put(certificate_id, document, (Path(out) / PAGE).read_bytes())
        finally:
            shutil.rmtree(out, ignore_errors=True)
        service.hub.publish("certificate", {"certificate_id": certificate_id, "outcome": outcome})
        return {"certificate_id": certificate_id, "outcome": outcome}

    subject = {"test_id": test_id, "analysis_id": analysis_id}
    return service.jobs.submit("certificate", "a certificate", subject, [Phase("beside", run)], request=request)


# Validity of a certificate: its inputs are as they were.

CertificateState = Literal["valid", "failed", "expired", "void", "withdrawn"]


def state_of(service: Service, record: CertificateRecord) -> tuple[CertificateState, str]:
    """Return a certificate's state now, and why; it is void once another calibration was made after it."""
    withdrawn = service.certificates.withdrawn(record.id)
    if withdrawn is not None:
        return "withdrawn", f"withdrawn by {withdrawn.get('by')}: {withdrawn.get('reason')}"
    if record.outcome == "fail":
        return "failed", "the verdict is fail"
    until = record.valid_until_utc
    if until is None or datetime.now(UTC) > datetime.fromisoformat(until):
        return "expired", f"it held until {until}"
    newer = _newer_calibration(service, record)
    if newer is not None:
        return "void", f"calibration {newer} was made after it"
    return "valid", ""


def _newer_calibration(service: Service, record: CertificateRecord) -> str | None:
    made = datetime.fromisoformat(record.created_utc)
    for calibration_id in reversed(service.calibrations.ids()):
        with contextlib.suppress(StereorigError, ValueError):  # one that is damaged voids nothing
            found = service.calibrations.read(calibration_id)
            if datetime.fromisoformat(found.plan.created_utc) <= made:
                return None
            changed = found.state == "complete"
            if changed and service.calibrations.checksum(calibration_id) != record.made_of.calibration_sha256:
                return calibration_id
    return None
