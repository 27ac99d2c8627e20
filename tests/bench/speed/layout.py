"""What the pages of the speed bench are laid out of: tables, figures of three digits, plots beside the page."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

DOCS = Path(__file__).resolve().parents[3] / "docs"


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def thousands(value: float) -> str:
    """Three digits that count, with commas."""
    if not np.isfinite(value):
        return "-"
    digits = max(0, int(np.floor(np.log10(abs(value)))) - 2) if value else 0
    return f"{round(value / 10**digits) * 10**digits:,.0f}"


def of_threads(n: int) -> str:
    """A number of threads in words."""
    return "1 thread" if n == 1 else f"{n} threads"


def save(figure: plt.Figure, name: str, caption: str) -> str:
    """Write a plot and return its line in the page."""
    (DOCS / "figures").mkdir(exist_ok=True)
    figure.savefig(DOCS / "figures" / name, dpi=110)
    plt.close(figure)
    return f"![{caption}](../figures/{name})"
