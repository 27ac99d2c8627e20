"""Steps of the tests on disk.

A step's folder is a step only once it holds ``step.json``, which is written last and carries the checksums of both
images. A folder that a kill left without it is listed as incomplete and never read.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from core.errors import FileFormatError, StateError, StorageError
from core.names import CAMERAS
from server.base.errors import NotFoundError
from server.formats import disk as _disk
from server.formats.files import fsync_path, sha256_of, storage_error
from server.store.documents import StepRecord
from server.store.durable import make_folder, read_json, read_record, record_of, write_bytes, write_json
from server.store.indexing.names import names_in
from server.store.tests.folders import TestFolders

MAX_STEPS = 9999
#: a step's document may be taken away by hand, which the folder of the steps does not show
_LOOK_AGAIN_S = 2.0
_STEP_FOLDER = re.compile(r"(?:incomplete-\d+-)?(\d{4})")
_DELETED = re.compile(r"(\d{4})\.deleted")


@dataclass(frozen=True)
class StepFiles:
    """A complete step: its document and the paths of both images."""

    document: StepRecord
    cam1: Path
    cam2: Path


def number_of(name: str) -> int | None:
    """Return the number in the name of a step's folder, also of a quarantined one; None for other names."""
    found = _STEP_FOLDER.fullmatch(name)
    return None if found is None else int(found[1])


def deleted_mark(folder: Path) -> Path:
    """Path of the mark that a step was deleted: its number is not given again."""
    return folder.with_name(f"{folder.name}.deleted")


def quarantine(folder: Path) -> Path:
    """Rename an incomplete step's folder, so that it is not taken for a step; returns its new path.

    Raises
    ------
    StorageError
        If it cannot be renamed.
    """
    number = len(list(folder.parent.glob("incomplete-*"))) + 1
    quarantined = folder.parent / f"incomplete-{number}-{folder.name}"
    try:
        _disk.disk.replace(folder, quarantined)
        fsync_path(folder.parent)
    except OSError as error:
        raise storage_error(error, folder) from error
    return quarantined


