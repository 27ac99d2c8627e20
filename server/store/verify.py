"""Verification of a data folder: finds damaged, incomplete and foreign files, and those not in the catalogue."""

from __future__ import annotations

import json
import os
import re
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from core.errors import FileFormatError, StorageError
from core.names import CAMERAS
from server.formats.calibrations.in_test import LATER
from server.formats.calibrations.kept_checks import KEPT_CHECKS
from server.formats.files import recorded_sha256, sha256_of, storage_error
from server.formats.results.folder import DENSE
from server.store.durable import read_json
from server.store.folder import check_format, is_id, is_in_use
from server.store.tests.steps import number_of

Level = Literal["damaged", "incomplete", "index", "foreign"]

# Files beside the data: made and removed by a running service
_OURS = frozenset(
    {
        "format.json",
        "service.lock",
        "catalog.sqlite",
        "catalog.sqlite-wal",
        "catalog.sqlite-shm",
        "catalog.sqlite.clean",
        "keys.json",
    }
)
# Names that the service writes into a folder of each kind
_KNOWN = {
    "calibration": r"(plan|target|view|review|judgement|failure|rejected)\.json|"
    r"(calibration\.json|residuals\.nc)(\.sha256)?|calibration\.checks\.json|views",
    "noise": r"(plan|frames|failure)\.json|noise\.json(\.sha256)?|frames",
    "certificate": r"certificate\.(json|html)(\.sha256)?|withdrawn\.json",
    "test": r"(test|calibration|watch|workspace|certificate_plan)\.json|calibrations|steps|analyses|exports|models",
    "step": r"step\.json|cam[12]\.tif",
    "analysis": r"(analysis|jobs|noise|summary)\.json|mask\.png|step_\d+\.(nc|nc\.sha256|json)|starts_\d+\.npz|"
    r"head_\d+\.nc(\.sha256)?|head_starts_\d+\.npz|dense",
}
_WRITING_S = 1.0  # longer than a file is under way
_FOLDERS = frozenset({"calibrations", "tests", "noise", "recipes", "certificates", "trash", ".exports"})


@dataclass(frozen=True)
class Finding:
    """One thing that is not as it ought to be.

    Parameters
    ----------
    level
        ``damaged``: data that were there are not as they were written. ``incomplete``: left by a crash, never
        acknowledged. ``index``: the catalogue disagrees with the folders. ``foreign``: no file of ours.
    path
        Relative to the data folder.
    text
        The defect.
    """

    level: Level
    path: str
    text: str


@dataclass(frozen=True)
class Verification:
    """Extent and findings of a verification.

    Parameters
    ----------
    files
        Files whose checksum was compared.
    unknown
        Files of data that have no checksum on record.
    findings
        Empty when all is well.
    """

    files: int
    unknown: int
    findings: tuple[Finding, ...]

    @property
    def sound(self) -> bool:
        """True if nothing is damaged; incomplete, foreign and index findings lose nothing."""
        return all(finding.level != "damaged" for finding in self.findings)


