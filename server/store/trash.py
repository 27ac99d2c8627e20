"""The trash: deleted data stay here, whole, until a client empties it.

Deleting is one rename. An entry's folder with its ``trash.json`` is made first; then the folder that is deleted becomes
its ``content``. Killed before that rename, nothing is deleted; after it, all is. Emptying begins with a rename too, so
that half of something never comes back.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from stereorig.core.errors import FileFormatError, StateError, StorageError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.made import TrashEntry
from stereorig.server.formats import disk as _disk
from stereorig.server.formats.files import fsync_path, storage_error
from stereorig.server.formats.manifest import NAME, entries_in, known_sha256
from stereorig.server.store.durable import make_folder, read_json, write_json
from stereorig.server.store.folder import DataFolder, is_id, now_utc
from stereorig.server.store.manifests import Manifests
from stereorig.server.store.tests.steps import MAX_STEPS, deleted_mark
from stereorig.server.store.tests.tests import TestStore

Kind = Literal["test", "step", "analysis", "calibration", "noise"]
_CONTENT = "content"
_DOOMED = "removing"
#: for a step or analysis in the trash: its former entries of the test's manifest
_FILES = "files.json"


class Trash:
    """The trash of one data folder.

    Parameters
    ----------
    root
        The data folder.
    manifests
        Its manifests, if it is open.
    """

    def __init__(self, root: Path, manifests: Manifests | None = None) -> None:
        self._data = root
        self._manifests = manifests or Manifests(root)
        self.root = root / "trash"
        self._sizes: dict[str, int] = {}

    # its entries -------------------------------------------------------------------------------------------

    def ids(self) -> list[str]:
        """Ids of all entries, in the order of their deletion."""
        return sorted(p.parent.name for p in self.root.glob(f"x*/{_CONTENT}") if is_id(p.parent.name, "x"))

    def entry(self, trash_id: str) -> TrashEntry:
        """Return an entry's kind and ids, and the time and the client of its deletion.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        FileFormatError
            If ``trash.json`` cannot be read; ``trash_unreadable`` if it does not state the kind of the entry.
        """
        try:
            return TrashEntry.model_validate({"id": trash_id, **self._document(trash_id)})
        except ValidationError as error:
            raise _unreadable() from error

    def _document(self, trash_id: str) -> Mapping[str, object]:
        folder = self.root / trash_id if is_id(trash_id, "x") else None
        if folder is None or not (folder / _CONTENT).is_dir():
            raise NotFoundError(f"There is nothing in the trash with the id {trash_id[:40]!r}.", kind="trash")
        return read_json(folder / "trash.json")

    def entries(self) -> list[TrashEntry]:
        """Return every entry, with its size; one whose description cannot be read is marked."""
        found = []
        for trash_id in self.ids():
            try:
                entry = self.entry(trash_id)
            except NotFoundError:
                continue  # emptied since
            except FileFormatError as error:
                entry = TrashEntry(id=trash_id, kind="unknown", name=error.cause)
            if trash_id not in self._sizes:  # nothing changes in the trash, and a test has thousands of files
                self._sizes[trash_id] = _size_bytes(self.root / trash_id / _CONTENT)
            size_bytes = self._sizes[trash_id]
            found.append(entry.model_copy(update={"size_bytes": size_bytes}))
        return found

    # in and out ------------------------------------------------------------------------------------------------

    def put(self, folder: DataFolder, kind: Kind, ids: Mapping[str, object], *, name: str, by: str, why: str) -> str:
        """Move something into the trash; return the entry's id.

        Parameters
        ----------
        folder
            The data folder, opened.
        kind, ids
            Kind and ids: ``test_id``, ``n``, ``analysis_id``, ``calibration_id``, ``noise_id``.
        name
            Its name, as users gave it.
        by, why
            The client that deleted it, and the occasion.

        Raises
        ------
        StorageError
            When the disk does not keep it; then nothing was deleted, or all of it.
        """
        original = self.original(kind, ids)
        trash_id = folder.ids.new("x")
        entry = self.root / trash_id
        if not self.root.exists():
            make_folder(self.root)
        try:
            make_folder(entry)
            document = {"kind": kind, **ids, "name": name, "deleted_utc": now_utc(), "deleted_by": by, "why": why}
            write_json(entry / "trash.json", document)
            home = original.parent.parent
            part = None
            if kind in ("step", "analysis") and (home / NAME).exists():
                part = home, self._manifests.under(home, original.relative_to(home).as_posix())
                write_json(entry / _FILES, {"files": self._manifests.plain(*part)})
            if kind == "step":
                # its number stays taken: results and notes refer to it
                write_json(deleted_mark(original), {"trash_id": trash_id})
            if part is not None:
                self._manifests.replace(*part, [deleted_mark(original)] if kind == "step" else [])
            _move(original, entry / _CONTENT)
        except StorageError:
            if original.exists():
                with contextlib.suppress(StorageError):
                    self._relist(kind, original, entry)
                shutil.rmtree(entry, ignore_errors=True)
            raise
        return trash_id

    def _relist(self, kind: str, original: Path, entry: Path) -> None:
        """List the restored files again, with the entries from before the deletion."""
        home = original.parent.parent
        if (entry / _FILES).is_file():
            mark = {deleted_mark(original).relative_to(home).as_posix(): None} if kind == "step" else {}
            self._manifests.change(home, {**entries_in(read_json(entry / _FILES)["files"]), **mark})
        if kind == "step":
            deleted_mark(original).unlink(missing_ok=True)
            fsync_path(original.parent)  # a mark that came back would be listed nowhere in the trash

    def restore(self, trash_id: str) -> TrashEntry:
        """Move an entry's content back to its original path; return the entry.

        Raises
        ------
        NotFoundError
            If there is no such entry.
        StateError
            ``place_taken`` if there is something by now, ``parent_deleted`` if its test is not there.
        """
        entry = self.entry(trash_id)
        original = self.original(entry.kind, entry.plain())
        if original.exists():
            raise StateError(
                f"{original.relative_to(self._data)} is there again.",
                code="place_taken",
                remedy="Delete that first, or take the files out of the trash folder by hand.",
            )
        if not original.parent.is_dir():
            raise StateError(
                f"{original.parent.relative_to(self._data)} is not there.",
                code="parent_deleted",
                remedy="Restore the test first.",
            )
        _move(self.root / trash_id / _CONTENT, original)
        if entry.kind in ("step", "analysis"):
            self._relist(entry.kind, original, self.root / trash_id)
        shutil.rmtree(self.root / trash_id, ignore_errors=True)
        return entry

    def remove(self, trash_id: str) -> None:
        """Remove an entry for good.

        Raises
        ------
        NotFoundError
            If there is no such entry.
        StorageError
            When the disk does not let it go.
        """
        self._document(trash_id)
        entry = self.root / trash_id
        _move(entry / _CONTENT, entry / _DOOMED)
        try:
            shutil.rmtree(entry)
        except OSError as error:
            raise storage_error(error, entry) from error

    def tidy(self) -> list[str]:
        """Remove leftovers of entries that were being made, restored or removed at a kill; return a line for each."""
        done = []
        for entry in sorted(self.root.glob("x*")):
            if is_id(entry.name, "x") and not (entry / _CONTENT).exists():
                shutil.rmtree(entry, ignore_errors=True)
                done.append(f"removed the rest of trash/{entry.name}")
        return done

    def original(self, kind: object, ids: Mapping[str, object]) -> Path:
        """Return the path of something that is not deleted; ids that are none never become a path.

        Raises
        ------
        FileFormatError
            ``trash_unreadable``.
        """
        test, analysis, n = (str(ids.get(name)) for name in ("test_id", "analysis_id", "n"))
        if kind == "calibration" and is_id(str(ids.get("calibration_id")), "c"):
            return self._data / "calibrations" / str(ids["calibration_id"])
        if kind == "noise" and is_id(str(ids.get("noise_id")), "n"):
            return self._data / "noise" / str(ids["noise_id"])
        if kind in ("test", "step", "analysis") and is_id(test, "t"):
            folder = self._data / "tests" / test
            if kind == "test":
                return folder
            if kind == "analysis" and is_id(analysis, "a"):
                return folder / "analyses" / analysis
            if kind == "step" and n.isascii() and n.isdecimal() and int(n) <= MAX_STEPS:
                return folder / "steps" / f"{int(n):04d}"
        raise _unreadable()


def _unreadable() -> FileFormatError:
    return FileFormatError(
        "trash.json does not state the kind of the entry.",
        code="trash_unreadable",
        remedy="Take the files out of the trash folder by hand.",
    )


def _move(source: Path, target: Path) -> None:
    """Rename a folder durably."""
    try:
        _disk.disk.replace(source, target)
        fsync_path(target.parent)
        fsync_path(source.parent)
    except OSError as error:
        raise storage_error(error, source) from error


def _size_bytes(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.lstat().st_size
        except OSError:
            continue  # removed since
    return total


# Acknowledgement that a copy of a test exists elsewhere: kept with the test, for operators who free space by hand.


@dataclass(frozen=True)
class Content:
    """The parts of a test to copy: complete steps, result files, and the SHA-256 of all their checksums."""

    steps: int
    results: int
    sha256: str


def content_of(tests: TestStore, test_id: str) -> Content:
    """Return the numbers of a test's complete steps and result files, and the SHA-256 of all their checksums."""
    digest = hashlib.sha256()
    steps = tests.steps.numbers(test_id)
    for n in steps:
        digest.update(f"{n} {sorted(tests.steps.read(test_id, n).document.sha256.items())}\n".encode())
    results = 0
    for analysis_id in tests.analyses.ids(test_id):
        for n in tests.analyses.finished_steps(test_id, analysis_id):
            path = tests.analyses.path(test_id, analysis_id) / f"step_{n:04d}.nc"
            digest.update(f"{analysis_id} {n} {known_sha256(path)}\n".encode())
            results += 1
    return Content(len(steps), results, digest.hexdigest())


def acknowledge_export(tests: TestStore, test_id: str, *, steps: int, results: int, by: str) -> dict[str, object]:
    """Record with the test that a copy of it exists elsewhere; return the record.

    Raises
    ------
    NotFoundError
        There is no such test.
    StateError
        ``export_differs`` when the copy cannot hold all of it.
    """
    content = content_of(tests, test_id)
    if (content.steps, content.results) != (steps, results):
        raise StateError(
            f"The copy holds {steps} steps and {results} results, test {test_id} has {content.steps} and "
            f"{content.results}.",
            code="export_differs",
            remedy="Copy it again, then acknowledge that.",
            steps=content.steps,
            results=content.results,
        )
    exported = {"utc": now_utc(), "by": by, **asdict(content)}
    tests.update(test_id, {"exported": exported})
    return exported
