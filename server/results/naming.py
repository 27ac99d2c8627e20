"""Names of exported files: those of the test, of the analysis and of the step, by which people know them."""

from __future__ import annotations

import re
from pathlib import Path

from stereorig.server.formats.channel_units import ascii_of
from stereorig.server.formats.results.folder import DENSE, number_of
from stereorig.server.store.durable import known_json

_LONGEST = 60


def file_name(text: str) -> str:
    """Return a text as a part of a file's name: letters, digits, points and hyphens; empty if it has none of these."""
    return re.sub(r"[^a-zA-Z0-9.]+", "-", ascii_of(text)).strip("-.")[:_LONGEST]


def analysis_name(folder: Path) -> str:
    """Return the name of an analysis' files: its test's name and its own label; ids in place of those left out.

    Parameters
    ----------
    folder
        The analysis' folder, or a test's of ``stereorig measure``.
    """
    test = folder.parent.parent
    name = file_name(str(known_json(test / "test.json").get("name") or "")) or test.name
    if folder.parent.name != "analyses":
        return name
    label = str(known_json(folder / "analysis.json").get("label") or "")
    return f"{name}_{file_name(label) or folder.name}"


def numbered(name: str, n: int, label: str) -> str:
    """Return the name of a step's file without its ending."""
    label = file_name(label)
    return f"{name}_step_{n:04d}{'_' if label else ''}{label}"


def stored_name(file: Path, home: Path) -> str:
    """Return the name of a result file of an analysis as it is downloaded."""
    n = number_of(file)
    label = str(known_json(home.parent.parent / "steps" / f"{n:04d}" / "step.json").get("label") or "")
    dense = "_dense" if file.parent.name == DENSE else ""
    return f"{numbered(analysis_name(home) + dense, n, label)}.nc"