class _Walk:
    """One pass over a data folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.files = 0
        self.unknown = 0
        self.findings: list[Finding] = []
        self.there: set[tuple[str, str, str]] = set()  # kind, parent, id, as the catalogue names them

    def report(self, level: Level, path: Path, text: str) -> None:
        self.findings.append(Finding(level, path.relative_to(self.root).as_posix(), text))

    def document(self, path: Path) -> dict[str, Any] | None:
        """A JSON document, or None with a finding."""
        try:
            return read_json(path)
        except FileFormatError as error:
            self.report("damaged", path, error.cause)
            return None

    def documents(self, folder: Path, *names: str) -> None:
        """Read the documents that may be there."""
        for name in names:
            if (folder / name).is_file():
                self.document(folder / name)

    def strangers(self, folder: Path, kind: str) -> None:
        """Report strange files in a folder; half-written ones are reported elsewhere."""
        for path in sorted(folder.iterdir()):
            if re.fullmatch(_KNOWN[kind], path.name) is None and not path.name.endswith(".part"):
                self.report("foreign", path, "this name is not one that the service makes")

    def compare(self, path: Path, sha256: object) -> None:
        """Compare a file with its checksum on record."""
        if not path.is_file():
            self.report("damaged", path, "the file is gone")
        elif not isinstance(sha256, str):
            self.unknown += 1
        elif sha256_of(path) != sha256:
            self.report("damaged", path, "does not match its checksum")
        else:
            self.files += 1

    def compare_beside(self, path: Path) -> None:
        """Compare a file with the checksum beside it."""
        self.compare(path, recorded_sha256(path))

    def entries(self, folder: Path, letter: str, mark: str) -> Iterator[Path]:
        """Folders of a kind that hold their mark; the others are reported."""
        if not folder.is_dir():
            return
        for path in sorted(folder.iterdir()):
            if not is_id(path.name, letter) or not path.is_dir():
                self.report("foreign", path, "this name is not one that the service makes")
            elif (path / mark).exists():
                yield path
            else:
                self.report("incomplete", path, f"has no {mark}: it was never acknowledged")

    def calibration(self, path: Path) -> None:
        self.there.add(("calibration", "", path.name))
        self.strangers(path, "calibration")
        self.documents(path, "target.json", "failure.json", "rejected.json", "review.json", "judgement.json")
        self.documents(path, KEPT_CHECKS)
        if self.document(path / "plan.json") is None:
            return
        taken = self.document(path / "view.json") if (path / "view.json").is_file() else None
        for view in (taken or {}).get("views", []):
            self.compare(path / view["file"], view.get("sha256"))
        if (path / "calibration.json").is_file():
            self.document(path / "calibration.json")
            self.compare_beside(path / "calibration.json")
        elif not (path / "failure.json").is_file():
            self.report("incomplete", path, "neither a result nor the reason why there is none")
        if (path / "residuals.nc").is_file():
            self.compare_beside(path / "residuals.nc")

    def noise(self, path: Path) -> None:
        self.strangers(path, "noise")
        self.documents(path, "failure.json")
        if self.document(path / "plan.json") is None:
            return
        taken = self.document(path / "frames.json") if (path / "frames.json").is_file() else None
        for frame in (taken or {}).get("frames", []):
            self.compare(path / frame["file"], frame.get("sha256"))
        if (path / "noise.json").is_file():
            self.document(path / "noise.json")
            self.compare_beside(path / "noise.json")

    def certificate(self, path: Path) -> None:
        self.strangers(path, "certificate")
        self.documents(path, "withdrawn.json")
        self.document(path / "certificate.json")
        for name in ("certificate.json", "certificate.html"):
            if (path / name).is_file():
                self.compare_beside(path / name)
            else:
                self.report("damaged", path / name, "it is missing")

    def test(self, path: Path) -> None:
        self.there.add(("test", "", path.name))
        document = self.document(path / "test.json")
        if document is not None:
            self.calibrations_of(path, document)
        self.strangers(path, "test")
        self.documents(path, "watch.json", "workspace.json", "certificate_plan.json")
        for step in sorted((path / "steps").iterdir()) if (path / "steps").is_dir() else ():
            self.step(path.name, step)
        for analysis in self.entries(path / "analyses", "a", "analysis.json"):
            self.analysis(path.name, analysis)
        for model in self.entries(path / "models", "m", "model.json"):
            self.model(model)

    def model(self, path: Path) -> None:
        document = self.document(path / "model.json")
        files = (document or {}).get("files")
        held = files if isinstance(files, dict) else {}
        for name, sha256 in held.items():
            self.compare(path / Path(name).name, sha256)
        for file in sorted(path.iterdir()) if document is not None else ():
            if file.name not in {*held, "model.json"} and not file.name.endswith(".part"):
                self.report("foreign", file, "this name is not one that the service makes")

    def calibrations_of(self, path: Path, document: dict[str, Any]) -> None:
        """Check a test's copies of calibrations: the first, and those that it was given since."""
        in_force = document.get("calibration_sha256")
        given = document.get("calibrations") or {}
        later = sorted((path / LATER).iterdir()) if (path / LATER).is_dir() else []
        for file in later:
            if re.fullmatch(r"[0-9a-f]{64}\.json", file.name):
                self.compare(file, file.stem)
            elif not file.name.endswith(".part"):
                self.report("foreign", file, "this name is not one that the service makes")
        first = {*given, in_force} - {None} - {file.stem for file in later}
        if (path / "calibration.json").exists():
            # that of a copied test may be on no record
            known = next(iter(first)) if len(first) == 1 else in_force if in_force in first else None
            self.compare(path / "calibration.json", known)
        elif first:
            self.report("damaged", path / "calibration.json", "the file is gone")

    def step(self, test_id: str, path: Path) -> None:
        if path.suffix == ".deleted" and number_of(path.stem) is not None and path.is_file():
            return
        number = number_of(path.name)
        if number is None or not path.is_dir():
            self.report("foreign", path, "this name is not one that the service makes")
        elif not (path / "step.json").is_file():
            if path.name.isdigit():
                self.report("incomplete", path, "has no step.json: it was never acknowledged")
        else:
            self.there.add(("step", test_id, f"{number:04d}"))
            self.step_files(path)

    def step_files(self, path: Path) -> None:
        self.strangers(path, "step")
        document = self.document(path / "step.json")
        if document is not None:
            sha256 = document.get("sha256")
            for cam in CAMERAS:
                self.compare(path / f"{cam}.tif", sha256.get(cam) if isinstance(sha256, dict) else None)

    def analysis(self, test_id: str, path: Path) -> None:
        self.there.add(("analysis", test_id, path.name))
        document = self.document(path / "analysis.json")
        if document is not None and (path / "mask.png").exists():
            self.compare(path / "mask.png", document.get("mask_sha256"))
        for result in sorted((*path.glob("step_[0-9]*.nc"), *path.glob(f"{DENSE}/step_[0-9]*.nc"))):
            self.compare_beside(result)
        for beside in sorted(path.glob("step_[0-9]*.nc.sha256")):
            result = beside.with_suffix("")
            if not result.is_file():
                self.report("incomplete", beside, "a checksum without its result: it was never announced")
        for summary in sorted(path.glob("step_[0-9]*.json")):
            self.document(summary)
        self.documents(path, "summary.json", "noise.json", "jobs.json")
        self.strangers(path, "analysis")

    def trashed(self, path: Path) -> None:
        """Check the trash, whose entries can be restored; after the catalogue, which does not list them."""
        document = self.document(path / "trash.json")
        checks: dict[str, Callable[[Path], None]] = {
            "calibration": self.calibration,
            "noise": self.noise,
            "test": self.test,
            "step": self.step_files,
            "analysis": lambda content: self.analysis("", content),
        }
        if document is not None and (found := checks.get(str(document.get("kind")))) is not None:
            found(path / "content")

    def top(self) -> None:
        for path in sorted(self.root.iterdir()):
            numbered = path.name.startswith(("catalog.corrupt-", "audit.log"))
            if path.name not in _OURS | _FOLDERS and not numbered and not path.name.endswith(".part"):
                self.report("foreign", path, "this name is not one that the service makes")
        for path in sorted(self.root.rglob(".*.part")):
            self.report("incomplete", path, "half written when the service ended")

    def catalog(self) -> None:
        path = self.root / "catalog.sqlite"
        if not path.is_file():
            self.report("index", path, "the catalogue is gone; it is made anew at the next start")
            return
        try:
            # without the right to write beside it, SQLite opens the file only as one that does not change
            log = path.with_name(path.name + "-wal")
            still = not os.access(path.parent, os.W_OK) and not (log.exists() and log.stat().st_size)
            mode = "mode=ro&immutable=1" if still else "mode=ro"
            connection = sqlite3.connect(f"file:{path}?{mode}", uri=True)
            try:
                if connection.execute("PRAGMA quick_check").fetchone()[0] != "ok":
                    raise sqlite3.DatabaseError("its pages contradict each other")
                rows = connection.execute("SELECT kind, parent, id, document FROM entries").fetchall()
            finally:
                connection.close()
            entries = {(kind, parent, name) for kind, parent, name, text in rows if json.loads(text) is not None}
        except (sqlite3.Error, ValueError) as error:
            self.report("index", path, f"the catalogue cannot be read ({error}); it is made anew at the next start")
            return
        for kind, parent, name in sorted(entries ^ self.there):
            where = f"{kind} {f'{parent}/' if parent else ''}{name}"
            text = "has no folder" if (kind, parent, name) in entries else "is not in the catalogue"
            self.report("index", path, f"{where} {text}")


