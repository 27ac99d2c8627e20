"""Tests on disk: documents, metadata, calibrations; `steps` and `analyses` are stores of their own."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from stereorig.core.errors import StateError
from stereorig.server.documents.tests import TestRecord
from stereorig.server.formats.calibrations.in_test import LATER, calibration_in, later_file
from stereorig.server.formats.manifest import checked_bytes, is_there, require_sound
from stereorig.server.store.durable import make_folder, read_json, record_of
from stereorig.server.store.folder import DataFolder, is_id, now_utc
from stereorig.server.store.tests.analyses import AnalysisStore
from stereorig.server.store.tests.folders import TestFolders
from stereorig.server.store.tests.steps import StepStore


class TestStore:
    """The tests of one data folder.

    Attributes
    ----------
    folders
        Their paths, and the callback before one is changed.
    steps, analyses
        Stores of the tests' steps and analyses.
    """

    def __init__(self, folder: DataFolder) -> None:
        self.folders = TestFolders(folder)
        self._manifests = folder.manifests
        self.steps = StepStore(self.folders)
        self.analyses = AnalysisStore(self.folders)

    def path(self, test_id: str) -> Path:
        """Folder of an existing test, see :meth:`TestFolders.path`."""
        return self.folders.path(test_id)

    def ids(self) -> list[str]:
        """Ids of all tests, in the order of their making."""
        return sorted(p.parent.name for p in self.folders.data.tests.glob("t*/test.json") if is_id(p.parent.name, "t"))

    def create(self, document: Mapping[str, object], calibration: Path | None) -> TestRecord:
        """Make a test, with its own copy of the calibration; ``test.json`` last."""
        test_id = self.folders.data.ids.new("t")
        path = self.folders.data.tests / test_id
        make_folder(path)
        make_folder(path / "steps")
        make_folder(path / "analyses")
        if calibration is not None:
            digest = self._manifests.write(path / "calibration.json", checked_bytes(calibration))
            document = {**document, "calibration_sha256": digest}
        document = {"id": test_id, "created_utc": now_utc(), **document}
        self._manifests.write_json(path / "test.json", document)
        return TestRecord.model_validate(document)

    def read(self, test_id: str) -> TestRecord:
        """Return ``test.json``."""
        return self.folders.read(test_id)

    def update(self, test_id: str, changes: Mapping[str, object]) -> TestRecord:
        """Change fields of ``test.json``."""
        path = self.folders.to_change(test_id) / "test.json"
        with self.folders.lock:
            document = {**read_json(path), **changes}
            self._manifests.write_json(path, document)
        return record_of(TestRecord, document, path)

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Hold the lock: no step is added and no test changed inside the block."""
        with self.folders.lock:
            yield

    def metadata(self, test_id: str) -> dict[str, object]:
        """Return a test's metadata; empty if none were stated."""
        return self.read(test_id).metadata

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
            ``metadata_changed`` if the present ones are others.
        """
        self.folders.to_change(test_id)
        with self.folders.lock:
            if expected is not None and self.metadata(test_id) != expected:
                raise StateError(
                    f"The metadata of test {test_id} were changed since.",
                    code="metadata_changed",
                    remedy="Read them again, then send the change.",
                )
            path = self.path(test_id) / "test.json"
            self._manifests.write_json(path, read_json(path) | {"metadata": metadata})

    def workspace(self, test_id: str) -> dict[str, object]:
        """Return the drawing and settings of a test; empty if there are none."""
        path = self.path(test_id) / "workspace.json"
        return read_json(path) if is_there(path) else {}

    def put_workspace(self, test_id: str, document: Mapping[str, object]) -> None:
        """Replace the drawing and settings of a test; durable when this returns."""
        self._manifests.write_json(self.folders.to_change(test_id) / "workspace.json", document)

    def procedure(self, test_id: str) -> dict[str, object]:
        """Return a test's verification procedure; empty if it has none."""
        path = self.path(test_id) / "certificate_plan.json"
        return read_json(path) if is_there(path) else {}

    def put_procedure(self, test_id: str, document: Mapping[str, object]) -> None:
        """Replace a test's verification procedure; durable when this returns."""
        self._manifests.write_json(self.folders.to_change(test_id) / "certificate_plan.json", document)

    def readings(self, test_id: str) -> list[Path]:
        """Return the tables of channels' readings, in the order of time."""
        return sorted((self.path(test_id) / "channels").glob("[0-9][0-9][0-9][0-9].csv"))

    def add_readings(self, test_id: str, rows: bytes, header: bytes, table_bytes: int, tables: int) -> bool:
        """Add rows to the newest table of readings, or begin one; durable when this returns.

        Parameters
        ----------
        header
            First line of each table.
        table_bytes, tables
            A table of that size gets no further rows; with that many tables nothing is added, and False returned.
        """
        folder = self.folders.to_change(test_id) / "channels"
        with self.folders.lock:
            there = self.readings(test_id)
            number, data = len(there), b""
            if there and there[-1].stat().st_size < table_bytes:
                number, data = number - 1, checked_bytes(there[-1])
            if number >= tables:
                return False
            if not folder.is_dir():
                make_folder(folder)
            self._manifests.write(folder / f"{number:04d}.csv", (data or header) + rows)
        return True

    def is_calibrated(self, test_id: str) -> bool:
        """Return True if the test has a calibration to measure with."""
        return is_there(calibration_in(self.path(test_id)))

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
        test = self.folders.to_change(test_id)
        sha256 = hashlib.sha256(content).hexdigest()
        with self.folders.lock:
            document = read_json(test / "test.json")
            before = document.get("calibration_sha256")
            if sha256 not in {before, *document.get("calibrations", {})}:
                if not (test / LATER).is_dir():
                    make_folder(test / LATER)
                self._manifests.write(later_file(test, sha256), content)
            first = {} if before is None else {before: document.get("calibration_id")}
            document["calibrations"] = {**first, **document.get("calibrations", {}), sha256: calibration_id}
            if in_force:
                document |= {"calibration_id": calibration_id, "calibration_sha256": sha256}
            self._manifests.write_json(test / "test.json", document)
        return record_of(TestRecord, document, test / "test.json")

    def calibration_file(self, test_id: str, sha256: str | None = None) -> Path:
        """The test's own copy of a calibration: of the one in force, or of the one with a checksum.

        Raises
        ------
        DamagedError
            If it is not as the test was given it.
        StateError
            ``not_calibrated`` if the test has none.
        """
        path = calibration_in(self.path(test_id), sha256)
        if is_there(path):
            require_sound(path)
        else:
            raise StateError(
                f"Test {test_id} has no calibration.",
                code="not_calibrated",
                remedy="Give the test a calibration, or name one for the analysis (calibration_id).",
            )
        return path
