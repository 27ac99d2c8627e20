"""An evaluation of several measurements by one recipe: a document for each, and one over all of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path

from stereorig.core.errors import InputError, StereorigError
from stereorig.core.progress import no_progress
from stereorig.server.evaluations.door import Evaluated, Evaluation, evaluate

FOLDER, NAME = "folder", "name"
_MOST = 1000
_REMEDY = "Give a CSV with the columns folder, name and those of settings, a measurement a row."


def rows_of(path: Path) -> list[dict[str, str]]:
    """Return the measurements of a table: a column ``folder``, perhaps ``name``, and one for each setting that differs.

    Raises
    ------
    InputError
        ``batch_invalid``.
    """
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.", code="batch_invalid", remedy=_REMEDY) from error
    table = csv.DictReader(io.StringIO(text))
    rows = [{key.strip(): (cell or "").strip() for key, cell in row.items() if key} for row in table]
    named = [row.get(NAME) or Path(row.get(FOLDER, "")).name for row in rows]
    why = "has no row" if not rows else f"has more than {_MOST} rows" if len(rows) > _MOST else ""
    if not why and not all(row.get(FOLDER) for row in rows):
        why = "has no column 'folder', or a row without one"
    if not why and len(set(named)) < len(named):
        why = "has two rows of one name"
    if not why and any(name in ("", ".", "..") or "/" in name or "\\" in name for name in named):
        why = "has a name that is no file name"
    if why:
        raise InputError(f"{path.name} {why}.", code="batch_invalid", remedy=_REMEDY)
    return [{**row, NAME: name} for row, name in zip(rows, named, strict=True)]


def run_batch(
    made: Evaluation,
    rows: list[dict[str, str]],
    settings: Mapping[str, object],
    base: Path,
    files_of: Callable[[Path], list[Path]],
    setting: Callable[[str], tuple[str, object]],
) -> tuple[dict[str, Evaluated], dict[str, StereorigError], Evaluated | None]:
    """Run an evaluation over each row's measurement; what is refused does not stop the others.

    Parameters
    ----------
    rows
        As of :func:`rows_of`; their settings count more than ``settings``.
    base
        Folder that the rows' folders are relative to.
    files_of, setting
        Return the result files of a folder, and a setting of ``KEY=VALUE``.

    Returns
    -------
    tuple
        What was found and what was refused, by name; and the evaluation over all, if it has one.
    """
    found: dict[str, Evaluated] = {}
    refused: dict[str, StereorigError] = {}
    for row in rows:
        own = dict(setting(f"{key}={text}") for key, text in row.items() if text and key not in (FOLDER, NAME))
        try:
            found[row[NAME]] = evaluate(made, files_of(base / row[FOLDER]), {**settings, **own}, no_progress)
        except StereorigError as error:
            refused[row[NAME]] = error
    over = getattr(made, "over", None)
    return found, refused, over({name: one.document for name, one in found.items()}) if over and found else None
