"""Folders of the tests: their paths, the lock under which they are changed, and the callback before a change."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.tests import TestRecord
from stereorig.server.formats.manifest import is_there
from stereorig.server.store.durable import read_record
from stereorig.server.store.folder import DataFolder, is_id


class TestFolders:
    """Common base of the stores of tests, steps and analyses."""

    def __init__(self, folder: DataFolder) -> None:
        self.data = folder
        self.lock = threading.Lock()
        #: called with a test's id before anything in its folder is changed
        self.before_change: Callable[[str], None] | None = None

    def path(self, test_id: str) -> Path:
        """Folder of an existing test.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        """
        path = self.data.tests / test_id if is_id(test_id, "t") else None
        if path is None or not is_there(path / "test.json"):
            raise NotFoundError(f"There is no test {test_id[:40]!r}.", kind="test")
        return path

    def read(self, test_id: str) -> TestRecord:
        """Return ``test.json``."""
        return read_record(TestRecord, self.path(test_id) / "test.json")

    def to_change(self, test_id: str) -> Path:
        """As `path`, of a test that is about to be changed."""
        if self.before_change is not None:
            self.before_change(test_id)
        return self.path(test_id)
