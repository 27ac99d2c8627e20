"""A certificate as a job: read and judged in a process of its own, then stored."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

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
