"""Analyses of the tests on disk: settings and inputs, results and summaries, the jobs that worked on them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from core.errors import FileFormatError
from server.base.errors import NotFoundError
from server.base.long_json import Keep, the_first
from server.formats.calibrations.in_test import calibration_id_in
from server.formats.files import known_sha256, recorded_sha256
from server.formats.results.folder import TILES
from server.formats.results.settings import current_step, current_summary
from server.store.documents import AnalysisJob, AnalysisRecord, StepOutcome, SummaryRecord
from server.store.durable import (
    kept_while_unchanged,
    make_folder,
    read_json,
    read_record,
    record_of,
    write_bytes,
    write_json,
)
from server.store.folder import is_id, now_utc
from server.store.indexing.names import names_in
from server.store.tests.folders import TestFolders

#: of a summary, kept between questions: an answer shows fewer, and of some thousand each has kilobytes
_SUMMARY_STEPS = 100


class AnalysisStore:
    """The analyses of the tests of one data folder."""

    def __init__(self, folders: TestFolders) -> None:
        self._folders = folders

    def path(self, test_id: str, analysis_id: str) -> Path:
        """Folder of an existing analysis."""
        path = self._folders.path(test_id) / "analyses" / analysis_id if is_id(analysis_id, "a") else None
        if path is None or not (path / "analysis.json").is_file():
            raise NotFoundError(f"Test {test_id} has no analysis {analysis_id[:40]!r}.", kind="analysis")
        return path

    def _to_change(self, test_id: str, analysis_id: str) -> Path:
        self._folders.to_change(test_id)
        return self.path(test_id, analysis_id)

    def ids(self, test_id: str) -> list[str]:
        """Ids of a test's analyses, in the order of their making."""
        folder = self._folders.path(test_id) / "analyses"
        return sorted(p.parent.name for p in folder.glob("a*/analysis.json") if is_id(p.parent.name, "a"))

    def create(
        self,
        test_id: str,
        document: Mapping[str, object],
        mask: bytes | None = None,
        noise: Path | None = None,
        run: Mapping[str, object] | None = None,
    ) -> AnalysisRecord:
        """Make an analysis: settings and inputs, fixed from now on; with its own copy of the noise models.

        ``run`` is the job that will work on it, see `add_job`.
        """
        analysis_id = self._folders.data.ids.new("a")
        path = self._folders.to_change(test_id) / "analyses" / analysis_id
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

    def read(self, test_id: str, analysis_id: str) -> AnalysisRecord:
        """Return ``analysis.json``, with the id of its calibration where an earlier version did not write it."""
        found = kept_while_unchanged(self.path(test_id, analysis_id) / "analysis.json", _analysis_in)
        if found.calibration_id is not None:
            return found
        known = calibration_id_in(self._folders.read(test_id).model_dump(), found.inputs.calibration_sha256)
        return found if known is None else found.model_copy(update={"calibration_id": known})

    def jobs(self, test_id: str, analysis_id: str) -> list[AnalysisJob]:
        """Jobs that worked on an analysis, the last one last."""
        path = self.path(test_id, analysis_id) / "jobs.json"
        return [record_of(AnalysisJob, job, path) for job in read_json(path)["jobs"]] if path.is_file() else []

    def add_job(self, test_id: str, analysis_id: str, run: Mapping[str, object]) -> None:
        """Note that another job goes on with an analysis."""
        path = self._to_change(test_id, analysis_id) / "jobs.json"
        jobs = read_json(path)["jobs"] if path.is_file() else []
        write_json(path, {"jobs": [*jobs, {**run, "created_utc": now_utc()}]})

    def extend(
        self, test_id: str, analysis_id: str, steps: list[int], sha256: dict[str, dict[str, str]]
    ) -> AnalysisRecord:
        """Make further steps, with their images' checksums, part of an analysis that follows its test."""
        path = self._to_change(test_id, analysis_id) / "analysis.json"
        document = read_json(path)
        document["steps"] = [*document["steps"], *steps]
        document["inputs"]["steps"] |= sha256
        write_json(path, document)
        return record_of(AnalysisRecord, document, path)

    def put_step_summary(self, test_id: str, analysis_id: str, n: int, summary: Mapping[str, object]) -> None:
        """Write the summary of one step beside its result."""
        write_json(self._to_change(test_id, analysis_id) / f"step_{n:04d}.json", summary)

    def step_summaries(
        self, test_id: str, analysis_id: str, only: Sequence[int] | None = None
    ) -> dict[int, StepOutcome]:
        """Return the summaries by step, of all steps or of these; only of steps whose result is there."""
        path = self.path(test_id, analysis_id)
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
        return _result_numbers(names_in(self.path(test_id, analysis_id)))

    def result_file(self, test_id: str, analysis_id: str, n: int) -> Path:
        """Result file of one step, its checksum verified where it is known.

        Raises
        ------
        FileFormatError
            ``checksum_mismatch``, naming the file.
        """
        path = self.path(test_id, analysis_id) / f"step_{n:04d}.nc"
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
        folder = self._to_change(test_id, analysis_id)
        for path in (*folder.glob("starts_[0-9]*.npz"), *folder.glob("head_*")):
            path.unlink(missing_ok=True)
        for path in folder.glob(f"{TILES}*"):  # of a worker that died and whose step another one measured
            shutil.rmtree(path, ignore_errors=True)

    def has_heads(self, test_id: str, analysis_id: str) -> bool:
        """Return True if steps of an unfinished analysis were measured in blocks."""
        return next(self.path(test_id, analysis_id).glob("head_[0-9]*.nc"), None) is not None

    def drop_half_written(self, test_id: str, analysis_id: str) -> list[Path]:
        """Remove the remains of a result of a worker that was ended: half a file, a checksum without its result, tiles.

        Nothing may write into the analysis meanwhile. Returns the removed files.
        """
        folder = self._to_change(test_id, analysis_id)
        lone = [path for path in folder.glob("step_[0-9]*.nc.sha256") if not path.with_suffix("").exists()]
        removed = sorted([*folder.glob(".*.part"), *lone])
        for path in removed:
            path.unlink(missing_ok=True)
        for path in folder.glob(f"{TILES}*"):
            shutil.rmtree(path, ignore_errors=True)
        return removed

    def put_summary(self, test_id: str, analysis_id: str, document: Mapping[str, object]) -> None:
        """Write the analysis' summary, step by step."""
        path = self._to_change(test_id, analysis_id) / "summary.json"
        write_json(path, document)

    def summary(self, test_id: str, analysis_id: str) -> SummaryRecord | None:
        """Return ``summary.json`` with its first steps (:data:`_SUMMARY_STEPS`), or None while it is not there."""
        path = self.path(test_id, analysis_id) / "summary.json"
        return kept_while_unchanged(path, _short_summary_in) if path.exists() else None

    def whole_summary(self, test_id: str, analysis_id: str) -> SummaryRecord | None:
        """Return ``summary.json`` with all its steps, which may be many megabytes; None while it is not there."""
        path = self.path(test_id, analysis_id) / "summary.json"
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
