"""Lays out Markdown that scripts write, puts it between a page's marks, and writes its tables as CSV files."""

from __future__ import annotations

import csv
import re
import textwrap
from pathlib import Path

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


def marked(page: str, name: str, text: str) -> str:
    """Return a page with a text between its marks ``<!-- name: begin -->`` and ``<!-- name: end -->``."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, after = page[: page.index(begin)], page[page.index(end) :]
    return f"{before}{begin}\n{text.strip()}\n{after}"


def write_tables(text: str, folder: Path, name: str) -> int:
    """Write each table of a Markdown text as a CSV file, the text before it as lines that begin with ``#``.

    Parameters
    ----------
    text
        Paragraphs, lists, tables, headings and plots, apart by empty lines.
    folder, name
        The files are ``name.csv``, or ``name_1.csv`` and so on if there is more than one.

    Returns
    -------
    int
        Number of tables; nothing is written if there is none.
    """
    tables: list[list[list[str]]] = []
    notes: list[list[str]] = [[]]
    for block in re.split(r"\n\s*\n", text.strip()):
        if block.startswith("|"):
            rows = [[part.strip() for part in line.strip().strip("|").split("|")] for line in block.splitlines()]
            tables.append([rows[0], *rows[2:]])
            notes.append([])
        else:
            plot = re.sub(r"^!\[(.*)\]\(.*/(.*)\)$", r"plot: docs/figures/\2: \1", block)
            notes[-1] += re.sub(r"\n(?!- )\s*", " ", plot).splitlines()
    if tables:
        folder.mkdir(parents=True, exist_ok=True)
        notes[len(tables) - 1] += notes.pop()
    for n, (rows, lines) in enumerate(zip(tables, notes, strict=False), start=1):
        path = folder / (f"{name}.csv" if len(tables) == 1 else f"{name}_{n}.csv")
        with path.open("w", encoding="utf-8", newline="") as file:
            file.writelines(f"# {line}\n" for line in lines)
            csv.writer(file, lineterminator="\n").writerows([cell.strip("*") for cell in row] for row in rows)
    return len(tables)
