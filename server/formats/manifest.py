"""The manifest of a folder of data: each file with its size and SHA-256, compared whenever the file is read.

Each test, calibration, noise measurement and certificate has a ``manifest.json`` in its folder, and so have the
recipes. It names its folder, its number and the SHA-256 of the manifest before it. Entries that have not changed for
long are in parts (``manifest/<number>.json``), which it lists like other files. A step's images, a calibration's views,
the frames of a noise measurement and a model's files are listed by the document that is written after them, which the
manifest lists.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stereorig.core.errors import FileFormatError
from stereorig.server.formats.files import checksum_file, mark_of, recorded_sha256, sha256_of

NAME = "manifest.json"
PARTS = "manifest"
FORMAT = 1

#: the document that makes a folder of each kind one of ours, and the letter of its id
_KINDS = {
    "tests": ("t", "test.json"),
    "calibrations": ("c", "plan.json"),
    "noise": ("n", "plan.json"),
    "certificates": ("v", "certificate.json"),
}
_ID = re.compile(r"[a-z][0-9]{6}-[0-9a-f]{6}")
_RECIPE = re.compile(r"r[0-9]{6}-[0-9a-f]{6}\.json")
#: files that a manifest itself lists; the state of a watched channel belongs to the service, and files that only an
#: unfinished analysis needs carry checksums of their own or are deleted with it
_LISTED = re.compile(
    r"(test|workspace|certificate_plan|plan|target|view|review|failure|guide|frames|withdrawn)\.json|"
    r"((calibration|rejected|noise|certificate)\.json|residuals\.nc|certificate\.html|mask\.png)(\.sha256)?|"
    r"calibration\.checks\.json|calibrations/[0-9a-f]{64}\.json|channels/[0-9]{4}\.csv|"
    r"steps/[0-9]{4}(/step\.json|\.deleted)|"
    r"analyses/a[0-9]{6}-[0-9a-f]{6}/((analysis|jobs|noise|summary)\.json|mask\.png|"
    r"(dense/)?step_[0-9]+\.(nc|nc\.sha256|json))|models/m[0-9]{6}-[0-9a-f]{6}/model\.json|"
    r"r[0-9]{6}-[0-9a-f]{6}\.json"
)
_PART = re.compile(r"manifest/[0-9]{8}\.json")
#: files that a worker writes and the service lists a moment later
_OF_WORKERS = re.compile(
    r"analyses/[^/]+/(dense/)?step_[0-9]+\.(nc|nc\.sha256|json)|(calibration|rejected|noise)\.json(\.sha256)?|"
    r"residuals\.nc(\.sha256)?"
)
#: documents that list the files that the manifest does not list itself
_LISTING = (
    (re.compile(r"steps/([0-9]{4})/(cam[12])\.tif"), r"steps/\1/step.json", r"\2"),
    (re.compile(r"models/([^/]+)/(?!model\.json$)([^/]+)"), r"models/\1/model.json", r"\2"),
    (re.compile(r"(views/[^/]+)"), "view.json", r"\1"),
    (re.compile(r"(frames/[^/]+)"), "frames.json", r"\1"),
)
_TRIES, _PAUSE_S = 4, 0.05


class DamagedError(FileFormatError):
    """A file of data is not as it was written: changed, swapped, or gone."""

    code = "checksum_mismatch"
    remedy = "Restore the file from a backup, or make it again; nothing else is touched."


@dataclass(frozen=True, slots=True)
class Listed:
    """An entry: size and SHA-256 of a file; ``adopted``: no checksum was on record before the manifest was made."""

    bytes: int
    sha256: str
    adopted: bool = False

    def plain(self) -> dict[str, object]:
        """Return the entry as it is written."""
        return {"bytes": self.bytes, "sha256": self.sha256, **({"adopted": True} if self.adopted else {})}


Entries = dict[str, Listed | None]


@dataclass
class Manifest:
    """A manifest as it was read or written.

    Attributes
    ----------
    home
        Path of its folder relative to the data folder.
    number, sha256
        Number of the change that it was written for, and checksum of its own bytes.
    own
        Its own entries; None for a name that is in a part and holds no longer.
    parts
        Its parts in the order of their making, with their entries; a later one replaces an earlier one.
    ahead
        The disk holds a change that failed and is not in here.
    """

    home: str
    number: int = 0
    sha256: str = ""
    previous: str = ""
    own: Entries = field(default_factory=dict)
    parts: dict[str, tuple[Listed, Entries]] = field(default_factory=dict)
    ahead: bool = False

    def get(self, name: str) -> Listed | None:
        """Return the entry of a file; None if it is not listed."""
        if name in self.own:
            return self.own[name]
        for _, entries in reversed(self.parts.values()):
            if name in entries:
                return entries[name]
        return None

    def files(self) -> dict[str, Listed]:
        """Return all entries."""
        found: Entries = {}
        for _, entries in self.parts.values():
            found |= entries
        found |= self.own
        return {name: listed for name, listed in found.items() if listed is not None}


# places --------------------------------------------------------------------------------------------------------------


def place_of(path: Path) -> tuple[Path, str] | None:
    """Return the folder whose manifest lists a file, and the file's name in it; None for a file of no such folder."""
    text = os.path.abspath(path)  # noqa: PTH100 - of every file that is read
    parts = text.split("/")
    for k in range(1, len(parts) - 2):
        kind = _KINDS.get(parts[k])
        if kind is not None and parts[k + 1][:1] == kind[0] and _ID.fullmatch(parts[k + 1]):
            return Path("/".join(parts[: k + 2])), "/".join(parts[k + 2 :])
    if parts[-2] == "recipes" and _RECIPE.fullmatch(parts[-1]):
        return Path("/".join(parts[:-1])), parts[-1]
    return None


