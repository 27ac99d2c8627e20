"""Writes the pages of docs/reference that are made from the program itself: ``make reference``."""

from __future__ import annotations

from tests.bench.documents import api_pages, command_line, error_page, result_files, rig_file, settings_pages
from tests.bench.documents.prose import wrapped
from tests.support.requirements import ROOT

FOLDER = ROOT / "docs" / "reference"
MAKERS = (api_pages, command_line, error_page, result_files, rig_file, settings_pages)


def pages() -> dict[str, str]:
    """Return the text of every generated page by its path below docs/reference."""
    return {path: wrapped(text) for maker in MAKERS for path, text in maker.pages().items()}


def main() -> None:
    """Write them, and take away pages of tags that are gone."""
    made = pages()
    (FOLDER / "api").mkdir(exist_ok=True)
    for old in (FOLDER / "api").glob("*.md"):
        if f"api/{old.name}" not in made:
            old.unlink()
    for path, text in made.items():
        (FOLDER / path).write_text(text, encoding="utf-8")
    print(f"{len(made)} pages in {FOLDER}")


if __name__ == "__main__":
    main()
