"""Analyses of the tests on disk: settings and inputs, results and summaries, the jobs that worked on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.json_values import Keep, the_first
from stereorig.server.documents.tests import AnalysisJob, AnalysisRecord, StepOutcome, SummaryRecord
from stereorig.server.formats.manifest import Listed, checked_bytes, is_there, require_sound
from stereorig.server.formats.results.folder import DENSE, dense_result
from stereorig.server.store.durable import (
    json_bytes,
    kept_while_unchanged,
    make_folder,
    read_json,
    read_record,
    record_of,
    write_bytes,
)
from stereorig.server.store.folder import is_id, now_utc
from stereorig.server.store.indexing.names import names_in
from stereorig.server.store.manifests import finish_renaming
from stereorig.server.store.tests.folders import TestFolders

#: of a summary, kept between questions: an answer shows fewer, and of some thousand each has kilobytes
_SUMMARY_STEPS = 100


class AnalysisStore:
    """The analyses of the tests of one data folder."""

    def __init__(self, folders: TestFolders) -> None:
        self._folders = folders
        self._manifests = folders.data.manifests

    def path(self, test_id: str, analysis_id: str) -> Path:
        """Folder of an existing analysis."""
        path = self._folders.path(test_id) / "analyses" / analysis_id if is_id(analysis_id, "a") else None
        if path is None or not is_there(path / "analysis.json"):
            raise NotFoundError(f"Test {test_id} has no analysis {analysis_id[:40]!r}.", kind="analysis")
        return path

    def _to_change(self, test_id: str, analysis_id: str) -> Path:
        self._folders.to_change(test_id)
        return self.path(test_id, analysis_id)

    def ids(self, test_id: str) -> list[str]:
        """Ids of a test's analyses, in the order of their making."""
        home = self._folders.path(test_id)
        folder, numbers = home / "analyses", self._manifests.numbers(home)
        if numbers is not None:
            return sorted(numbers.results)
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
            document = {**document, "mask_sha256": self._manifests.write(path / "mask.png", mask)}
        if noise is not None:
            self._manifests.write(path / "noise.json", checked_bytes(noise))
        if run is not None:
            self._manifests.write_json(path / "jobs.json", {"jobs": [{**run, "created_utc": now_utc()}]})
        document = {"id": analysis_id, "test_id": test_id, "created_utc": now_utc(), **document}
        self._manifests.write_json(path / "analysis.json", document)
        return AnalysisRecord.model_validate(document)

    def read(self, test_id: str, analysis_id: str) -> AnalysisRecord:
        """Return ``analysis.json``."""
        return kept_while_unchanged(self.path(test_id, analysis_id) / "analysis.json", _analysis_in)

    def jobs(self, test_id: str, analysis_id: str) -> list[AnalysisJob]:
        """Jobs that worked on an analysis, the last one last."""
        path = self.path(test_id, analysis_id) / "jobs.json"
        return [record_of(AnalysisJob, job, path) for job in read_json(path)["jobs"]] if is_there(path) else []

    def add_job(self, test_id: str, analysis_id: str, run: Mapping[str, object]) -> None:
        """Note another job that continues an analysis."""
        path = self._to_change(test_id, analysis_id) / "jobs.json"
        jobs = read_json(path)["jobs"] if is_there(path) else []
        self._manifests.write_json(path, {"jobs": [*jobs, {**run, "created_utc": now_utc()}]})

    def extend(
        self, test_id: str, analysis_id: str, steps: list[int], sha256: dict[str, dict[str, str]]
    ) -> AnalysisRecord:
        """Make further steps, with their images' checksums, part of an analysis that follows its test."""
        path = self._to_change(test_id, analysis_id) / "analysis.json"
        document = read_json(path)
        document["steps"] = [*document["steps"], *steps]
        document["inputs"]["steps"] |= sha256
        self._manifests.write_json(path, document)
        return record_of(AnalysisRecord, document, path)

    def put_step_summary(self, test_id: str, analysis_id: str, n: int, summary: Mapping[str, object]) -> None:
        """Write the summary of one step next to its result; from now on both are listed."""
        folder = self._to_change(test_id, analysis_id)
        path = folder / f"step_{n:04d}.json"
        data = json_bytes(summary)
        entry = {path: Listed(len(data), write_bytes(path, data))}
        made = [path.with_suffix(".nc"), dense_result(path.with_suffix(".nc"))]
        self._manifests.take_over(folder.parent.parent, [one for one in made if one.is_file()], entry)

    def begin_step(self, test_id: str, analysis_id: str, n: int) -> None:
        """List a result no longer that is to be measured again: until then it is none."""
        home = self._to_change(test_id, analysis_id).parent.parent
        names = (f"step_{n:04d}.json", *(f"{d}step_{n:04d}.nc{s}" for d in ("", f"{DENSE}/") for s in ("", ".sha256")))
        self._manifests.strike(home, [f"analyses/{analysis_id}/{name}" for name in names])

    def step_summaries(
        self, test_id: str, analysis_id: str, only: Sequence[int] | None = None
    ) -> dict[int, StepOutcome]:
        """Return the summaries by step, of all steps or of these; only of steps whose result is there."""
        path = self.path(test_id, analysis_id)
        there = self.finished_steps(test_id, analysis_id)
        wanted = there if only is None else sorted(set(there).intersection(only))
        files = {n: path / f"step_{n:04d}.json" for n in wanted}
        return {n: read_record(StepOutcome, file) for n, file in files.items() if is_there(file)}

    def finished_steps(self, test_id: str, analysis_id: str) -> tuple[int, ...]:
        """Numbers of the steps that have a result: one that was lost is among them, and one put there by hand."""
        folder = self.path(test_id, analysis_id)
        there, listed = _result_numbers(names_in(folder)), self._manifests.numbers(folder.parent.parent)
        lost = set() if listed is None else set(listed.results.get(analysis_id, ())).difference(there)
        return tuple(sorted({*there, *lost})) if lost else there

    def result_file(self, test_id: str, analysis_id: str, n: int) -> Path:
        """Result file of one step, which is as it was written.

        Raises
        ------
        DamagedError
            ``checksum_mismatch`` or ``file_missing``, naming the file.
        """
        path = self.path(test_id, analysis_id) / f"step_{n:04d}.nc"
        if n not in self.finished_steps(test_id, analysis_id):
            summary = self.summary(test_id, analysis_id)
            problem = None if summary is None else summary.steps_failed.get(str(n))
            why = "" if problem is None else f" It failed: {problem.code}: {problem.detail}"
            there, wanted = self.finished_steps(test_id, analysis_id), self.read(test_id, analysis_id).steps
            if problem is None and n in wanted:
                why = f" It has measured {len(there)} of {len(wanted)} steps: wait for it, or continue it."
            raise NotFoundError(f"Analysis {analysis_id} has no result for step {n}.{why}", kind="result")
        require_sound(path)
        return path

    def drop_starts(self, test_id: str, analysis_id: str) -> None:
        """Remove files that only an unfinished analysis needs, see :mod:`stereorig.server.formats.results.starts`."""
        folder = self._to_change(test_id, analysis_id)
        for path in (*folder.glob("starts_[0-9]*.npz"), *folder.glob("head_*")):
            path.unlink(missing_ok=True)

    def has_heads(self, test_id: str, analysis_id: str) -> bool:
        """Return True if steps of an unfinished analysis were measured in blocks."""
        return next(self.path(test_id, analysis_id).glob("head_[0-9]*.nc"), None) is not None

    def drop_half_written(self, test_id: str, analysis_id: str) -> list[Path]:
        """Remove the remains of a result of a worker that was ended: half a file, a checksum without its result.

        Nothing may write into the analysis at the same time. A document that the manifest lists already gets its
        name. Returns the removed files.
        """
        folder = self._to_change(test_id, analysis_id)
        parts = {path: path.stat().st_ino for path in folder.glob(".*.part")}
        finish_renaming(folder)
        lone = [path for path in folder.glob("step_[0-9]*.nc.sha256") if not path.with_suffix("").exists()]
        for path in lone:
            path.unlink(missing_ok=True)
        there = {path.stat().st_ino for path in folder.iterdir()}
        return sorted([*(path for path, inode in parts.items() if inode not in there), *lone])

    def put_summary(self, test_id: str, analysis_id: str, document: Mapping[str, object]) -> None:
        """Write the analysis' summary, step by step."""
        self._manifests.write_json(self._to_change(test_id, analysis_id) / "summary.json", document)

    def summary(self, test_id: str, analysis_id: str) -> SummaryRecord | None:
        """Return ``summary.json`` with its first steps (:data:`_SUMMARY_STEPS`), or None while it is not there."""
        path = self.path(test_id, analysis_id) / "summary.json"
        return kept_while_unchanged(path, _short_summary_in) if is_there(path) else None

    def whole_summary(self, test_id: str, analysis_id: str) -> SummaryRecord | None:
        """Return ``summary.json`` with all its steps, which may be many megabytes; None while it is not there."""
        path = self.path(test_id, analysis_id) / "summary.json"
        return _summary_in(path) if is_there(path) else None


@lru_cache(maxsize=16)  # of some thousand names it takes longer than the answer that asks for it
def _result_numbers(names: tuple[str, ...]) -> tuple[int, ...]:
    ours = (name[5:-3] for name in names if name.endswith(".nc") and name.startswith("step_"))
    return tuple(int(n) for n in ours if n.isascii() and n.isdecimal())


def _analysis_in(path: Path) -> AnalysisRecord:
    return read_record(AnalysisRecord, path)


def _summary_in(path: Path, keep: Mapping[str, Keep] | None = None) -> SummaryRecord:
    return record_of(SummaryRecord, read_json(path, keep), path)


def _short_summary_in(path: Path) -> SummaryRecord:
    return _summary_in(path, {"steps": the_first(_SUMMARY_STEPS)})