def root_of(home: Path) -> Path:
    """Return the data folder that contains a folder with a manifest."""
    return home.parent if home.name == "recipes" else home.parent.parent


def is_listed_kind(name: str) -> bool:
    """Return True if the manifest itself lists a file of this name."""
    return _LISTED.fullmatch(name) is not None


def is_of_a_worker(name: str) -> bool:
    """Return True if a worker writes files of this name, which are listed once the service has taken them over."""
    return _OF_WORKERS.fullmatch(name) is not None


# reading -------------------------------------------------------------------------------------------------------------


class KnownManifests:
    """Manifests in memory, and the newest number and checksum of each that are on record elsewhere.

    Attributes
    ----------
    owned
        Data folders that this process alone writes into: their manifests change through it alone.
    """

    def __init__(self) -> None:
        self._known: dict[Path, tuple[tuple[int, ...], Manifest]] = {}
        self._locks: dict[Path, threading.RLock] = {}
        self._guard = threading.Lock()
        self.anchors: dict[Path, tuple[int, str]] = {}
        self.owned: set[Path] = set()

    def lock(self, home: Path) -> threading.RLock:
        """Return the lock under which a folder's files and its manifest are changed together."""
        with self._guard:
            return self._locks.setdefault(home, threading.RLock())

    def forget(self, root: Path) -> None:
        """Forget everything about a data folder."""
        with self._guard:
            for held in (self._known, self._locks, self.anchors):
                for home in [one for one in held if root in one.parents]:
                    del held[home]
            self.owned.discard(root)

    def put(self, home: Path, manifest: Manifest) -> None:
        """Keep a manifest that was written just now."""
        self._known[home] = _stamp(home / NAME), manifest

    def load(self, home: Path) -> Manifest | None:
        """Return the manifest of a folder; None of a folder that was made before there were manifests.

        Raises
        ------
        DamagedError
            ``file_missing`` if it was lost, ``checksum_mismatch`` if it is not the one that was written last,
            ``folder_copied`` if it is another folder's.
        """
        try:
            stamp = _stamp(home / NAME)
        except OSError:
            self._require_known(home)
            return None
        known = self._known.get(home)
        if known is not None and known[0] == stamp:
            return known[1]
        with self.lock(home):
            known = self._known.get(home)
            try:
                stamp = _stamp(home / NAME)
                if known is not None and known[0] == stamp:
                    return known[1]
                found = read_manifest(home, None if known is None else known[1])
            except OSError:
                self._require_known(home)
                return None
            owned = known is not None and root_of(home) in self.owned
            if owned and known is not None and found.sha256 != known[1].sha256:
                raise damaged(home, NAME, "is not the one that was written last")
            reason = differs_from(found, self.anchors.get(home))
            if reason is not None:
                raise damaged(home, NAME, reason)
            self._known[home] = stamp, found if not owned or known is None else known[1]
            return self._known[home][1]

    def _require_known(self, home: Path) -> None:
        """Raise an error for a folder whose manifest was lost; one that was put there by hand never had one."""
        if home.is_dir() and (home in self._known or home in self.anchors):
            raise lost(home, NAME)


kept = KnownManifests()


def _stamp(path: Path) -> tuple[int, ...]:
    found = os.stat(path)  # noqa: PTH116 - of every file that is read
    return (*mark_of(found), found.st_mtime_ns)


