"""Steps of the tests on disk.

A step's folder is a step only once it holds ``step.json``, which is written last and carries the checksums of both
images. A folder that a kill left without it is listed as incomplete and never read.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from stereorig.core.errors import FileFormatError, StateError, StorageError
from stereorig.core.names import CAMERAS
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.steps import StepRecord
from stereorig.server.formats import disk as _disk
from stereorig.server.formats.files import fsync_path, sha256_of, storage_error
from stereorig.server.formats.manifest import Listed, checked_bytes, is_there
from stereorig.server.store.durable import json_bytes, read_json, read_record, record_of
from stereorig.server.store.indexing.names import names_in
from stereorig.server.store.manifests import is_listed_on_disk
from stereorig.server.store.tests.folders import TestFolders

MAX_STEPS = 9999
#: a step's document may be taken away by hand, which the folder of the steps does not show
_LOOK_AGAIN_S = 2.0
#: a file system makes several files durable at once in hardly more time than one
_AT_ONCE = 4
_STEP_FOLDER = re.compile(r"(?:incomplete-[0-9]+-)?([0-9]{4})")
_DELETED = re.compile(r"([0-9]{4})\.deleted")


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
        # for the last test asked for: names in its folder, the time of reading them, and the incomplete steps
        self._incomplete: dict[str, tuple[tuple[str, ...], float, list[int]]] = {}

    def numbers(self, test_id: str) -> list[int]:
        """Numbers of the complete steps, ascending; one whose files were lost is among them."""
        listed = self._listed(test_id)
        return list(self._complete(test_id, self._step_names(test_id))) if listed is None else sorted(listed)

    def first(self, test_id: str) -> int | None:
        """Number of the first complete step; None without any."""
        listed = self._listed(test_id)
        found = self._complete(test_id, self._step_names(test_id)) if listed is None else iter(sorted(listed))
        return next(found, None)

    def newest(self, test_id: str) -> Iterator[int]:
        """Numbers of the complete steps, descending; looked up as they are asked for."""
        listed = self._listed(test_id)
        if listed is not None:
            return iter(sorted(listed, reverse=True))
        return self._complete(test_id, self._step_names(test_id)[::-1])

    def _listed(self, test_id: str) -> list[int] | None:
        """Return the numbers of the steps that the manifest lists, in any order; None of a test that has none."""
        numbers = self._folders.data.manifests.numbers(self._folders.path(test_id))
        return None if numbers is None else list(numbers.steps)

    def _step_names(self, test_id: str) -> list[str]:
        """Names of the folders of steps, complete or not, in order."""
        return [name for name in self._names(test_id) if len(name) == 4 and name.isascii() and name.isdecimal()]

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
        for n in self.numbers(test_id):
            name = f"{n:04d}"
            path = Path(f"{steps}/{name}/step.json")
            try:
                document = json.loads(checked_bytes(path))
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
        complete = set(self.numbers(test_id))
        of_steps = ((name, number_of(name)) for name in names)
        found = sorted(
            n
            for name, n in of_steps
            if n is not None and (n not in complete or not (name.isascii() and name.isdecimal()))
        )
        self._incomplete = {test_id: (names, time.monotonic(), found)}
        return found

    def deleted(self, test_id: str) -> list[int]:
        """Numbers of the steps that are in the trash, or that were removed for good."""
        marks = sorted(found[1] for name in self._names(test_id) if (found := _DELETED.fullmatch(name)) is not None)
        there = set(self.numbers(test_id)) if marks else set()
        return [n for n in map(int, marks) if n not in there]

    def next_number(self, test_id: str) -> int:
        """Return the number that the next step gets: none is given twice, not even an incomplete step's."""
        deleted = self.deleted(test_id)
        if not deleted and self.first(test_id) is None:
            return 0
        return 1 + max([*deleted, *(n for name in self._names(test_id) if (n := number_of(name)) is not None)])

    def add(self, test_id: str, images: dict[str, bytes], metadata: Mapping[str, object]) -> StepRecord:
        """Commit a step: both images, then ``step.json`` with their checksums.

        Returns when it is durable. A number is never used twice, not even an incomplete step's.
        """
        return self.add_some(test_id, [(images, metadata)])[0]

    def add_some(self, test_id: str, new: Sequence[tuple[dict[str, bytes], Mapping[str, object]]]) -> list[StepRecord]:
        """Commit the first of several steps, as many as can be; returns when they are durable, or with none of them."""
        steps = self._folders.to_change(test_id) / "steps"
        with self._folders.lock:
            n = self.next_number(test_id)
            new = new[: 1 if n == 0 else MAX_STEPS + 1 - n]  # a reference must not be the one that a kill leaves out
            if n == 0:
                # an incomplete reference would leave the test without step 0 for good
                for folder in [p for p in steps.iterdir() if p.name.isascii() and p.name.isdigit()]:
                    quarantine(folder)
            if n > MAX_STEPS:
                raise StateError(f"Test {test_id} is full: {n} steps.", code="test_full", remedy="Make a new test.")
            documents: list[dict[str, object]] = []
            files: dict[Path, dict[str, bytes]] = {}
            for number, (images, metadata) in enumerate(new, n):
                sha256 = {cam: hashlib.sha256(images[cam]).hexdigest() for cam in CAMERAS}
                documents.append({"n": number, "test_id": test_id, **metadata, "sha256": sha256})
                files[steps / f"{number:04d}"] = {
                    **{f"{cam}.tif": images[cam] for cam in CAMERAS},
                    "step.json": json_bytes(documents[-1]),
                }
            try:
                self._commit(files)
                self._commits += 1
            except StorageError:
                for folder in files:
                    if not is_listed_on_disk(folder / "step.json"):
                        shutil.rmtree(folder, ignore_errors=True)  # frees the number where the disk allows it
                raise
        return [StepRecord.model_validate(document) for document in documents]

    def _commit(self, steps: Mapping[Path, Mapping[str, bytes]]) -> None:
        """Write the files of steps durably, then list them; with as few syncs as that takes."""
        if len(steps) == 1:
            for folder, files in steps.items():
                self._write(folder, files)
        else:
            with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="steps") as pool:
                for _ in pool.map(self._write, steps, steps.values()):
                    pass
        listed = {}
        for folder, files in steps.items():
            document = files["step.json"]
            listed[f"steps/{folder.name}/step.json"] = Listed(len(document), hashlib.sha256(document).hexdigest())
        try:
            fsync_path(folder.parent)
        except OSError as error:
            raise storage_error(error, folder) from error
        self._folders.data.manifests.put(folder.parent.parent, listed)

    @staticmethod
    def _write(folder: Path, files: Mapping[str, bytes]) -> None:
        names = [(folder / f".{name}.{secrets.token_hex(4)}.part", folder / name) for name in files]
        try:
            _disk.disk.make_folder(folder)
            for (temporary, _), data in zip(names, files.values(), strict=True):
                _disk.disk.write(temporary, data)
                fsync_path(temporary)
            for temporary, path in names:  # the last one is step.json
                _disk.disk.replace(temporary, path)
            fsync_path(folder)
        except OSError as error:
            raise storage_error(error, folder) from error

    def read(self, test_id: str, n: int) -> StepFiles:
        """Return a complete step.

        Raises
        ------
        NotFoundError
            If it does not exist or has no commit mark.
        """
        folder = self._folders.path(test_id) / "steps" / f"{n:04d}"
        if not 0 <= n <= MAX_STEPS or not is_there(folder / "step.json"):
            raise NotFoundError(f"Test {test_id} has no step {n}.", kind="step")
        return StepFiles(read_record(StepRecord, folder / "step.json"), folder / "cam1.tif", folder / "cam2.tif")

    def update(self, test_id: str, n: int, changes: Mapping[str, object]) -> StepRecord:
        """Change fields of a step's ``step.json``; its images and their checksums stay."""
        self._folders.to_change(test_id)
        with self._folders.lock:
            path = self.read(test_id, n).cam1.with_name("step.json")
            document = {**read_json(path), **changes}
            self._folders.data.manifests.write_json(path, document)
        return record_of(StepRecord, document, path)

    def verified(self, test_id: str, n: int) -> StepFiles:
        """Return a step whose images match their checksums.

        Raises
        ------
        FileFormatError
            ``checksum_mismatch``, or ``file_missing``, naming the file.
        """
        step = self.read(test_id, n)
        for cam, path in (("cam1", step.cam1), ("cam2", step.cam2)):
            if not is_there(path) or sha256_of(path) != step.document.sha256.get(cam):
                raise FileFormatError(
                    f"{path.name} of step {n} of test {test_id} does not match its checksum.",
                    code="checksum_mismatch",
                    remedy="Restore the file from a backup; the other steps are not touched.",
                    file=f"steps/{n:04d}/{path.name}",
                )
        return step
