"""A report as a task of the process beside the service."""

from __future__ import annotations

from pathlib import Path

from core.settings import Coverage

NAME = "report.html"


def report_task(results: str, out: str, coverage: Coverage) -> tuple[str, int]:
    """Make an analysis' report; return its Content-Security-Policy and the number of items that are not stated."""
    # matplotlib is loaded here alone
    from server.report.build import make_report
    from server.report.source import find_source

    made = make_report(find_source(Path(results)), coverage)
    (Path(out) / NAME).write_bytes(made.page)
    return made.policy, len(made.missing)
