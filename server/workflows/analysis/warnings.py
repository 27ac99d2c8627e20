"""Warnings to know before an analysis' results are used, as the API shows them."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence

from stereorig.core.errors import FileFormatError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.workflows.service import Service


def with_warnings(service: Service, test_id: str, entries: Sequence[Mapping[str, object]]) -> list[dict[str, object]]:
    """Return entries of analyses in a list with their warnings; an unreadable analysis gets none."""
    made = []
    for entry in entries:
        found: list[dict[str, object]] = []
        with contextlib.suppress(FileFormatError, NotFoundError):
            found = service.checks.of(test_id, str(entry["id"])).plain_warnings()
        made.append({**entry, "warnings": found})
    return made
