"""Files on disk: written under a temporary name, synced, renamed; and their checksums.

A file written here is either the whole new one or the old one, even if the program or the machine stops in between.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from stereorig.core.errors import FileFormatError, InputError, StorageError
from stereorig.server.formats import disk as _disk

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
    _disk.disk.sync(path)


def mark_of(found: os.stat_result) -> tuple[int, int, int]:
    """Return (inode, change time in ns, size in bytes); any write changes the time, which no program can set back."""
    return found.st_ino, found.st_ctime_ns, found.st_size


def checksum_file(path: Path) -> Path:
    """Path of a file's checksum, in the form that ``sha256sum -c`` reads."""
    return path.with_name(f"{path.name}.sha256")


def recorded_sha256(path: Path) -> str | None:
    """Return the checksum in the file's ``.sha256`` file; None if that does not exist or cannot be read."""
    try:
        text = checksum_file(path).read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError):
        return None
    return text[0] if text else None


def mismatch(name: str, of: str, folder: str) -> FileFormatError:
    """Return the error for a file that differs from the one that was written."""
    return FileFormatError(
        f"{name} of {of} does not match its checksum.",
        code="checksum_mismatch",
        remedy="Restore the file from a backup, or make it again; nothing else is touched.",
        file=f"{folder}/{name}",
    )


@contextlib.contextmanager
def written_temporary(path: Path, *, checksum: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the same folder; on leaving, sync it, rename it to ``path``, sync the folder.

    With ``checksum``, its SHA-256 file is written first, so that a file under its real name never lacks it.
    If the body raises, the temporary file is removed and ``path`` is left as it was.

    Raises
    ------
    StorageError
        ``storage_full`` or ``storage_failed``, for any :class:`OSError` in the body or in the renaming.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        yield temporary
        fsync_path(temporary)
        if checksum:
            write_bytes(checksum_file(path), f"{sha256_of(temporary)}  {path.name}\n".encode())
        _disk.disk.replace(temporary, path)
        fsync_path(path.parent)
    except OSError as error:
        raise storage_error(error, path) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes, *, checksum: bool = False) -> None:
    """Write a whole file, see :func:`written_temporary`."""
    with written_temporary(path, checksum=checksum) as temporary:
        _disk.disk.write(temporary, data)


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
        raise InputError(
            f"The output folder {path} cannot be written to ({reason}).", code="output_unusable", remedy=remedy
        ) from error
