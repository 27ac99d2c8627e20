"""Lays out Markdown that scripts write: paragraphs in lines of one width, tables, code and pictures as they are."""

from __future__ import annotations

import re
import textwrap

WIDTH = 120
_ITEM = re.compile(r"(\s*)([-*] |\d+\. )")


def wrapped(text: str, width: int = WIDTH) -> str:
    """Return the text with every paragraph and list item that has a longer line laid out anew."""
    lines: list[str] = []
    block: list[str] = []
    fenced = math = False

    def flush() -> None:
        if any(len(line) > width for line in block):
            lines.extend(_laid_out(block, width))
        else:
            lines.extend(block)
        block.clear()

    for line in text.split("\n"):
        if line.lstrip().startswith("```"):
            flush()
            fenced = not fenced
            lines.append(line)
        elif line.strip() == "$$":
            flush()
            math = not math
            lines.append(line)
        elif (
            fenced
            or math
            or not line.strip()
            or line.lstrip().startswith(("|", "!", "#", "<", ":", "$$"))
            or line.startswith("    ")
        ):
            flush()
            lines.append(line)
        else:
            if _ITEM.match(line):
                flush()
            block.append(line)
    flush()
    return "\n".join(lines)


def _laid_out(block: list[str], width: int) -> list[str]:
    item = _ITEM.match(block[0])
    first = item.group(0) if item else re.match(r"\s*", block[0])[0]  # type: ignore[index]
    text = " ".join(line.strip() for line in block)[len(first.strip()) :]
    return textwrap.wrap(
        text.strip(),
        width,
        initial_indent=first,
        subsequent_indent=" " * len(first),
        break_long_words=False,
        break_on_hyphens=False,
    )


def cell(text: str) -> str:
    """Return a text as a cell of a table."""
    return " ".join(text.replace("|", "\\|").split())
