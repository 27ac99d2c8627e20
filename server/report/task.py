"""A report as a task of the export process, and the choices about it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from stereorig.core.errors import InputError
from stereorig.core.settings import Coverage
from stereorig.server.worker.process import current_task

NAME = "report.html"
#: sections by the name of their heading's anchor, in the order of the page
SECTIONS = {
    "fields": "maps of the steps that are drawn, and of the reference",
    "histories": "courses of load, motion, strain and gauges",
    "steps": "tables of the steps",
    "models": "comparison with a model",
    "test": "purpose, specimen, operator",
    "hardware": "cameras, lenses, geometry, light, pattern",
    "analysis": "subset, filters, strain window",
    "noise-floor": "noise floor and bias from static steps",
    "uncertainty": "sentence to quote, budgets",
    "calibration": "verdict, checks, parameters",
    "seen": "reference images with the measured points",
    "not-stated": "items that nobody stated",
    "annex": "settings and checksums of the files",
}


@dataclass(frozen=True)
class ReportOptions:
    """Choices about a report.

    Attributes
    ----------
    sections
        Names of :data:`SECTIONS`.
    logo
        File of the logo; None: ``report_logo.png``, ``.jpg`` or ``.svg`` of the data folder, if it has one.
    service_url
        Address of the service, whose forms the report links; empty: no links.
    """

    sections: Sequence[str] = field(default_factory=lambda: tuple(SECTIONS))
    logo: Path | None = None
    service_url: str = ""


def chosen_sections(names: Sequence[str]) -> tuple[str, ...]:
    """Return sections in the order of the page.

    Raises
    ------
    InputError
        An unknown name, or none.
    """
    unknown = [name for name in names if name not in SECTIONS]
    if unknown or not names:
        raise InputError(
            f"{unknown[0][:40]!r} is not a section of the report." if unknown else "No section is named.",
            remedy=f"Choose from {', '.join(SECTIONS)}.",
        )
    return tuple(name for name in SECTIONS if name in names)


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