class StepStore:
    """The steps of the tests of one data folder."""

    def __init__(self, folders: TestFolders) -> None:
        self._folders = folders
        self._commits = 0
        # of the test that was asked for last: names in its folder, when that was, and what was found
        self._incomplete: dict[str, tuple[tuple[str, ...], float, list[int]]] = {}

    def numbers(self, test_id: str) -> list[int]:
        """Numbers of the complete steps, ascending."""
        return list(self._complete(test_id, self._step_names(test_id)))

    def first(self, test_id: str) -> int | None:
        """Number of the first complete step; None without any."""
        return next(self._complete(test_id, self._step_names(test_id)), None)

    def newest(self, test_id: str) -> Iterator[int]:
        """Numbers of the complete steps, descending; looked up as they are asked for."""
        return self._complete(test_id, self._step_names(test_id)[::-1])

    def _step_names(self, test_id: str) -> list[str]:
        """Names of the folders of steps, complete or not, in order."""
        return [name for name in self._names(test_id) if len(name) == 4 and name.isdecimal()]

    def _names(self, test_id: str) -> tuple[str, ...]:
        return names_in(self._folders.path(test_id) / "steps")

    def _complete(self, test_id: str, names: list[str]) -> Iterator[int]:
        steps = str(self._folders.path(test_id) / "steps")
        return (int(name) for name in names if os.path.isfile(f"{steps}/{name}/step.json"))  # noqa: PTH113

    def mark(self, test_id: str) -> tuple[int, int]:
        """Return something cheap that differs whenever the steps of a test may have changed."""
        return (self._folders.path(test_id) / "steps").stat().st_mtime_ns, self._commits

    def documents(self, test_id: str) -> Iterator[tuple[int, StepRecord | FileFormatError]]:
        """Return the number and ``step.json`` of every complete step, ascending, or the reason why it cannot be read.

        A start reads them all: with ten thousand steps, each access of a path counts.
        """
        steps = str(self._folders.path(test_id) / "steps")
        for name in self._step_names(test_id):
            path = Path(f"{steps}/{name}/step.json")
            try:
                document = json.loads(path.read_bytes())
                if not isinstance(document, dict):
                    raise ValueError("it holds no object")
                record = record_of(StepRecord, document, path)
            except FileNotFoundError:
                continue
            except (OSError, ValueError) as error:
                yield int(name), FileFormatError(f"step.json cannot be read: {error}.", file=f"steps/{name}/step.json")
            except FileFormatError as error:
                yield int(name), error
            else:
                yield int(name), record

    def incomplete(self, test_id: str) -> list[int]:
        """Numbers of step folders without their commit mark, quarantined ones among them."""
        names = self._names(test_id)
        known = self._incomplete.get(test_id)
        if known is not None and known[0] is names and time.monotonic() - known[1] < _LOOK_AGAIN_S:
            return known[2]
        steps = str(self._folders.path(test_id) / "steps")
        of_steps = ((name, number_of(name)) for name in names)
        found = sorted(
            n
            for name, n in of_steps
            if n is not None and not os.path.isfile(f"{steps}/{name}/step.json")  # noqa: PTH113
        )
        self._incomplete = {test_id: (names, time.monotonic(), found)}
        return found

    def deleted(self, test_id: str) -> list[int]:
        """Numbers of the steps that lie in the trash, or that were removed for good."""
        marks = sorted(found[1] for name in self._names(test_id) if (found := _DELETED.fullmatch(name)) is not None)
        there = set(self._complete(test_id, marks))
        return [n for n in map(int, marks) if n not in there]

    def next_number(self, test_id: str) -> int:
        """Return the number that the next step gets: none is given twice, also not that of an incomplete step."""
        deleted = self.deleted(test_id)
        if not deleted and self.first(test_id) is None:
            return 0
        return 1 + max([*deleted, *(n for name in self._names(test_id) if (n := number_of(name)) is not None)])

    def add(self, test_id: str, images: dict[str, bytes], metadata: Mapping[str, object]) -> StepRecord:
        """Commit a step: both images, then ``step.json`` with their checksums.

        Returns when it is durable. A number is never used twice, also not that of an incomplete step.
        """
        steps = self._folders.to_change(test_id) / "steps"
        with self._folders.lock:
            n = self.next_number(test_id)
            if n == 0:
                # an incomplete reference would leave the test without step 0 for good
                for folder in [p for p in steps.iterdir() if p.name.isdigit()]:
                    quarantine(folder)
            if n > MAX_STEPS:
                raise StateError(f"Test {test_id} is full: {n} steps.", code="test_full", remedy="Make a new test.")
            folder = steps / f"{n:04d}"
            make_folder(folder)
            try:
                sha256 = {cam: write_bytes(folder / f"{cam}.tif", images[cam]) for cam in CAMERAS}
                document = {"n": n, "test_id": test_id, **metadata, "sha256": sha256}
                write_json(folder / "step.json", document)
                self._commits += 1
            except StorageError:
                shutil.rmtree(folder, ignore_errors=True)  # frees the number where the disk allows it
                raise
        return StepRecord.model_validate(document)

    def read(self, test_id: str, n: int) -> StepFiles:
        """Return a complete step.

        Raises
        ------
        NotFoundError
            If it does not exist or has no commit mark.
        """
        folder = self._folders.path(test_id) / "steps" / f"{n:04d}"
        if not 0 <= n <= MAX_STEPS or not (folder / "step.json").is_file():
            raise NotFoundError(f"Test {test_id} has no step {n}.", kind="step")
        return StepFiles(read_record(StepRecord, folder / "step.json"), folder / "cam1.tif", folder / "cam2.tif")

    def update(self, test_id: str, n: int, changes: Mapping[str, object]) -> StepRecord:
        """Change fields of a step's ``step.json``; its images and their checksums stay."""
        self._folders.to_change(test_id)
        with self._folders.lock:
            path = self.read(test_id, n).cam1.with_name("step.json")
            document = {**read_json(path), **changes}
            write_json(path, document)
        return record_of(StepRecord, document, path)

    def verified(self, test_id: str, n: int) -> StepFiles:
        """Return a step whose images match their checksums.

        Raises
        ------
        FileFormatError
            ``checksum_mismatch``, naming the file.
        """
        step = self.read(test_id, n)
        for cam, path in (("cam1", step.cam1), ("cam2", step.cam2)):
            if not path.is_file() or sha256_of(path) != step.document.sha256.get(cam):
                raise FileFormatError(
                    f"{path.name} of step {n} of test {test_id} does not match its checksum.",
                    code="checksum_mismatch",
                    remedy="Restore the file from a backup; the other steps are not touched.",
                    file=f"steps/{n:04d}/{path.name}",
                )
        return step
