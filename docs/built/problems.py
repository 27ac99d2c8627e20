"""The list of errors: every code with its status, causes and remedies."""

from __future__ import annotations

from docs.built.tables import cell, table
from stereorig.server.api.docs.pages import known_problems


def errors() -> str:
    """Return a table of codes for each first letter."""
    known = known_problems()
    letters = sorted({code[0] for code in known})
    parts = [" ".join(f"[{letter.upper()}](#{letter})" for letter in letters)]
    for letter in letters:
        rows = [
            (f"`{code}`", ", ".join(map(str, entry["status"])), _texts(entry["causes"]), _texts(entry["remedies"]))
            for code, entry in known.items()
            if code.startswith(letter)
        ]
        parts += [f"## {letter.upper()}", table(("code", "HTTP", "cause", "remedy"), rows)]
    return "\n\n".join(parts)


def _texts(texts: list[str]) -> str:
    return "<br>".join(cell(text).replace("<", "&lt;").replace("*", "\\*") for text in texts)
