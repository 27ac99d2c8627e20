"""Documents: a short entrance, links that lead somewhere, every page near the index, lines that can be read."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from docs.built import filled
from tests.support.requirements import ROOT

DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.rglob("*.md")), *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))]
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_FILE = re.compile(
    r"(?<![\w/.>])(?:core|drivers|sim|server|tests|config|deploy|docs)/[\w/]+\.(?:py|toml|json|md|service)\b"
)
#: where a question's answer is, and a text that the page must have
ANSWERS = {
    "How do I choose the subset?": "## Subset",
    "What does status 7 mean?": "| 7 | `epipolar_mismatch` |",
    "Which axes has `exx`?": "Axis 1 of strain (`exx`) is X_sys projected",
    "How do I add a stage?": "drivers/registry.py",
    "How do I calibrate?": "stereorig calibrate",
    "What file do I get, and how do I open it in MATLAB, ParaView or Python?": "ncread(",
    "How do I connect a load frame?": "load_n",
    "What does RBE mean?": "| RBE |",
    "What can it do with a crack?": "--crack",
    "How accurate is it?": "| measured |",
}


def plain(page: Path) -> str:
    """Return a page without its code."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"^(    .*)$", "", text, flags=re.MULTILINE)


def links(page: Path) -> Iterator[Path]:
    """Yield the files that a page links to."""
    for target in _LINK.findall(plain(page)):
        if not target.startswith(("http:", "https:", "#")):
            yield (page.parent / target.partition("#")[0]).resolve()


def test_the_readme_is_an_entrance() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 700
    assert text.split("\n\n")[1].startswith("Stereo digital image correlation (3-D DIC)")
    assert "](docs/figures/" in text
    assert all(command in text for command in ("make demo", "make test"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere_and_lines_can_be_read(page: Path) -> None:
    assert [str(target) for target in links(page) if not target.exists()] == []
    too_long = [line for line in plain(page).splitlines() if len(line) > 160 and not line.startswith(("|", "!"))]
    assert too_long == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_files_that_it_names_are_there(page: Path) -> None:
    if page.name == "CHANGELOG.md":
        return  # it names what is gone
    named = set(_FILE.findall(page.read_text(encoding="utf-8")))
    assert sorted(name for name in named if not (ROOT / name).exists()) == []


def test_a_folder_has_an_index_and_few_pages() -> None:
    for folder in ("tutorial", "how_to", "reference", "explanation"):
        pages = {path.name for path in (DOCS / folder).glob("*.md")}
        assert "index.md" in pages
        assert len(pages) <= 17


def test_every_page_is_within_three_clicks_of_the_index() -> None:
    near = {DOCS / "index.md"}
    for _ in range(3):
        near |= {target for page in near for target in links(page) if target.suffix == ".md" and target.exists()}
    assert {str(path.relative_to(DOCS)) for path in set(DOCS.rglob("*.md")) - near} == set()


@pytest.mark.parametrize("question", ANSWERS)
def test_a_newcomers_question_is_answered_from_the_index(question: str) -> None:
    row = next(
        line for line in (DOCS / "index.md").read_text(encoding="utf-8").splitlines() if f"| {question} |" in line
    )
    answers = [DOCS / target.partition("#")[0] for target in _LINK.findall(row)]
    assert any(ANSWERS[question] in filled(page.read_text(encoding="utf-8")) for page in answers)
