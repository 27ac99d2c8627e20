"""Files that survive a kill at any instant.

Every file of the data folder comes into being here: written under a temporary name in its own folder, fsynced, renamed, and the folder
fsynced. Whoever finds a file under its real name finds all of it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

from core.errors import FileFormatError, StorageError

TEMPORARY_SUFFIX = ".tmp"
_FULL = (errno.ENOSPC, errno.EDQUOT)


def storage_error(error: OSError, path: Path) -> StorageError:
    """Turn an operating system error into ``storage_full`` or ``storage_failed``."""
    if error.errno in _FULL:
        return StorageError(
            f"No space left to write {path.name}: {error.strerror}.",
            code="storage_full",
            remedy="Free space on the data folder's disk; what was not acknowledged was not kept.",
            file=path.name,
        )
    return StorageError(f"Writing {path.name} failed: {error.strerror or error}.", file=path.name)


def fsync_folder(folder: Path) -> None:
    """Make renames and new names in ``folder`` durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Create ``folder`` durably; its parent must exist.

    Raises
    ------
    StorageError
        If it exists already or cannot be created.
    """
    try:
        folder.mkdir()
        fsync_folder(folder.parent)
    except OSError as error:
        raise storage_error(error, folder) from error


def publish(path: Path, write: Callable[[Path], None]) -> None:
    """Let ``write`` produce a temporary file beside ``path``, then make it durable under its real name.

    Raises
    ------
    StorageError
        If any step fails; nothing is then visible under ``path``.
    """
    # the name ends as the real one does, for writers that look at it
    temporary = path.with_name(f".{secrets.token_hex(4)}{TEMPORARY_SUFFIX}.{path.name}")
    try:
        write(temporary)
        descriptor = os.open(temporary, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(temporary, path)
        fsync_folder(path.parent)
    except OSError as error:
        raise storage_error(error, path) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> str:
    """Write ``data`` durably; return its SHA-256 in hex."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(data)

    publish(path, write)
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


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def without_nan(value: Any) -> Any:
    """Replace NaN and infinities by None, tuples by lists, in nested JSON-like data."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(k): without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(v) for v in value]
    return value
