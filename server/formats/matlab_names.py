"""Names as MATLAB takes them."""

from __future__ import annotations

import re

_MAX_NAME = 63  # namelengthmax
_KEYWORDS = frozenset(
    {
        "break",
        "case",
        "catch",
        "classdef",
        "continue",
        "else",
        "elseif",
        "end",
        "for",
        "function",
        "global",
        "if",
        "otherwise",
        "parfor",
        "persistent",
        "return",
        "spmd",
        "switch",
        "try",
        "while",
    }
)


def matlab_name(name: str) -> str:
    """Return a name as MATLAB takes it for a variable or field: letters, digits, underscores, a letter first."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", name)
    if not name or not name[0].isalpha() or name in _KEYWORDS:
        name = f"v_{name}"
    return name[:_MAX_NAME]
