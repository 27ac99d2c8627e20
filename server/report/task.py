"""A report as a task of the export process."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from stereorig.core.settings import Coverage
from stereorig.server.report.options import ReportOptions
from stereorig.server.worker.process import current_task

NAME = "report.html"


def report_task(
    results: str, out: str, coverage: Coverage, framed: Sequence[str] = (), options: ReportOptions | None = None
) -> tuple[str, int]:
    """Make an analysis' report; return its Content-Security-Policy and the number of items that are not stated.

    Parameters
    ----------
    framed
        Its result files in the frame of the report; those stored if left out.
    options
        Sections, logo, links.
    """
    # matplotlib is loaded here alone
    from stereorig.server.formats.results.folder import number_of
    from stereorig.server.report.build import make_report
    from stereorig.server.report.source import find_source

    source = find_source(Path(results))
    if framed:
        source = source.in_frame({number_of(path): path for path in map(Path, framed)})
    task = current_task()

    def progress(phase: str, done: int, total: int) -> None:
        task.check()
        task.progress(phase, done, total)

    made = make_report(source, coverage, options, progress)
    (Path(out) / NAME).write_bytes(made.page)
    return made.policy, len(made.missing)


# A certificate as a task of the export process.


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
