"""Tests on disk: steps and analyses.

A step's folder is a step only once it holds ``step.json``, which is written last and carries the checksums of both
images. A folder that a kill left without it is listed as incomplete and never read.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from core.errors import FileFormatError, StateError, StorageError
from core.names import CAMERAS
from server.base.errors import NotFoundError
from server.base.long_json import Keep, the_first
from server.formats import disk as _disk
from server.formats.calibrations.in_test import LATER, calibration_id_in, calibration_in, later_file
from server.formats.files import fsync_path, known_sha256, recorded_sha256, sha256_of, storage_error
from server.formats.results.folder import TILES
from server.formats.results.settings import current_step, current_summary
from server.store.documents import (
    METADATA_NAMES,
    AnalysisJob,
    AnalysisRecord,
    StepOutcome,
    StepRecord,
    SummaryRecord,
    TestRecord,
)
from server.store.durable import (
    kept_while_unchanged,
    make_folder,
    read_json,
    read_record,
    record_of,
    write_bytes,
    write_json,
)
from server.store.folder import DataFolder, is_id, now_utc
from server.store.indexing.names import names_in

MAX_STEPS = 9999
#: a step's document may be taken away by hand, which the folder of the steps does not show
_LOOK_AGAIN_S = 2.0
_STEP_FOLDER = re.compile(r"(?:incomplete-\d+-)?(\d{4})")
#: of a summary, kept between questions: an answer shows fewer, and of some thousand each has kilobytes
_SUMMARY_STEPS = 100
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


class TestStore:
    """The tests of one data folder."""

    __test__ = False  # the name is the domain's, not pytest's

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._commits = 0
        # of the test that was asked for last: names in its folder, when that was, and what was found
        self._incomplete: dict[str, tuple[tuple[str, ...], float, list[int]]] = {}
        #: called with a test's id before anything in its folder is changed
        self.before_change: Callable[[str], None] | None = None

    # tests ------------------------------------------------------------------------------------------------------

    def path(self, test_id: str) -> Path:
        """Folder of an existing test.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        """
        path = self._folder.tests / test_id if is_id(test_id, "t") else None
        if path is None or not (path / "test.json").is_file():
            raise NotFoundError(f"There is no test {test_id[:40]!r}.", kind="test")
        return path

    def _to_change(self, test_id: str) -> Path:
        """As `path`, of a test that is about to be changed."""
        if self.before_change is not None:
            self.before_change(test_id)
        return self.path(test_id)

    def ids(self) -> list[str]:
        """Ids of all tests, in the order of their making."""
        return sorted(p.parent.name for p in self._folder.tests.glob("t*/test.json") if is_id(p.parent.name, "t"))

    def create(self, document: Mapping[str, object], calibration: Path | None) -> TestRecord:
        """Make a test, with its own copy of the calibration; ``test.json`` last."""
        test_id = self._folder.ids.new("t")
        path = self._folder.tests / test_id
        make_folder(path)
        make_folder(path / "steps")
        make_folder(path / "analyses")
        if calibration is not None:
            content = calibration.read_bytes()
            digest = write_bytes(path / "calibration.json", content)
            document = {**document, "calibration_sha256": digest}
        document = {"id": test_id, "created_utc": now_utc(), **document}
        write_json(path / "test.json", document)
        return TestRecord.model_validate(document)

    def read(self, test_id: str) -> TestRecord:
        """Return ``test.json``."""
        return read_record(TestRecord, self.path(test_id) / "test.json")

    def update(self, test_id: str, changes: Mapping[str, object]) -> TestRecord:
        """Change fields of ``test.json``."""
        path = self._to_change(test_id) / "test.json"
        with self._lock:
            document = {**read_json(path), **changes}
            write_json(path, document)
        return record_of(TestRecord, document, path)

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Hold the lock: no step is added and no test changed meanwhile."""
        with self._lock:
            yield

    def metadata(self, test_id: str) -> dict[str, object]:
        """Return a test's metadata; empty where nothing was stated."""
        found = self.read(test_id).metadata
        return found if isinstance(found, dict) else {}

    def put_metadata(
        self, test_id: str, metadata: Mapping[str, object], expected: Mapping[str, object] | None = None
    ) -> None:
        """Replace a test's metadata; durable when this returns.

        Parameters
        ----------
        expected
            The metadata that the caller wants to replace; None: any.

        Raises
        ------
        StateError
            ``metadata_changed`` if they are not what was expected.
        """
        self._to_change(test_id)
        with self._lock:
            if expected is not None and self.metadata(test_id) != expected:
                raise StateError(
                    f"The metadata of test {test_id} were changed meanwhile.",
                    code="metadata_changed",
                    remedy="Read them again, then send the change.",
                )
            path = self.path(test_id) / "test.json"
            document = {name: value for name, value in read_json(path).items() if name not in METADATA_NAMES}
            write_json(path, document | {"metadata": metadata})

    def workspace(self, test_id: str) -> dict[str, object]:
        """Return what is drawn and set for a test; empty where nothing is."""
        path = self.path(test_id) / "workspace.json"
        return read_json(path) if path.is_file() else {}

    def put_workspace(self, test_id: str, document: Mapping[str, object]) -> None:
        """Replace what is drawn and set for a test; durable when this returns."""
        write_json(self._to_change(test_id) / "workspace.json", document)

    def procedure(self, test_id: str) -> dict[str, object]:
        """Return a test's verification procedure; empty where there is none."""
        path = self.path(test_id) / "certificate_plan.json"
        return read_json(path) if path.is_file() else {}

    def put_procedure(self, test_id: str, document: Mapping[str, object]) -> None:
        """Replace a test's verification procedure; durable when this returns."""
        write_json(self._to_change(test_id) / "certificate_plan.json", document)

    def is_calibrated(self, test_id: str) -> bool:
        """Return True if the test has a calibration to measure with."""
        return calibration_in(self.path(test_id)).is_file()

    def keep_calibration(self, test_id: str, calibration_id: str, content: bytes, *, in_force: bool) -> TestRecord:
        """Give the test its own copy of another calibration; durable when this returns.

        The copies that it has stay, for the analyses that were measured with them.

        Parameters
        ----------
        content
            The calibration's file.
        in_force
            New analyses are measured with it, unless they name another one.
        """
        test = self._to_change(test_id)
        sha256 = hashlib.sha256(content).hexdigest()
        with self._lock:
            document = read_json(test / "test.json")
            before = document.get("calibration_sha256")
            if sha256 not in {before, *document.get("calibrations", {})}:
                if not (test / LATER).is_dir():
                    make_folder(test / LATER)
                write_bytes(later_file(test, sha256), content)
            first = {} if before is None else {before: document.get("calibration_id")}
            document["calibrations"] = {**first, **document.get("calibrations", {}), sha256: calibration_id}
            if in_force:
                document |= {"calibration_id": calibration_id, "calibration_sha256": sha256}
            write_json(test / "test.json", document)
        return record_of(TestRecord, document, test / "test.json")

    def calibration_file(self, test_id: str, sha256: str | None = None) -> Path:
        """The test's own copy of a calibration: of the one in force, or of the one with a checksum.

        Raises
        ------
        StateError
            ``not_calibrated`` if the test has none.
        """
        path = calibration_in(self.path(test_id), sha256)
        if not path.is_file():
            raise StateError(
                f"Test {test_id} has no calibration.",
                code="not_calibrated",
                remedy="Give the test a calibration, or name one for the analysis (calibration_id).",
            )
        return path

    # steps ------------------------------------------------------------------------------------------------------

    def step_numbers(self, test_id: str) -> list[int]:
        """Numbers of the complete steps, ascending."""
        return list(self._complete(test_id, self._step_names(test_id)))

    def first_step(self, test_id: str) -> int | None:
        """Number of the first complete step; None without any."""
        return next(self._complete(test_id, self._step_names(test_id)), None)

    def newest_steps(self, test_id: str) -> Iterator[int]:
        """Numbers of the complete steps, descending; looked up as they are asked for."""
        return self._complete(test_id, self._step_names(test_id)[::-1])

    def _step_names(self, test_id: str) -> list[str]:
        """Names of the folders of steps, complete or not, in order."""
        return [name for name in self._names(test_id) if len(name) == 4 and name.isdecimal()]

    def _names(self, test_id: str) -> tuple[str, ...]:
        return names_in(self.path(test_id) / "steps")

    def _complete(self, test_id: str, names: list[str]) -> Iterator[int]:
        steps = str(self.path(test_id) / "steps")
        return (int(name) for name in names if os.path.isfile(f"{steps}/{name}/step.json"))  # noqa: PTH113

    def steps_mark(self, test_id: str) -> tuple[int, int]:
        """Return something cheap that differs whenever the steps of a test may have changed."""
        return (self.path(test_id) / "steps").stat().st_mtime_ns, self._commits

    def step_documents(self, test_id: str) -> Iterator[tuple[int, StepRecord | FileFormatError]]:
        """Return the number and ``step.json`` of every complete step, ascending, or the reason why it cannot be read.

        A start reads them all: with ten thousand steps, each access of a path counts.
        """
        steps = str(self.path(test_id) / "steps")
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

    def incomplete_steps(self, test_id: str) -> list[int]:
        """Numbers of step folders without their commit mark, quarantined ones among them."""
        names = self._names(test_id)
        known = self._incomplete.get(test_id)
        if known is not None and known[0] is names and time.monotonic() - known[1] < _LOOK_AGAIN_S:
            return known[2]
        steps = str(self.path(test_id) / "steps")
        of_steps = ((name, number_of(name)) for name in names)
        found = sorted(
            n
            for name, n in of_steps
            if n is not None and not os.path.isfile(f"{steps}/{name}/step.json")  # noqa: PTH113
        )
        self._incomplete = {test_id: (names, time.monotonic(), found)}
        return found

    def deleted_steps(self, test_id: str) -> list[int]:
        """Numbers of the steps that lie in the trash, or that were removed for good."""
        marks = sorted(found[1] for name in self._names(test_id) if (found := _DELETED.fullmatch(name)) is not None)
        there = set(self._complete(test_id, marks))
        return [n for n in map(int, marks) if n not in there]

    def next_number(self, test_id: str) -> int:
        """Return the number that the next step gets: none is given twice, also not that of an incomplete step."""
        deleted = self.deleted_steps(test_id)
        if not deleted and self.first_step(test_id) is None:
            return 0
        return 1 + max([*deleted, *(n for name in self._names(test_id) if (n := number_of(name)) is not None)])

    def add_step(self, test_id: str, images: dict[str, bytes], metadata: Mapping[str, object]) -> StepRecord:
        """Commit a step: both images, then ``step.json`` with their checksums.

        Returns when it is durable. A number is never used twice, also not that of an incomplete step.
        """
        steps = self._to_change(test_id) / "steps"
        with self._lock:
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

    def step(self, test_id: str, n: int) -> StepFiles:
        """Return a complete step.

        Raises
        ------
        NotFoundError
            If it does not exist or has no commit mark.
        """
        folder = self.path(test_id) / "steps" / f"{n:04d}"
        if not 0 <= n <= MAX_STEPS or not (folder / "step.json").is_file():
            raise NotFoundError(f"Test {test_id} has no step {n}.", kind="step")
        return StepFiles(read_record(StepRecord, folder / "step.json"), folder / "cam1.tif", folder / "cam2.tif")

    def update_step(self, test_id: str, n: int, changes: Mapping[str, object]) -> StepRecord:
        """Change fields of a step's ``step.json``; its images and their checksums stay."""
        self._to_change(test_id)
        with self._lock:
            path = self.step(test_id, n).cam1.with_name("step.json")
            document = {**read_json(path), **changes}
            write_json(path, document)
        return record_of(StepRecord, document, path)

    def verified_step(self, test_id: str, n: int) -> StepFiles:
        """Return a step whose images match their checksums.

        Raises
        ------
        FileFormatError
            ``checksum_mismatch``, naming the file.
        """
        step = self.step(test_id, n)
        for cam, path in (("cam1", step.cam1), ("cam2", step.cam2)):
            if not path.is_file() or sha256_of(path) != step.document.sha256.get(cam):
                raise FileFormatError(
                    f"{path.name} of step {n} of test {test_id} does not match its checksum.",
                    code="checksum_mismatch",
                    remedy="Restore the file from a backup; the other steps are not touched.",
                    file=f"steps/{n:04d}/{path.name}",
                )
        return step

    # analyses ---------------------------------------------------------------------------------------------------

    def analysis_path(self, test_id: str, analysis_id: str) -> Path:
        """Folder of an existing analysis."""
        path = self.path(test_id) / "analyses" / analysis_id if is_id(analysis_id, "a") else None
        if path is None or not (path / "analysis.json").is_file():
            raise NotFoundError(f"Test {test_id} has no analysis {analysis_id[:40]!r}.", kind="analysis")
        return path

    def _analysis_to_change(self, test_id: str, analysis_id: str) -> Path:
        self._to_change(test_id)
        return self.analysis_path(test_id, analysis_id)

    def analysis_ids(self, test_id: str) -> list[str]:
        """Ids of a test's analyses, in the order of their making."""
        folder = self.path(test_id) / "analyses"
        return sorted(p.parent.name for p in folder.glob("a*/analysis.json") if is_id(p.parent.name, "a"))

    def create_analysis(
        self,
        test_id: str,
        document: Mapping[str, object],
        mask: bytes | None = None,
        noise: Path | None = None,
        run: Mapping[str, object] | None = None,
    ) -> AnalysisRecord:
        """Make an analysis: settings and inputs, fixed from now on; with its own copy of the noise models.

        ``run`` is the job that will work on it, see `add_analysis_job`.
        """
        analysis_id = self._folder.ids.new("a")
        path = self._to_change(test_id) / "analyses" / analysis_id
        make_folder(path)
        if mask is not None:
            document = {**document, "mask_sha256": write_bytes(path / "mask.png", mask)}
        if noise is not None:
            write_bytes(path / "noise.json", noise.read_bytes())
        if run is not None:
            write_json(path / "jobs.json", {"jobs": [{**run, "created_utc": now_utc()}]})
        document = {"id": analysis_id, "test_id": test_id, "created_utc": now_utc(), **document}
        write_json(path / "analysis.json", document)
        return AnalysisRecord.model_validate(document)

    def analysis(self, test_id: str, analysis_id: str) -> AnalysisRecord:
        """Return ``analysis.json``, with the id of its calibration where an earlier version did not write it."""
        found = kept_while_unchanged(self.analysis_path(test_id, analysis_id) / "analysis.json", _analysis_in)
        if found.calibration_id is not None:
            return found
        known = calibration_id_in(self.read(test_id).model_dump(), found.inputs.calibration_sha256)
        return found if known is None else found.model_copy(update={"calibration_id": known})

    def analysis_jobs(self, test_id: str, analysis_id: str) -> list[AnalysisJob]:
        """Jobs that worked on an analysis, the last one last."""
        path = self.analysis_path(test_id, analysis_id) / "jobs.json"
        return [record_of(AnalysisJob, job, path) for job in read_json(path)["jobs"]] if path.is_file() else []

    def add_analysis_job(self, test_id: str, analysis_id: str, run: Mapping[str, object]) -> None:
        """Note that another job goes on with an analysis."""
        path = self._analysis_to_change(test_id, analysis_id) / "jobs.json"
        jobs = read_json(path)["jobs"] if path.is_file() else []
        write_json(path, {"jobs": [*jobs, {**run, "created_utc": now_utc()}]})

    def extend_analysis(
        self, test_id: str, analysis_id: str, steps: list[int], sha256: dict[str, dict[str, str]]
    ) -> AnalysisRecord:
        """Make further steps, with their images' checksums, part of an analysis that follows its test."""
        path = self._analysis_to_change(test_id, analysis_id) / "analysis.json"
        document = read_json(path)
        document["steps"] = [*document["steps"], *steps]
        document["inputs"]["steps"] |= sha256
        write_json(path, document)
        return record_of(AnalysisRecord, document, path)

    def put_step_summary(self, test_id: str, analysis_id: str, n: int, summary: Mapping[str, object]) -> None:
        """Write the summary of one step beside its result."""
        write_json(self._analysis_to_change(test_id, analysis_id) / f"step_{n:04d}.json", summary)

    def step_summaries(
        self, test_id: str, analysis_id: str, only: Sequence[int] | None = None
    ) -> dict[int, StepOutcome]:
        """Return the summaries by step, of all steps or of these; only of steps whose result is there."""
        path = self.analysis_path(test_id, analysis_id)
        there = self.finished_steps(test_id, analysis_id)
        wanted = there if only is None else sorted(set(there).intersection(only))
        files = {n: path / f"step_{n:04d}.json" for n in wanted}
        return {
            n: record_of(StepOutcome, current_step(read_json(file)), file)
            for n, file in files.items()
            if file.is_file()
        }

    def finished_steps(self, test_id: str, analysis_id: str) -> tuple[int, ...]:
        """Numbers of the steps whose result file is there."""
        return _result_numbers(names_in(self.analysis_path(test_id, analysis_id)))

    def result_file(self, test_id: str, analysis_id: str, n: int) -> Path:
        """Result file of one step, its checksum verified where it is known.

        Raises
        ------
        FileFormatError
            ``checksum_mismatch``, naming the file.
        """
        path = self.analysis_path(test_id, analysis_id) / f"step_{n:04d}.nc"
        if not path.is_file():
            summary = self.summary(test_id, analysis_id)
            problem = None if summary is None else summary.steps_failed.get(str(n))
            failed = "" if problem is None else f" It failed: {problem.code}: {problem.cause}"
            raise NotFoundError(f"Analysis {analysis_id} has no result for step {n}.{failed}", kind="result")
        recorded = recorded_sha256(path)
        if recorded is not None and known_sha256(path) != recorded:
            raise FileFormatError(
                f"{path.name} of analysis {analysis_id} does not match its checksum.",
                code="checksum_mismatch",
                remedy="Restore the file from a backup, or measure again; the other steps are not touched.",
                file=f"analyses/{analysis_id}/{path.name}",
            )
        return path

    def drop_starts(self, test_id: str, analysis_id: str) -> None:
        """Remove files that only an unfinished analysis needs, see :mod:`server.formats.results.starts`."""
        folder = self._analysis_to_change(test_id, analysis_id)
        for path in (*folder.glob("starts_[0-9]*.npz"), *folder.glob("head_*")):
            path.unlink(missing_ok=True)
        for path in folder.glob(f"{TILES}*"):  # of a worker that died and whose step another one measured
            shutil.rmtree(path, ignore_errors=True)

    def has_heads(self, test_id: str, analysis_id: str) -> bool:
        """Return True if steps of an unfinished analysis were measured in blocks."""
        return next(self.analysis_path(test_id, analysis_id).glob("head_[0-9]*.nc"), None) is not None

    def drop_half_written(self, test_id: str, analysis_id: str) -> list[Path]:
        """Remove the remains of a result of a worker that was ended: half a file, a checksum without its result, tiles.

        Nothing may write into the analysis meanwhile. Returns the removed files.
        """
        folder = self._analysis_to_change(test_id, analysis_id)
        lone = [path for path in folder.glob("step_[0-9]*.nc.sha256") if not path.with_suffix("").exists()]
        removed = sorted([*folder.glob(".*.part"), *lone])
        for path in removed:
            path.unlink(missing_ok=True)
        for path in folder.glob(f"{TILES}*"):
            shutil.rmtree(path, ignore_errors=True)
        return removed

    def put_summary(self, test_id: str, analysis_id: str, document: Mapping[str, object]) -> None:
        """Write the analysis' summary, step by step."""
        path = self._analysis_to_change(test_id, analysis_id) / "summary.json"
        write_json(path, document)

    def summary(self, test_id: str, analysis_id: str) -> SummaryRecord | None:
        """Return ``summary.json`` with its first steps (:data:`_SUMMARY_STEPS`), or None while it is not there."""
        path = self.analysis_path(test_id, analysis_id) / "summary.json"
        return kept_while_unchanged(path, _short_summary_in) if path.exists() else None

    def whole_summary(self, test_id: str, analysis_id: str) -> SummaryRecord | None:
        """Return ``summary.json`` with all its steps, which may be many megabytes; None while it is not there."""
        path = self.analysis_path(test_id, analysis_id) / "summary.json"
        return _summary_in(path) if path.exists() else None


@lru_cache(maxsize=16)  # of some thousand names it takes longer than the answer that asks for it
def _result_numbers(names: tuple[str, ...]) -> tuple[int, ...]:
    ours = (name[5:-3] for name in names if name.endswith(".nc") and name.startswith("step_"))
    return tuple(int(n) for n in ours if n.isdecimal())


def _analysis_in(path: Path) -> AnalysisRecord:
    return read_record(AnalysisRecord, path)


def _summary_in(path: Path, keep: Mapping[str, Keep] | None = None) -> SummaryRecord:
    return record_of(SummaryRecord, current_summary(read_json(path, keep)), path)


def _short_summary_in(path: Path) -> SummaryRecord:
    return _summary_in(path, {"steps": the_first(_SUMMARY_STEPS)})
