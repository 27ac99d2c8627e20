"""Verification of a data folder: finds damaged, incomplete and foreign files, and those not in the catalogue."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sqlite3
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from stereorig.core.errors import FileFormatError, StorageError
from stereorig.core.names import CAMERAS
from stereorig.server.formats.calibrations.in_test import LATER
from stereorig.server.formats.calibrations.kept_checks import KEPT_CHECKS
from stereorig.server.formats.files import recorded_sha256, sha256_of, storage_error
from stereorig.server.formats.manifest import (
    NAME,
    DamagedError,
    differs_from,
    is_listed_kind,
    is_of_a_worker,
    read_manifest,
    root_of,
)
from stereorig.server.store.folder import check_format, is_id, is_in_use
from stereorig.server.store.manifests import entries_there, files_in
from stereorig.server.store.tests.steps import number_of

Level = Literal["damaged", "incomplete", "index", "foreign"]

# Other files than data: made and removed by a running service
_OURS = frozenset(
    {
        "format.json",
        "service.lock",
        "catalog.sqlite",
        "catalog.sqlite-wal",
        "catalog.sqlite-shm",
        "catalog.sqlite.clean",
        "keys.json",
        "sessions.json",
    }
)
# Names that the service writes into a folder of each kind
_KNOWN = {
    "calibration": r"(plan|target|view|review|failure|rejected|guide|manifest)\.json|manifest|mask\.png|"
    r"(calibration\.json|residuals\.nc)(\.sha256)?|calibration\.checks\.json|views",
    "noise": r"(plan|frames|failure|manifest)\.json|manifest|noise\.json(\.sha256)?|frames",
    "certificate": r"certificate\.(json|html)(\.sha256)?|(withdrawn|manifest)\.json|manifest",
    "test": r"(test|calibration|watch|workspace|certificate_plan|manifest)\.json|manifest|calibrations|channels|"
    r"steps|analyses|exports|models",
    "step": r"step\.json|cam[12]\.tif",
    "analysis": r"(analysis|jobs|noise|summary)\.json|mask\.png|step_[0-9]+\.(nc|nc\.sha256|json)|starts_[0-9]+\.npz|"
    r"head_[0-9]+\.nc(\.sha256)?|head_starts_[0-9]+\.npz|dense",
}
_WRITING_S = 1.0  # longer than a file is under way
#: folders of entries with a manifest of their own, by their kind in the trash
_HOMES = {"calibration": "calibrations", "noise": "noise", "test": "tests"}
_FOLDERS = frozenset({"calibrations", "tests", "noise", "recipes", "certificates", "trash", ".exports"})


@dataclass(frozen=True)
class FolderFinding:
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
    findings: tuple[FolderFinding, ...]

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
        self.findings: list[FolderFinding] = []
        self.there: set[tuple[str, str, str]] = set()  # kind, parent, id, as the catalogue names them
        self.damaged: set[str] = set()
        self.sound: set[Path] = set()
        self.digests: dict[Path, str] = {}
        self.anchors = _anchors(root)
        self.strict = _is_strict(root)

    def report(self, level: Level, path: Path, text: str) -> None:
        name = path.relative_to(self.root).as_posix()
        if level == "damaged":
            if name in self.damaged:
                return
            self.damaged.add(name)
        self.findings.append(FolderFinding(level, name, text))

    def digest(self, path: Path) -> str:
        """SHA-256 of a file, read once."""
        if path not in self.digests:
            self.digests[path] = sha256_of(path)
        return self.digests[path]

    def manifest(self, home: Path, own: str | None = None) -> None:
        """Compare a folder with its manifest, and that with the number and checksum on record."""
        try:
            found = read_manifest(home, own=own)
            if (reason := differs_from(found, self.anchors.get(home))) is not None:
                self.report("damaged", home / NAME, reason)
            listed = found.files()
        except DamagedError as error:
            where = home if home.parent.name == "tests" else root_of(home)
            self.report("damaged", where / str(error.context["file"]), error.cause)
            return
        except FileNotFoundError:
            if home in self.anchors or (self.strict and not self.anchors):
                self.report("damaged", home / NAME, "the file is gone: the folder's content is not known")
                return
            listed = {name: one for name, one in entries_there(home).items() if one is not None}  # as it is adopted
        for name, entry in listed.items():
            path = home / name
            self.unknown += entry.adopted
            if path.is_file() and self.digest(path) == entry.sha256:
                self.count(path)
            elif self.is_being_renamed(path, entry.sha256):
                self.report("incomplete", path, "was about to be written when the service ended")
            else:
                self.report("damaged", path, "does not match its checksum" if path.exists() else "the file is gone")
        for name in files_in(home):
            if name not in listed and not name.endswith(".sha256"):
                mine = is_of_a_worker(name) or name.endswith("/step.json")
                if recorded_sha256(home / name) not in (None, self.digest(home / name)):
                    self.report("damaged", home / name, "does not match its checksum")
                    continue
                text = "is not in the manifest" + (": it was never acknowledged" if mine else "")
                self.report("incomplete" if mine else "foreign", home / name, text)

    def is_being_renamed(self, path: Path, sha256: str) -> bool:
        """Return True if a temporary file with this checksum waits to be renamed at the next start."""
        there = path.parent.glob(f".{path.name}.*.part") if path.parent.is_dir() else ()
        return any(sha256_of(part) == sha256 for part in there)

    def count(self, path: Path) -> None:
        """Count a file that is as it was written."""
        if path not in self.sound:
            self.sound.add(path)
            self.files += 1

    def document(self, path: Path) -> dict[str, Any] | None:
        """A JSON document, or None with a finding."""
        try:
            found = json.loads(path.read_bytes())
            if not isinstance(found, dict):
                raise ValueError(f"it holds {type(found).__name__}, not an object")
        except FileNotFoundError:
            self.report("damaged", path, f"{path.name} is missing.")
        except ValueError as error:
            self.report("damaged", path, f"{path.name} cannot be read as JSON: {error}.")
        else:
            return found
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
            self.unknown += path not in self.sound
        elif self.digest(path) != sha256:
            self.report("damaged", path, "does not match its checksum")
        else:
            self.count(path)

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
                if (path / NAME).is_file():
                    self.manifest(path)
                if (path / mark).relative_to(self.root).as_posix() not in self.damaged:
                    self.report("incomplete", path, f"has no {mark}: it was never acknowledged")

    def calibration(self, path: Path, own: str | None = None) -> None:
        self.there.add(("calibration", "", path.name))
        self.manifest(path, own)
        self.strangers(path, "calibration")
        self.documents(path, "target.json", "failure.json", "rejected.json", "review.json")
        self.documents(path, KEPT_CHECKS)
        if self.document(path / "plan.json") is None:
            return
        taken = self.document(path / "view.json") if (path / "view.json").is_file() else None
        for view in (taken or {}).get("views", []):
            self.compare(path / view["file"], view.get("sha256"))
        if (path / "calibration.json").is_file():
            self.document(path / "calibration.json")
        elif not (path / "failure.json").is_file():
            self.report("incomplete", path, "neither a result nor the reason why there is none")

    def noise(self, path: Path, own: str | None = None) -> None:
        self.manifest(path, own)
        self.strangers(path, "noise")
        self.documents(path, "failure.json")
        if self.document(path / "plan.json") is None:
            return
        taken = self.document(path / "frames.json") if (path / "frames.json").is_file() else None
        for frame in (taken or {}).get("frames", []):
            self.compare(path / frame["file"], frame.get("sha256"))
        if (path / "noise.json").is_file():
            self.document(path / "noise.json")

    def certificate(self, path: Path) -> None:
        self.manifest(path)
        self.strangers(path, "certificate")
        self.documents(path, "withdrawn.json")
        self.document(path / "certificate.json")
        for name in ("certificate.json", "certificate.html"):
            if not (path / name).is_file():
                self.report("damaged", path / name, "it is missing")

    def test(self, path: Path, own: str | None = None) -> None:
        self.there.add(("test", "", path.name))
        self.manifest(path, own)
        document = self.document(path / "test.json")
        if document is not None:
            stated = document.get("id", path.name)
            if own is None and stated != path.name and not (path / NAME).is_file():
                self.report("damaged", path / "test.json", f"is of {str(stated)[:40]}: the folder is a copy")
        self.strangers(path, "test")
        for file in sorted((path / LATER).iterdir()) if (path / LATER).is_dir() else ():
            if not is_listed_kind(f"{LATER}/{file.name}") and not file.name.endswith(".part"):
                self.report("foreign", file, "this name is not one that the service makes")
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

    def step(self, test_id: str, path: Path) -> None:
        if path.suffix == ".deleted" and number_of(path.stem) is not None and path.is_file():
            return
        number = number_of(path.name)
        if number is None or not path.is_dir():
            self.report("foreign", path, "this name is not one that the service makes")
        elif not (path / "step.json").is_file():
            if path.name.isascii() and path.name.isdigit():
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
        self.document(path / "analysis.json")
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
            "step": self.step_files,
            "analysis": lambda content: self.analysis("", content),
        }
        kind = str((document or {}).get("kind"))
        if document is not None and kind in checks:
            checks[kind](path / "content")
        elif document is not None and kind in _HOMES:
            own = f"{_HOMES[kind]}/{document.get(f'{kind}_id')}"
            {"calibration": self.calibration, "noise": self.noise, "test": self.test}[kind](path / "content", own)
        if document is not None and (path / "files.json").is_file():
            self.restorable(path, document)

    def restorable(self, path: Path, document: dict[str, Any]) -> None:
        """Compare a step or an analysis in the trash with its entries of the test's manifest."""
        listed = (self.document(path / "files.json") or {}).get("files") or {}
        under = f"analyses/{document.get('analysis_id')}" if document.get("kind") == "analysis" else "steps/0000"
        for name, entry in listed.items():
            file = path / "content" / name[len(under) + 1 :]
            self.compare(file, entry.get("sha256") if isinstance(entry, dict) else None)

    def top(self) -> None:
        for path in sorted(self.root.iterdir()):
            numbered = path.name.startswith(("catalog.corrupt-", "audit.log"))
            if path.name not in _OURS | _FOLDERS and not numbered and not path.name.endswith(".part"):
                self.report("foreign", path, "this name is not one that the service makes")
        if self.anchors and not (self.root / "format.json").is_file():
            self.report("damaged", self.root / "format.json", "the file is gone")
        for path in sorted(self.root.rglob(".*.part")):
            self.report("incomplete", path, "half written when the service ended")

    def catalog(self) -> None:
        path = self.root / "catalog.sqlite"
        if not path.is_file():
            self.report("index", path, "the catalogue is gone; it is made again at the next start")
            return
        try:
            with contextlib.closing(_connected(path)) as connection:
                if connection.execute("PRAGMA quick_check").fetchone()[0] != "ok":
                    raise sqlite3.DatabaseError("its pages contradict each other")
                rows = connection.execute("SELECT kind, parent, id, document FROM entries").fetchall()
            entries = {(kind, parent, name) for kind, parent, name, text in rows if json.loads(text) is not None}
        except (sqlite3.Error, ValueError) as error:
            self.report("index", path, f"the catalogue cannot be read ({error}); it is made again at the next start")
            return
        for kind, parent, name in sorted(entries ^ self.there):
            where = f"{kind} {f'{parent}/' if parent else ''}{name}"
            text = "has no folder" if (kind, parent, name) in entries else "is not in the catalogue"
            self.report("index", path, f"{where} {text}")


