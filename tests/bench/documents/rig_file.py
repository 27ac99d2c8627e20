"""The page of the rig file: every key, from the model that reads it."""

from __future__ import annotations

from server.config.reference import markdown
from tests.bench.documents.prose import wrapped
from tests.support.requirements import ROOT

PAGE = ROOT / "docs" / "reference" / "rig_file.md"


def pages() -> dict[str, str]:
    """Return the page by its path below docs/reference."""
    return {PAGE.name: wrapped(markdown())}