def read_manifest(home: Path, known: Manifest | None = None, *, own: str | None = None) -> Manifest:
    """Read a manifest with its parts, and compare it with its folder; parts of the known one are not read again.

    ``own`` is the path of the folder before it was moved to the trash.

    Raises
    ------
    DamagedError
        If it cannot be read, is another folder's, or a part is not as it lists it.
    OSError
        If it is not there.
    """
    data = (home / NAME).read_bytes()
    try:
        found = json.loads(data)
        manifest = Manifest(
            found["of"], int(found["number"]), hashlib.sha256(data).hexdigest(), str(found["previous"] or "")
        )
        manifest.own = entries_in(found["files"])
        listed = entries_in(found["parts"])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise damaged(home, NAME, "cannot be read") from error
    own = own or home.relative_to(root_of(home)).as_posix()
    if manifest.home != own:
        raise FolderCopiedError(
            f"The folder {own} is a copy of {str(manifest.home)[:40]}: its manifest names that folder.", file=NAME
        )
    for name, entry in listed.items():
        if entry is None:
            continue
        if known is not None and name in known.parts and known.parts[name][0] == entry:
            manifest.parts[name] = known.parts[name]
            continue
        content = _content(home, name)
        if hashlib.sha256(content).hexdigest() != entry.sha256:
            raise damaged(home, name, "does not match its checksum")
        try:
            manifest.parts[name] = entry, entries_in(json.loads(content)["files"])
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise damaged(home, name, "cannot be read") from error
    return manifest


class FolderCopiedError(DamagedError):
    """A folder was copied or renamed by hand."""

    code = "folder_copied"
    remedy = "Remove the copy, or give it its old name; 'stereorig bundle' takes a test elsewhere."


def _content(home: Path, name: str) -> bytes:
    try:
        return (home / name).read_bytes()
    except FileNotFoundError as error:
        raise lost(home, name) from error


def entries_in(found: Mapping[str, Any]) -> Entries:
    """Return entries as they were written.

    Raises
    ------
    ValueError
        A name is none that a manifest lists: no other ever becomes a path.
    """
    foreign = [name for name in found if _LISTED.fullmatch(name) is None and _PART.fullmatch(name) is None]
    if foreign:
        raise ValueError(f"{foreign[0][:80]!r} is no name of a file of data")
    return {
        name: None if one is None else Listed(int(one["bytes"]), str(one["sha256"]), bool(one.get("adopted")))
        for name, one in found.items()
    }


def differs_from(manifest: Manifest, anchor: tuple[int, str] | None) -> str | None:
    """Return why a manifest is not the newest one on record, or does not follow it; None: it is, or does."""
    if anchor is None:
        return None
    number, sha256 = anchor
    if manifest.number < number:
        return f"is an older one: number {manifest.number}, and {number} was written"
    if (manifest.number == number and manifest.sha256 != sha256) or (
        manifest.number == number + 1 and manifest.previous != sha256
    ):
        return "is not the one that was written"
    return None


# comparing -----------------------------------------------------------------------------------------------------------


def lost(home: Path, name: str) -> DamagedError:
    """Return the error for a file that was there and is gone."""
    return DamagedError(
        f"{Path(name).name} of {_subject(home, name)} is gone.",
        code="file_missing",
        remedy="Restore the file from a backup; nothing else is touched.",
        file=_file(home, name),
    )


def damaged(home: Path, name: str, reason: str = "does not match its checksum") -> DamagedError:
    """Return the error for a file that is not as it was written."""
    return DamagedError(f"{Path(name).name} of {_subject(home, name)} {reason}.", file=_file(home, name))


def _file(home: Path, name: str) -> str:
    """Return a file's path in its test, or in the data folder."""
    return name if home.parent.name == "tests" else (home.relative_to(root_of(home)) / name).as_posix()


def _subject(home: Path, name: str) -> str:
    kinds = {"steps": "step", "analyses": "analysis", "models": "model"}
    parts = name.split("/")
    inner = f"{kinds[parts[0]]} {parts[1].lstrip('0') or '0'} of " if parts[0] in kinds and len(parts) > 2 else ""
    return f"{inner}{home.parent.name.removesuffix('s')} {home.name}" if home.name != "recipes" else "the recipes"


