"""What must be known before an analysis' results are used, as the API shows it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence

from core.errors import FileFormatError
from server.base.errors import NotFoundError
from server.workflows.service import Service


def with_warnings(service: Service, test_id: str, entries: Sequence[Mapping[str, object]]) -> list[dict[str, object]]:
    """Return entries of analyses in a list with their warnings; without those of one that cannot be read."""
    made = []
    for entry in entries:
        found: list[dict[str, object]] = []
        with contextlib.suppress(FileFormatError, NotFoundError):
            found = service.checks.of(test_id, str(entry["id"])).plain_warnings()
        made.append({**entry, "warnings": found})
    return made