def _is_strict(root: Path) -> bool:
    """Return True if each folder of a data folder had a manifest from its beginning, or was given one."""
    try:
        return bool(int(json.loads((root / "format.json").read_bytes())["format"]) >= 2)
    except (OSError, ValueError, TypeError, KeyError):
        return False


def _connected(path: Path) -> sqlite3.Connection:
    # without the right to write into the folder, SQLite opens the file only as one that does not change
    log = path.with_name(path.name + "-wal")
    still = not os.access(path.parent, os.W_OK) and not (log.exists() and log.stat().st_size)
    return sqlite3.connect(f"file:{path}?{'mode=ro&immutable=1' if still else 'mode=ro'}", uri=True)


def _anchors(root: Path) -> dict[Path, tuple[int, str]]:
    """Return numbers and checksums of the newest manifests, as the catalogue has them; none without a catalogue."""
    try:
        with contextlib.closing(_connected(root / "catalog.sqlite")) as connection:
            rows = connection.execute("SELECT home, number, sha256 FROM manifests").fetchall()
    except sqlite3.Error:
        return {}
    return {root / home: (number, sha256) for home, number, sha256 in rows}


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
        if (root / "recipes" / NAME).is_file() or walk.anchors.get(root / "recipes") is not None:
            walk.manifest(root / "recipes")
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
