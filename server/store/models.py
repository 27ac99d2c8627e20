"""Models of a test: finite element results as they were given, and how they are read and placed.

``models/<id>/model.json`` is written last and holds the checksum of every file: only a folder that has it is a model.
"""

from __future__ import annotations

import re
import secrets
import shutil
import threading
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from stereorig.core.errors import FileFormatError, InputError, StorageError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.base.models import Document
from stereorig.server.formats.files import fsync_path, sha256_of
from stereorig.server.formats.manifest import is_there
from stereorig.server.store.durable import make_folder, read_record, record_of, write_bytes
from stereorig.server.store.folder import is_id, now_utc
from stereorig.server.store.tests.tests import TestStore

FOLDER = "models"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")
_MOST = 100  # of one test


class ModelRecord(Document):
    """A model that is kept with a test."""

    id: str = Field(description="Id of the model.", examples=["m000001-4b1e09"])
    test_id: str = Field(description="The test.")
    created_utc: str = Field(description="Time at which it was given.")
    name: str = Field(description="The file's name as it was given.")
    file: str = Field(description="The file's name as it is kept.")
    files: dict[str, str] = Field(description="SHA-256 of each file, heavy data of XDMF among them.")
    reading: dict[str, object] = Field(description="Reading options and placement: unit, displacement, time, align.")
    unit: str = Field(description="Unit of its positions.")
    displacement: str = Field(description="Name of the array of displacements.")
    nodes: int = Field(description="Nodes.")


def check_file_name(name: str) -> str:
    """Return the name of a file of heavy data, under which it is kept.

    Raises
    ------
    InputError
        ``model_name_invalid`` for one that could be a path, or is no plain name.
    """
    if _NAME.fullmatch(name) is None or name in ("model.json",):
        raise InputError(
            f"The heavy data's file has the name {name[:100]!r}.",
            code="model_name_invalid",
            remedy="Give it a name of letters, digits, dots, hyphens and underscores, and the same in the XDMF.",
        )
    return name


class ModelStore:
    """The models of the tests of a data folder."""

    def __init__(self, tests: TestStore) -> None:
        self._tests = tests
        self._lock = threading.Lock()

    def path(self, test_id: str, model_id: str) -> Path:
        """Folder of an existing model.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        """
        path = self._tests.path(test_id) / FOLDER / model_id if is_id(model_id, "m") else None
        if path is None or not is_there(path / "model.json"):
            raise NotFoundError(f"Test {test_id} has no model {model_id[:40]!r}.", kind="model")
        return path

    def ids(self, test_id: str) -> list[str]:
        """Ids of a test's models, in the order of their making."""
        home = self._tests.path(test_id)
        listed = self._tests.folders.data.manifests.under(home, FOLDER)
        there = [path.relative_to(home).as_posix() for path in (home / FOLDER).glob("m*/model.json")]
        names = {name.split("/")[1] for name in (*listed, *there)}  # one that was lost is named when it is read
        return sorted(name for name in names if is_id(name, "m"))

    def read(self, test_id: str, model_id: str) -> ModelRecord:
        """Return ``model.json``."""
        return read_record(ModelRecord, self.path(test_id, model_id) / "model.json")

    def file(self, test_id: str, model_id: str) -> Path:
        """Path of a model's file; that and its heavy data match their checksums.

        Raises
        ------
        FileFormatError
            ``checksum_mismatch``, naming the file.
        """
        path, record = self.path(test_id, model_id), self.read(test_id, model_id)
        for name, sha256 in record.files.items():
            held = path / check_file_name(name)
            if not is_there(held) or sha256_of(held) != sha256:
                raise FileFormatError(
                    f"{name} of model {model_id} does not match its checksum.",
                    code="checksum_mismatch",
                    remedy="Give the model again; measured data are not touched.",
                    file=f"{FOLDER}/{model_id}/{name}",
                )
        return path / check_file_name(record.file)

    def create(self, test_id: str, files: Mapping[str, Path], document: Mapping[str, object]) -> ModelRecord:
        """Keep a model: its files by name, then ``model.json``; durable when this returns.

        Raises
        ------
        InputError
            ``models_full``.
        """
        with self._lock:
            root = self._tests.path(test_id) / FOLDER
            if not root.is_dir():
                make_folder(root)
            there = [p.name for p in root.iterdir() if is_id(p.name, "m")]
            if len(there) >= _MOST:
                raise InputError(
                    f"Test {test_id} has {len(there)} models.", code="models_full", remedy="Delete one of them."
                )
            number = 1 + max((int(name[1:7]) for name in there), default=0)
            model_id = f"m{number:06d}-{secrets.token_hex(3)}"
            path = root / model_id
            make_folder(path)
            try:
                sha256 = {name: write_bytes(path / name, held.read_bytes()) for name, held in files.items()}
                made = {"id": model_id, "test_id": test_id, "created_utc": now_utc(), **document, "files": sha256}
                self._tests.folders.data.manifests.write_json(path / "model.json", made)
            except StorageError:
                shutil.rmtree(path, ignore_errors=True)
                raise
        return record_of(ModelRecord, made, path / "model.json")

    def remove(self, test_id: str, model_id: str) -> None:
        """Remove a model; comparisons that were read are not kept, and nothing measured changes."""
        with self._lock:
            path = self.path(test_id, model_id)
            self._tests.folders.data.manifests.strike(path.parent.parent, [f"{FOLDER}/{model_id}/model.json"])
            (path / "model.json").unlink()  # from now on it is none
            fsync_path(path)
            shutil.rmtree(path, ignore_errors=True)
            fsync_path(path.parent)
