"""Decisions have one form, numbers without gaps, and an index that lists them."""

from __future__ import annotations

import re

from tests.support.requirements import ROOT

FOLDER = ROOT / "docs" / "explanation" / "decisions"
FORM = re.compile(
    r"# (\d+)\. \S.*\n\nStatus: (proposed|accepted|replaced by \d+), \d{4}-\d\d-\d\d\n\n"
    r"## Context\n\n.+?\n\n## Decision\n\n.+?\n\n## Consequences\n\n.+",
    re.DOTALL,
)


def test_every_decision_has_the_template_and_the_next_number() -> None:
    index = (FOLDER / "index.md").read_text(encoding="utf-8")
    pages = sorted(FOLDER.glob("[0-9]*.md"))
    for number, page in enumerate(pages, 1):
        match = FORM.fullmatch(page.read_text(encoding="utf-8"))
        assert match, page.name
        assert (int(match[1]), int(page.name[:4])) == (number, number)
        assert f"]({page.name})" in index
