"""The mark of a clean stop, without which the catalogue's index is not believed.

It is written last when a service ends, and removed first when one begins. It names the catalogue by its checksum and
each test by the times of its folders: an index that is stale, cut, or of another folder is seen by that, and so is a
test that was changed, copied or removed by hand since.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from stereorig.core.errors import FileFormatError
from stereorig.server.base.models import Document
from stereorig.server.formats.files import fsync_path, sha256_of, storage_error
from stereorig.server.formats.version import software_version
from stereorig.server.store.durable import read_record, write_json

#: in the catalogue's folder, and named after it: a copy without the catalogue lacks the mark too
MARK = "catalog.sqlite.clean"
#: a test that was changed so shortly before the stop is read again: the change may not have reached the index
_SETTLED_S = 60.0
#: files and folders whose times show a change of a test
_WATCHED = ("", "test.json", "steps", "analyses")

Times = tuple[int, ...]


class CleanStop(Document):
    """The mark's content."""

    format: Literal[1] = 1
    software: str
    catalog_sha256: str
    tests: dict[str, Times]


def times_of(test: Path) -> Times:
    """Return the times at which a test's folders and its document were changed, ns; 0 for missing ones."""
    found = []
    for name in _WATCHED:
        try:
            found.append((test / name).stat().st_mtime_ns)
        except OSError:
            found.append(0)
    return tuple(found)


def leave_mark(catalog: Path, tests: Iterable[Path]) -> None:
    """Write the mark of a clean stop; the catalogue is closed, and nothing writes any more.

    Raises
    ------
    StorageError
        When the disk does not keep it; the next start then reads everything.
    """
    now_ns = time.time_ns()
    times = {path.name: times_of(path) for path in tests}
    settled = {name: known for name, known in times.items() if abs(now_ns - max(known)) > _SETTLED_S * 1e9}
    mark = CleanStop(software=software_version(), catalog_sha256=sha256_of(catalog), tests=settled)
    write_json(catalog.with_name(MARK), {"format": 1, **mark.model_dump(mode="json")})


def take_mark(catalog: Path) -> Mapping[str, Times] | None:
    """Remove the mark, durably; return the times of the tests that the index is right about.

    Call it before the catalogue is opened. None: the index is not to be believed.

    Raises
    ------
    StorageError
        When the mark cannot be removed.
    """
    path = catalog.with_name(MARK)
    if not path.exists():
        return None
    mark: CleanStop | None = None
    try:
        mark = read_record(CleanStop, path)
        log = catalog.with_name(f"{catalog.name}-wal")
        if log.exists() or mark.software != software_version() or mark.catalog_sha256 != sha256_of(catalog):
            mark = None
    except (FileFormatError, OSError):
        mark = None
    try:
        path.unlink()
        fsync_path(path.parent)
    except OSError as error:
        raise storage_error(error, path) from error
    return None if mark is None else mark.tests
