"""Files that survive a kill at any instant.

Every document of the data folder comes into being here: written aside in its own folder, fsynced, renamed, and the
folder fsynced (:mod:`server.io.files`). Whoever finds a file under its real name finds all of it.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

from core.errors import FileFormatError
from server.io.files import fsync_path, storage_error, written_aside


def make_folder(folder: Path) -> None:
    """Create ``folder`` durably; its parent must exist.

    Raises
    ------
    StorageError
        If it exists already or cannot be created.
    """
    try:
        folder.mkdir()
        fsync_path(folder.parent)
    except OSError as error:
        raise storage_error(error, folder) from error


def write_bytes(path: Path, data: bytes) -> str:
    """Write ``data`` durably; return its SHA-256 in hex."""
    with written_aside(path) as aside:
        aside.write_bytes(data)
    return hashlib.sha256(data).hexdigest()


def write_json(path: Path, document: Any) -> None:
    """Write a JSON document durably; NaN has no place in it and becomes null."""
    text = json.dumps(without_nan(document), indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, text.encode() + b"\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises
    ------
    FileFormatError
        If the file is missing, cut short or no object.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileFormatError(f"{path.name} is missing.", code="file_missing", file=path.name) from error
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path.name} cannot be read as JSON: {error}.", file=path.name) from error
    if not isinstance(document, dict):
        raise FileFormatError(f"{path.name} holds {type(document).__name__}, not an object.", file=path.name)
    return document


def without_nan(value: Any) -> Any:
    """Replace NaN and infinities by None, tuples by lists, in nested JSON-like data."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(k): without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return value
