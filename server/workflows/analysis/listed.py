"""A test's analyses in a list: each with its state."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence

from stereorig.core.errors import FileFormatError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.workflows.service import Service


def with_states(service: Service, test_id: str, entries: Sequence[Mapping[str, object]]) -> list[dict[str, object]]:
    """Return entries of a test's analyses with their states; an unreadable analysis has none."""
    return [{**entry, "state": _state(service, test_id, entry)} for entry in entries]


def _state(service: Service, test_id: str, entry: Mapping[str, object]) -> str | None:
    if entry.get("job_id") is not None:
        with contextlib.suppress(NotFoundError):  # the catalogue was lost with its jobs; the files hold the rest
            return service.jobs.document(str(entry["job_id"])).state
    with contextlib.suppress(FileFormatError, NotFoundError):
        summary = service.tests.analyses.summary(test_id, str(entry["id"]))
        return "interrupted" if summary is None else summary.state
    return None
