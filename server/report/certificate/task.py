"""A certificate as a task of the export process."""

from __future__ import annotations

import json
from pathlib import Path


def certificate_task(results: str, plan_json: str, certificate_id: str, out: str) -> str:
    """Make the certificate of an analysis: ``certificate.json`` and ``certificate.html``; return the verdict."""
    # matplotlib is loaded with the report's library
    from stereorig.server.report.certificate.document import make_certificate
    from stereorig.server.report.source import find_source
    from stereorig.server.results.certificate.plan import plan_in

    plan = plan_in(json.loads(plan_json), name="the request")
    made = make_certificate(find_source(Path(results)), plan, certificate_id=certificate_id)
    (Path(out) / "certificate.html").write_bytes(made.page)
    (Path(out) / "certificate.json").write_text(json.dumps({**made.document, "policy": made.policy}), encoding="utf-8")
    return made.outcome