def listed_in(path: Path) -> Listed | None:
    """Return the entry of a file, from its manifest or the document that lists it; None if neither does.

    Raises
    ------
    DamagedError
        For a damaged manifest, see :meth:`KnownManifests.load`, or a damaged document that lists the file;
        ``checksum_mismatch`` for a file that a manifest ought to list and does not.
    """
    place = place_of(path)
    manifest = None if place is None else kept.load(place[0])
    if place is None or manifest is None:
        return None
    home, name = place
    found = manifest.get(name)
    if found is not None or name == NAME or name in manifest.parts:
        return found
    for pattern, document, key in _LISTING:
        match = pattern.fullmatch(name)
        if match is not None and manifest.get(match.expand(document)) is not None:
            return _listed_by(home / match.expand(document), match.expand(key), path)
    if is_listed_kind(name) and not is_of_a_worker(name) and path.exists():
        raise damaged(home, name, "is not in the manifest")
    return None


def _listed_by(document: Path, key: str, path: Path) -> Listed | None:
    """Return the entry of a file that a document lists: by camera, by name, or in a list of views or frames."""
    found = json.loads(checked_bytes(document))
    listed = found.get("sha256") or found.get("files") or {}
    sha256 = listed.get(key) if isinstance(listed, dict) else None
    taken = found.get("views") or found.get("frames")
    for one in taken if isinstance(taken, list) else ():
        if isinstance(one, dict) and one.get("file") == key:
            sha256 = one.get("sha256")
    if not isinstance(sha256, str):
        return None
    return Listed(path.stat().st_size if path.exists() else 0, sha256)


def is_there(path: Path) -> bool:
    """Return True if a file is there.

    Raises
    ------
    DamagedError
        ``file_missing`` if it is gone and was there.
    """
    if path.is_file():
        return True
    for _ in _patiently(path):
        place, listed = place_of(path), listed_in(path)
        if path.is_file():
            return True
        if place is None or listed is None:
            return False
    assert place is not None
    raise lost(*place)


def _patiently(path: Path) -> Iterator[None]:
    """Yield until a change of a file that is under way is over: between, the file and its entry may disagree."""
    place = place_of(path)
    for attempt in range(_TRIES):
        yield
        if place is None:
            return
        if root_of(place[0]) in kept.owned:
            with kept.lock(place[0]):
                pass
        elif attempt < _TRIES - 1:
            time.sleep(_PAUSE_S)


def _checked(path: Path, read: Callable[[], tuple[Any, str]]) -> Any:
    """Return the file's content after comparing its SHA-256 with its entry, or its ``.sha256`` file if unlisted."""
    for _ in _patiently(path):
        listed = listed_in(path)
        try:
            content, sha256 = read()
        except FileNotFoundError:
            if not is_there(path):
                raise
            continue
        recorded = listed.sha256 if listed is not None else recorded_sha256(path)
        if recorded is None or sha256 == recorded:
            if listed is not None:
                _check_beside(path)
            return content
    place = place_of(path)
    raise damaged(*(place or (path.parent, path.name)))


def _check_beside(path: Path) -> None:
    """Raise an error if a file's ``.sha256`` file is missing or was changed."""
    place = place_of(path)
    manifest = None if place is None else kept.load(place[0])
    if place is not None and manifest is not None and manifest.get(f"{place[1]}.sha256") is not None:
        checked_bytes(checksum_file(path))


def checked_bytes(path: Path) -> bytes:
    """Return the content of a file, which is as it was written.

    Raises
    ------
    DamagedError
        ``checksum_mismatch``, ``file_missing`` or ``folder_copied``, naming the file.
    FileNotFoundError
        If it was never there.
    """

    def read() -> tuple[bytes, str]:
        data = path.read_bytes()
        return data, hashlib.sha256(data).hexdigest()

    found: bytes = _checked(path, read)
    return found


def require_sound(path: Path, *, just_read: bool = False) -> None:
    """Raise an error for a file that is not as it was written, see :func:`checked_bytes`; it is read in pieces.

    Parameters
    ----------
    just_read
        Believe a comparison of this file by this process some seconds ago, if the file was not touched since: for
        callers that open it by its path right after.
    """
    if place_of(path) is None and recorded_sha256(path) is None:
        return
    stamp = _stamp(path) if path.exists() else ()
    known = _just_read.get(path)
    if just_read and known is not None and known[0] == stamp and time.monotonic() - known[1] < _JUST_S:
        return
    _checked(path, lambda: (None, sha256_of(path)))
    if len(_just_read) >= _MOST_READ:
        _just_read.clear()
    _just_read[path] = stamp, time.monotonic()


_JUST_S, _MOST_READ = 10.0, 20_000
_just_read: dict[Path, tuple[tuple[int, ...], float]] = {}


def known_sha256(path: Path) -> str:
    """Return the SHA-256 that a file must have; of one that is listed nowhere, the one that it has."""
    listed = listed_in(path)
    return sha256_of(path) if listed is None else listed.sha256
