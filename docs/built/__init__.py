"""Sphinx extension: puts lists that are made from the program into the pages of the reference, as Sphinx reads them.

A page says where a list belongs, in a line like this one, which readers of the repository see::

    *Here the built site (`make docs`) lists every error.*
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path

from sphinx.application import Sphinx

from docs.built import api, command_line, problems, results, settings

PLACE = re.compile(r"^\*Here the built site \(`make docs`\) lists (?P<what>[^`]+)(?: `(?P<name>\w+)`)?\.\*$", re.M)
#: each list in Markdown, by what a page calls it; those of the second kind are given the name after it
LISTS: dict[str, Callable[[], str]] = {
    "every command and option": command_line.commands,
    "every error": problems.errors,
    "every variable": results.variables_table,
    "the status numbers of points": results.point_status,
    "the status numbers of strain": results.strain_status,
    "the keys of the summary": results.summary,
    "the keys of the rig file": settings.rig_file,
    "the keys of the target": settings.target,
    "the analysis settings": settings.analysis,
}
NAMED: dict[str, Callable[[str], str]] = {"the operations under": api.operations}


def filled(text: str) -> str:
    """Return a page's text with its lists in their places."""
    return PLACE.sub(lambda place: _listed(place["what"], place["name"]), text)


def _listed(what: str, name: str | None) -> str:
    return (NAMED[what](name) if name else LISTS[what]()).strip()


def _outdated(app: Sphinx, *_: object) -> Iterable[str]:
    # a list changes with the program, which no date of a page shows
    return [name for name in app.env.found_docs if PLACE.search(Path(app.env.doc2path(name)).read_text("utf-8"))]


def _read(_app: Sphinx, _name: str, source: list[str]) -> None:
    source[0] = filled(source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect both to Sphinx's events."""
    app.connect("env-get-outdated", _outdated)
    app.connect("source-read", _read)
    return {"parallel_read_safe": True}
