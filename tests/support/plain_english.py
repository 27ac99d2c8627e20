"""Plain English: count turns of phrase that engineers do not use, in 10,000 words of docstrings and comments.

``python -m tests.support.plain_english`` ends with 1 if a figure is above its limit and shows the places. The limits
are about twice what ophyd-async, httpx, trio and scikit-image have.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

#: in 10,000 words
LIMITS = {
    r"\bwhat\b": 12,
    r"\b(?:told|tells?|untold|says|said)\b": 5,
    r"\b(?:nobody|somebody|everybody|anybody|whoever|whatever|whichever|no one)\b": 2,
    r"\b(?:anew|beside|besides|aside|apart|thereby|therein|whence|hence|meanwhile)\b": 5,
    r"\b(?:stands?|stood|lies?|lay|goes on|go on|went on|goes over|comes? of|came of)\b": 6,
    r"^\s*(?-i:Of) (?:the|a|an|its|each|all|which|both|one|this|that)\b": 3,
    r"\bone's\b|\bother one\b|\bthat one\b|\bthose of\b|\bthat of\b": 8,
    r"\bwhere (?:there|it|they|nothing|none|no|that|this|one)\b": 5,
}
PACKAGES = ("core", "drivers", "server", "sim", "stereorig")


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring and comment."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield node.body[0].lineno, text
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("#: ")


def too_often(found: list[tuple[str, str]]) -> list[str]:
    """Return a line for each figure above its limit, and for each place that counts in it; ``found`` is place, text."""
    words = sum(len(text.split()) for _, text in found)
    complaints = []
    for pattern, limit in LIMITS.items():
        places = [where for where, text in found for _ in re.findall(pattern, text, re.I | re.M)]
        if 1e4 * len(places) / words > limit:
            complaints += [f"{pattern}: {len(places)} in {words} words, at most {limit} in 10,000", *places]
    return complaints


def main() -> int:
    """Check each package; return the exit status."""
    complaints = []
    for package in PACKAGES:
        names = subprocess.check_output(["git", "ls-files", f"{package}/*.py"], text=True).split()
        sources = {name: Path(name).read_text("utf-8") for name in names}
        found = [(f"{name}:{line}", text) for name, source in sources.items() for line, text in texts(source)]
        complaints += [f"{package}: {one}" for one in too_often(found)]
    print("\n".join(complaints))
    return bool(complaints)


if __name__ == "__main__":
    sys.exit(main())