def verify(root: Path) -> Verification:
    """Read every document and compare every file with its checksum.

    Parameters
    ----------
    root
        A data folder; a service may run on it: then only findings that repeat a moment later are reported.

    Raises
    ------
    FileFormatError
        ``no_data_folder`` when this is none, ``data_format_newer`` when a newer version wrote it.
    StorageError
        When the disk does not let it be read.
    """
    root = root.absolute()
    require_data_folder(root)
    found = _check_all(root)
    if found.findings and is_in_use(root):
        time.sleep(_WRITING_S)  # it may have been written, or deleted, just while it was checked
        again = _check_all(root)
        before = set(found.findings)
        found = replace(again, findings=tuple(finding for finding in again.findings if finding in before))
    return found


def verify_test(root: Path, test_id: str) -> Verification:
    """As `verify`, one test of a data folder alone; whether its files are ours is not asked of the folder itself.

    Raises
    ------
    StorageError
        When the disk does not let it be read.
    """
    walk = _Walk(root.absolute())
    try:
        walk.test(walk.root / "tests" / test_id)
    except OSError as error:
        raise _unreadable(error, root) from error
    return Verification(walk.files, walk.unknown, tuple(walk.findings))


def _check_all(root: Path) -> Verification:
    walk = _Walk(root)
    try:
        walk.top()
        for path in walk.entries(root / "calibrations", "c", "plan.json"):
            walk.calibration(path)
        for path in walk.entries(root / "noise", "n", "plan.json"):
            walk.noise(path)
        for path in walk.entries(root / "certificates", "v", "certificate.json"):
            walk.certificate(path)
        for path in walk.entries(root / "tests", "t", "test.json"):
            walk.test(path)
        walk.catalog()
        for path in walk.entries(root / "trash", "x", "content"):
            walk.trashed(path)
    except OSError as error:
        raise _unreadable(error, root) from error
    return Verification(walk.files, walk.unknown, tuple(walk.findings))


def require_data_folder(root: Path) -> None:
    """Raise an error for a folder that is no data folder, or a newer version's; see `verify`."""
    if not (root / "format.json").is_file() and not (root / "tests").is_dir():
        raise FileFormatError(
            f"{root} is no data folder: it has neither format.json nor tests/.",
            code="no_data_folder",
            remedy="Give the folder that 'stereorig serve --data' was given.",
        )
    if (root / "format.json").is_file():
        check_format(root / "format.json")


def _unreadable(error: OSError, root: Path) -> StorageError:
    cause = storage_error(error, root).cause
    return StorageError(
        f"{root} cannot be read through: {cause}", remedy="Check the disk and the rights on the folder."
    )
