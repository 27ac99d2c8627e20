"""Files on disk: written aside, synced, renamed; and their checksums.

A file written here is either the whole new one or the old one, whatever happens in between.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from core.errors import InputError, StorageError

_FULL = (errno.ENOSPC, errno.EDQUOT)
_CHUNK_BYTES = 1 << 20


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hex."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def storage_error(error: OSError, path: Path) -> StorageError:
    """Turn a failed write into ``storage_full`` or ``storage_failed``."""
    reason = error.strerror or str(error)
    if error.errno in _FULL:
        remedy = "Free space on that disk, then run it again; nothing half-written was kept."
        return StorageError(f"No space left while writing {path} ({reason}).", code="storage_full", remedy=remedy)
    return StorageError(f"Writing {path} failed ({reason}).")


def fsync_path(path: Path) -> None:
    """Make a file's content, or a folder's renames and new names, durable."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


@contextlib.contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Give a temporary path in the same folder; on leaving, sync it, rename it to ``path``, sync the folder.

    If the body raises, the temporary file is removed and ``path`` is left as it was.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``, for any :class:`OSError` in the body or in the renaming.
    """
    aside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        yield aside
        fsync_path(aside)
        aside.replace(path)
        fsync_path(path.parent)
    except OSError as error:
        raise storage_error(error, path) from error
    finally:
        aside.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a whole file, see :func:`written_aside`."""
    with written_aside(path) as aside:
        aside.write_bytes(data)


def make_folder(path: Path) -> None:
    """Make an output folder, or check that it can take files.

    Raises
    ------
    InputError
        ``output_unusable`` if the path is a file, cannot be made, or cannot be written to.
    """
    remedy = "Give a folder that can be written to."
    if path.exists() and not path.is_dir():
        raise InputError(f"The output {path} is a file, not a folder.", code="output_unusable", remedy=remedy)
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{secrets.token_hex(4)}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"The output folder {path} cannot be written to ({reason}).",
                         code="output_unusable", remedy=remedy) from error  # fmt: skip
