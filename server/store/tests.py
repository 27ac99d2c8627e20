"""Tests on disk: steps and analyses.

A step's folder is a step only once it holds ``step.json``, which is written last and carries the checksums of both
images. What a kill left without it is listed as incomplete and never read.
"""

from __future__ import annotations

import shutil
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from core.errors import FileFormatError, StateError, StorageError
from server.errors import NotFoundError
from server.io.files import sha256_of
from server.store.durable import make_folder, read_json, write_bytes, write_json
from server.store.folder import DataFolder, is_id, now_utc

CAMERAS = ("cam1", "cam2")
MAX_STEPS = 9999


@dataclass(frozen=True)
class StepFiles:
    """A complete step: its document and the paths of both images."""

    document: dict[str, Any]
    cam1: Path
    cam2: Path


class TestStore:
    """The tests of one data folder."""

    __test__ = False  # the name is the domain's, not pytest's

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder
        self._lock = threading.Lock()

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
            raise NotFoundError(f"There is no test {test_id[:40]!r}.", what="test")
        return path

    def ids(self) -> list[str]:
        """Ids of all tests, in the order of their making."""
        return sorted(p.parent.name for p in self._folder.tests.glob("t*/test.json") if is_id(p.parent.name, "t"))

    def create(self, document: dict[str, Any], calibration: Path | None) -> dict[str, Any]:
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
        return document

    def read(self, test_id: str) -> dict[str, Any]:
        """Return ``test.json``."""
        return read_json(self.path(test_id) / "test.json")

    def update(self, test_id: str, changes: dict[str, Any]) -> dict[str, Any]:
        """Change fields of ``test.json``."""
        with self._lock:
            document = self.read(test_id) | changes
            write_json(self.path(test_id) / "test.json", document)
        return document

    def is_calibrated(self, test_id: str) -> bool:
        """Whether the test has a calibration to measure with."""
        return (self.path(test_id) / "calibration.json").is_file()

    def calibration_file(self, test_id: str) -> Path:
        """The test's own copy of its calibration.

        Raises
        ------
        StateError
            ``not_calibrated`` if the test has none.
        """
        path = self.path(test_id) / "calibration.json"
        if not path.is_file():
            raise StateError(
                f"Test {test_id} has no calibration.",
                code="not_calibrated",
                remedy="Make the test with a calibration_id.",
            )
        return path

    # steps ------------------------------------------------------------------------------------------------------

    def step_numbers(self, test_id: str) -> list[int]:
        """Numbers of the complete steps, ascending."""
        return sorted(int(p.parent.name) for p in (self.path(test_id) / "steps").glob("[0-9]*/step.json"))

    def incomplete_steps(self, test_id: str) -> list[int]:
        """Numbers of step folders without their commit mark."""
        steps = self.path(test_id) / "steps"
        return sorted(int(p.name) for p in steps.iterdir() if p.name.isdigit() and not (p / "step.json").is_file())

    def add_step(self, test_id: str, images: dict[str, bytes], document: dict[str, Any]) -> dict[str, Any]:
        """Commit a step: both images, then ``step.json`` with their checksums.

        Returns when it is durable. A number is never used twice, also not that of an incomplete step.
        """
        with self._lock:
            steps = self.path(test_id) / "steps"
            used = [int(p.name) for p in steps.iterdir() if p.name.isdigit()]
            # an incomplete reference would leave the test without step 0 for good
            n = max(used, default=-1) + 1
            if used == [0] and not (steps / "0000" / "step.json").exists():
                self._set_aside(steps / "0000")
                n = 0
            if n > MAX_STEPS:
                raise StateError(f"Test {test_id} is full: {n} steps.", code="test_full", remedy="Make a new test.")
            folder = steps / f"{n:04d}"
            make_folder(folder)
            try:
                sha256 = {cam: write_bytes(folder / f"{cam}.tif", images[cam]) for cam in CAMERAS}
                document = {"n": n, "test_id": test_id, **document, "sha256": sha256}
                write_json(folder / "step.json", document)
            except StorageError:
                shutil.rmtree(folder, ignore_errors=True)  # frees the number where the disk allows it
                raise
        return document

    def _set_aside(self, folder: Path) -> None:
        number = len(list(folder.parent.glob("incomplete-*"))) + 1
        folder.rename(folder.parent / f"incomplete-{number}-{folder.name}")

    def step(self, test_id: str, n: int) -> StepFiles:
        """Return a complete step.

        Raises
        ------
        NotFoundError
            If it does not exist or has no commit mark.
        """
        folder = self.path(test_id) / "steps" / f"{n:04d}"
        if not 0 <= n <= MAX_STEPS or not (folder / "step.json").is_file():
            raise NotFoundError(f"Test {test_id} has no step {n}.", what="step")
        return StepFiles(read_json(folder / "step.json"), folder / "cam1.tif", folder / "cam2.tif")

    def verified_step(self, test_id: str, n: int) -> StepFiles:
        """Return a step whose images match their checksums.

        Raises
        ------
        FileFormatError
            ``checksum_mismatch``, naming the file.
        """
        step = self.step(test_id, n)
        for cam, path in (("cam1", step.cam1), ("cam2", step.cam2)):
            if not path.is_file() or sha256_of(path) != step.document["sha256"][cam]:
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
            raise NotFoundError(f"Test {test_id} has no analysis {analysis_id[:40]!r}.", what="analysis")
        return path

    def analysis_ids(self, test_id: str) -> list[str]:
        """Ids of a test's analyses, in the order of their making."""
        folder = self.path(test_id) / "analyses"
        return sorted(p.parent.name for p in folder.glob("a*/analysis.json") if is_id(p.parent.name, "a"))

    def create_analysis(
        self, test_id: str, document: dict[str, Any], mask: bytes | None = None, noise: Path | None = None
    ) -> dict[str, Any]:
        """Make an analysis: settings and inputs, fixed from now on; with its own copy of the noise models."""
        analysis_id = self._folder.ids.new("a")
        path = self.path(test_id) / "analyses" / analysis_id
        make_folder(path)
        if mask is not None:
            document = {**document, "mask_sha256": write_bytes(path / "mask.png", mask)}
        if noise is not None:
            write_bytes(path / "noise.json", noise.read_bytes())
        document = {"id": analysis_id, "test_id": test_id, "created_utc": now_utc(), **document}
        write_json(path / "analysis.json", document)
        return document

    def analysis(self, test_id: str, analysis_id: str) -> dict[str, Any]:
        """Return ``analysis.json``."""
        return read_json(self.analysis_path(test_id, analysis_id) / "analysis.json")

    def finished_steps(self, test_id: str, analysis_id: str) -> list[int]:
        """Numbers of the steps whose result file is there."""
        return sorted(int(p.stem[5:]) for p in self.analysis_path(test_id, analysis_id).glob("step_[0-9]*.nc"))

    def result_file(self, test_id: str, analysis_id: str, n: int) -> Path:
        """Result file of one step."""
        path = self.analysis_path(test_id, analysis_id) / f"step_{n:04d}.nc"
        if not path.is_file():
            raise NotFoundError(f"Analysis {analysis_id} has no result for step {n}.", what="result")
        return path

    def put_summary(self, test_id: str, analysis_id: str, document: dict[str, Any]) -> None:
        """Write what the analysis found, step by step."""
        path = self.analysis_path(test_id, analysis_id) / "summary.json"
        write_json(path, document)

    def summary(self, test_id: str, analysis_id: str) -> dict[str, Any] | None:
        """Return ``summary.json``, or None while it is not there."""
        path = self.analysis_path(test_id, analysis_id) / "summary.json"
        return read_json(path) if path.exists() else None
