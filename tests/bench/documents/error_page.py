"""The page of errors: every code with its status, causes and remedies, from the list that the source gives."""

from __future__ import annotations

import json

from tests.bench.documents.problem_list import LIST
from tests.bench.documents.prose import cell

_HEAD = """# Errors

Every error has a stable code, a cause and a remedy: one line from the command line, `application/problem+json` from the API. The
running service explains them under `/problems` too. Words in braces stand for values. Written by `make reference`.
Status codes of points are in [result files](result_files.md#point-status).

"""


def _sentences(texts: list[str]) -> str:
    return "<br>".join(cell(text).replace("<", "&lt;").replace("*", "\\*") for text in texts)


def pages() -> dict[str, str]:
    """Return the page by its path below docs/reference."""
    problems = json.loads(LIST.read_text(encoding="utf-8"))
    letters = sorted({code[0] for code in problems})
    lines = [" ".join(f"[{letter.upper()}](#{letter})" for letter in letters), ""]
    for letter in letters:
        lines += [f"## {letter.upper()}", "", "| code | HTTP | cause | remedy |", "| --- | --- | --- | --- |"]
        for code, entry in problems.items():
            if code.startswith(letter):
                statuses = ", ".join(str(status) for status in entry["status"])
                causes, remedies = _sentences(entry["causes"]), _sentences(entry["remedies"])
                lines.append(f"| `{code}` | {statuses} | {causes} | {remedies} |")
        lines.append("")
    return {"errors.md": _HEAD + "\n".join(lines).rstrip() + "\n"}
