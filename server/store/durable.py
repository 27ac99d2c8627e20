"""Files that survive a kill at any instant.

Every document of the data folder comes into being here: written under a temporary name in its own folder, fsynced,
renamed, and the folder fsynced (:mod:`server.formats.files`). A file under its real name is complete.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from core.errors import FileFormatError
from server.base import long_json
from server.base.json_values import without_nan
from server.base.models import Document
from server.formats import disk as _disk
from server.formats import files
from server.formats.files import fsync_path, storage_error
from server.wording import problems_in

Record = TypeVar("Record", bound=Document)


def make_folder(folder: Path) -> None:
    """Create ``folder`` durably; its parent must exist.

    Raises
    ------
    StorageError
        If it exists already or cannot be created.
    """
    try:
        _disk.disk.make_folder(folder)
        fsync_path(folder.parent)
    except OSError as error:
        raise storage_error(error, folder) from error


def write_bytes(path: Path, data: bytes, *, checksum: bool = False) -> str:
    """Write ``data`` durably, with its checksum beside it if wanted; return its SHA-256 in hex."""
    files.write_bytes(path, data, checksum=checksum)
    return hashlib.sha256(data).hexdigest()


def write_json(path: Path, document: Any, *, checksum: bool = False) -> None:
    """Write a JSON document durably, with its checksum beside it if wanted; NaN becomes null."""
    text = json.dumps(without_nan(document), indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, text.encode() + b"\n", checksum=checksum)


def read_json(path: Path, keep: Mapping[str, long_json.Keep] | None = None) -> dict[str, Any]:
    """Read a JSON object.

    Parameters
    ----------
    path
        The file.
    keep
        Of lists in it, what is kept of each entry; see :func:`server.base.long_json.loads`.

    Raises
    ------
    FileFormatError
        If the file is missing, cut short or no object.
    """
    try:
        document = long_json.loads(path.read_text(encoding="utf-8"), keep)
    except FileNotFoundError as error:
        raise FileFormatError(f"{path.name} is missing.", code="file_missing", file=path.name) from error
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path.name} cannot be read as JSON: {error}.", file=path.name) from error
    if not isinstance(document, dict):
        raise FileFormatError(f"{path.name} holds {type(document).__name__}, not an object.", file=path.name)
    return document


def record_of(kind: type[Record], document: object, path: Path) -> Record:
    """Return a file's content as a record.

    Raises
    ------
    FileFormatError
        If an entry is invalid, naming the file and the field.
    """
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        first = problems_in(error, kind)[0]
        raise FileFormatError(f"{path.name} holds a wrong {first.field}: {first.problem}.", file=path.name) from error


def read_record(kind: type[Record], path: Path) -> Record:
    """Read a record; see :func:`read_json` and :func:`record_of`."""
    return record_of(kind, read_json(path), path)


_Kept = TypeVar("_Kept")
_kept: OrderedDict[tuple[str, object], tuple[tuple[int, int, int], object]] = OrderedDict()
_keeping = threading.Lock()
#: smaller files are read in less time than it takes to notice
_LARGE_BYTES = 40_000
_MAX_KEPT = 16


def kept_while_unchanged(path: Path, read: Callable[[Path], _Kept]) -> _Kept:
    """Return what ``read`` makes of a file; of a large one, what it made last, unless the file was touched since.

    What is returned is shared: nobody may change it.
    """
    try:
        stat = path.stat()
    except OSError:
        return read(path)
    if stat.st_size < _LARGE_BYTES:
        return read(path)
    # the time of the inode's change, which no program can set
    mark, key = (stat.st_ino, stat.st_ctime_ns, stat.st_size), (str(path), read)
    with _keeping:
        if (known := _kept.get(key)) is not None and known[0] == mark:
            _kept.move_to_end(key)
            return known[1]  # type: ignore[return-value]
    made = read(path)
    with _keeping:
        _kept[key] = mark, made
        _kept.move_to_end(key)
        if len(_kept) > _MAX_KEPT:
            _kept.popitem(last=False)
    return made


def known_json(path: Path, keep: Mapping[str, long_json.Keep] | None = None) -> dict[str, Any]:
    """Read a JSON object; empty where the file is missing or damaged, for readers who can do without it."""
    try:
        return read_json(path, keep)
    except FileFormatError:
        return {}
