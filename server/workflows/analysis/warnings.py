"""What must be known before an analysis' results are used, as the API shows it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence

from core.errors import FileFormatError
from server.base.errors import NotFoundError
from server.base.problem import JobProblem
from server.results.warnings.analysis import analysis_warnings
from server.workflows.analysis.start import stale_reasons
from server.workflows.service import Service


def warnings_of(
    service: Service,
    test_id: str,
    analysis_id: str,
    *,
    stale: Sequence[str] = (),
    failed: Mapping[str, JobProblem] | None = None,
) -> list[dict[str, object]]:
    """Return what must be known before an analysis' results are used; see :func:`analysis_warnings`."""
    folder = service.tests.analysis_path(test_id, analysis_id)
    problems = None if failed is None else {n: one.plain() for n, one in failed.items()}
    return [one.plain() for one in analysis_warnings(folder, stale=stale, failed=problems)]


def with_warnings(service: Service, test_id: str, entries: Sequence[Mapping[str, object]]) -> list[dict[str, object]]:
    """Return entries of analyses in a list with their warnings; without those of one that cannot be read."""
    made = []
    for entry in entries:
        found: list[dict[str, object]] = []
        with contextlib.suppress(FileFormatError, NotFoundError):
            document = service.tests.analysis(test_id, str(entry["id"]))
            stale = stale_reasons(service, test_id, document)
            found = warnings_of(service, test_id, document.id, stale=stale)
        made.append({**entry, "warnings": found})
    return made
