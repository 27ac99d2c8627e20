"""Files that survive a kill at any instant.

Every document of the data folder comes into being here: written under a temporary name in its own folder, fsynced,
renamed, and the folder fsynced (:mod:`stereorig.server.formats.files`). A file under its real name is complete.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from stereorig.core.errors import FileFormatError
from stereorig.server.base import json_values
from stereorig.server.base.json_values import without_nan
from stereorig.server.base.models import Document
from stereorig.server.formats import disk as _disk
from stereorig.server.formats import files
from stereorig.server.formats.files import fsync_path, storage_error
from stereorig.server.formats.manifest import DamagedError, checked_bytes
from stereorig.server.wording import problems_in

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
    """Write ``data`` durably, with its ``.sha256`` file if wanted; return its SHA-256 in hex."""
    files.write_bytes(path, data, checksum=checksum)
    return hashlib.sha256(data).hexdigest()


def write_json(path: Path, document: Any, *, checksum: bool = False) -> None:
    """Write a JSON document durably, with its ``.sha256`` file if wanted; NaN becomes null."""
    write_bytes(path, json_bytes(document), checksum=checksum)


def json_bytes(document: Any) -> bytes:
    """Return a JSON document as it is written; NaN becomes null."""
    text = json.dumps(without_nan(document), indent=1, ensure_ascii=False, allow_nan=False)
    return text.encode() + b"\n"


def read_json(path: Path, keep: Mapping[str, json_values.Keep] | None = None) -> dict[str, Any]:
    """Read a JSON object.

    Parameters
    ----------
    path
        The file.
    keep
        For long lists in it, the part of each entry to keep; see :func:`stereorig.server.base.json_values.loads`.

    Raises
    ------
    FileFormatError
        If the file is missing, cut short or no object; ``checksum_mismatch`` if it is not as it was written.
    """
    try:
        document = json_values.loads(checked_bytes(path).decode(), keep)
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
        first = problems_in(error)[0]
        raise FileFormatError(f"{path.name} holds a wrong {first.field}: {first.problem}.", file=path.name) from error


def read_record(kind: type[Record], path: Path) -> Record:
    """Read a record; see :func:`read_json` and :func:`record_of`."""
    return record_of(kind, read_json(path), path)


Made = TypeVar("Made")
#: smaller files are read in less time than it takes to notice
_LARGE_BYTES = 40_000


class UnchangedFiles:
    """Objects made of files, kept while the files are not touched; callers share them and must not change them.

    Parameters
    ----------
    at_most
        Files whose contents are kept: those that were asked for last.
    least_bytes
        Smaller files are read every time.
    """

    def __init__(self, at_most: int, *, least_bytes: int = 0) -> None:
        self._at_most, self._least_bytes = at_most, least_bytes
        self._kept: OrderedDict[tuple[str, object], tuple[tuple[int, int, int], object]] = OrderedDict()
        self._lock = threading.Lock()

    def made_of(self, path: Path, read: Callable[[Path], Made]) -> Made:
        """Return the object that ``read`` makes of a file, or the last one if the file was not touched since."""
        try:
            stat = path.stat()
        except OSError:
            return read(path)
        if stat.st_size < self._least_bytes:
            return read(path)
        mark, key = files.mark_of(stat), (str(path), read)
        with self._lock:
            if (known := self._kept.get(key)) is not None and known[0] == mark:
                self._kept.move_to_end(key)
                return known[1]  # type: ignore[return-value]
        made = read(path)
        with self._lock:
            self._kept[key] = mark, made
            self._kept.move_to_end(key)
            if len(self._kept) > self._at_most:
                self._kept.popitem(last=False)
        return made


#: a summary of a hundred steps is two megabytes when read
_LARGE_KEPT = 6
kept_while_unchanged = UnchangedFiles(_LARGE_KEPT, least_bytes=_LARGE_BYTES).made_of
"""Return the object that a function makes of a large file, see :meth:`UnchangedFiles.made_of`."""


def known_record(kind: type[Record], path: Path, **missing: object) -> Record:
    """Read a record; with these entries alone if the file is missing or unreadable, see :func:`known_json`."""
    try:
        return kind.model_validate({**missing, **known_json(path)})
    except ValidationError:
        return kind.model_validate(missing)


def known_json(path: Path, keep: Mapping[str, json_values.Keep] | None = None) -> dict[str, Any]:
    """Read a JSON object; empty if it is missing or unreadable, for readers that can do without it.

    Raises
    ------
    DamagedError
        If it is not as it was written, or was there and is gone.
    """
    try:
        return read_json(path, keep)
    except DamagedError:
        raise
    except FileFormatError:
        return {}


# Disk that a file holds ahead of its end, so that a full disk still takes its next lines.

_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE of linux/falloc.h: readers see no byte of the reserve


class Reserve:
    """Keeps blocks ahead of the end of an open file; has none where system or file system cannot.

    Parameters
    ----------
    file
        Descriptor that can write.
    ahead_bytes
        Length of the reserve.
    """

    def __init__(self, file: int, ahead_bytes: int) -> None:
        self._file, self._ahead = file, ahead_bytes
        self._end = os.fstat(file).st_size
        self.renew()

    def renew(self) -> None:
        """Make the reserve whole once half of it is used; on a full disk it stays as it is."""
        size = os.fstat(self._file).st_size
        if self._end - size < self._ahead // 2:
            start = max(size, self._end)
            if _allocate(self._file, start, size + self._ahead - start):
                self._end = size + self._ahead

    @property
    def left_bytes(self) -> int:
        """Room that is certain."""
        return max(0, self._end - os.fstat(self._file).st_size)


def _allocate(file: int, start: int, count: int) -> bool:
    allocate = getattr(ctypes.CDLL(None), "fallocate", None)
    if allocate is None:
        return False
    return bool(allocate(file, _KEEP_SIZE, ctypes.c_int64(start), ctypes.c_int64(count)) == 0)
