"""Writing of the manifests: every file in a data folder is listed before it is shown.

A document is written under a temporary name; then the manifest that lists it; then it gets its real name. Killed
between the last two, the next start finishes the renaming. A step, and a worker's files, are listed once they are
whole: a file that a kill left unlisted was never acknowledged, and is listed at the next start if it matches its own
checksums.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from stereorig.core.errors import FileFormatError, StorageError
from stereorig.core.names import CAMERAS
from stereorig.server.formats import disk as _disk
from stereorig.server.formats import files
from stereorig.server.formats.files import checksum_file, fsync_path, recorded_sha256, sha256_of, storage_error
from stereorig.server.formats.manifest import (
    FORMAT,
    NAME,
    PARTS,
    Entries,
    Listed,
    Manifest,
    is_listed_kind,
    is_of_a_worker,
    kept,
    place_of,
    read_manifest,
    root_of,
)
from stereorig.server.store.durable import json_bytes

#: entries that a manifest holds itself; more of them become a part
_OWN = 128
#: parts before they are made one
_PARTS = 32
_RESULT_PARTS = 3


@dataclass
class ListedNumbers:
    """Numbers of the steps, and of the results of each analysis, that a test's manifest lists."""

    of: Manifest
    steps: dict[int, None] = field(default_factory=dict)
    results: dict[str, dict[int, None]] = field(default_factory=dict)

    def take(self, entries: Mapping[str, Listed | None]) -> None:
        """Add entries; None removes one."""
        for name, listed in entries.items():
            parts = name.split("/")
            if parts[-1] == "step.json":
                numbers, n = self.steps, int(parts[1])
            elif len(parts) == _RESULT_PARTS and parts[-1].startswith("step_") and name.endswith(".nc"):
                held = self.results.get if listed is None else self.results.setdefault
                numbers, n = held(parts[1], {}), int(parts[-1][5:-3])
            else:
                if parts[-1] == "analysis.json" and listed is None:
                    self.results.pop(parts[1], None)
                elif parts[-1] == "analysis.json":
                    self.results.setdefault(parts[1], {})
                continue
            if listed is None:
                numbers.pop(n, None)
            else:
                numbers[n] = None


class Manifests:
    """The manifests of one data folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._numbers: dict[Path, ListedNumbers] = {}
        #: numbers and checksums of manifests that were written and are not on record elsewhere yet, by their folders
        self.unsettled: dict[str, tuple[int, str]] = {}

    # reading -----------------------------------------------------------------------------------------------------

    def numbers(self, home: Path) -> ListedNumbers | None:
        """Return the numbers that a test's manifest lists; None if it has none, as before there were manifests."""
        manifest = kept.load(home)
        if manifest is None:
            return None
        known = self._numbers.get(home)
        if known is None or known.of is not manifest:
            known = ListedNumbers(manifest)
            known.take(dict(manifest.files()))
            self._numbers[home] = known
        return known

    # writing -----------------------------------------------------------------------------------------------------

    def write_json(self, path: Path, document: Any, *, checksum: bool = False) -> str:
        """Write a JSON document durably, see :meth:`write`; NaN becomes null."""
        return self.write(path, json_bytes(document), checksum=checksum)

    def write(self, path: Path, data: bytes, *, checksum: bool = False) -> str:
        """Write a file durably and list it, with its ``.sha256`` file if wanted; return its SHA-256 in hex.

        Raises
        ------
        StorageError
            ``storage_full`` or ``storage_failed``; then the file and its entry are as they were.
        DamagedError
            If the manifest is not the one that was written last.
        """
        place, sha256 = place_of(path), hashlib.sha256(data).hexdigest()
        if place is None:
            files.write_bytes(path, data, checksum=checksum)
            return sha256
        home, name = place
        entries: Entries = {name: Listed(len(data), sha256)}
        beside = f"{sha256}  {path.name}\n".encode()
        if checksum:
            entries[f"{name}.sha256"] = Listed(len(beside), hashlib.sha256(beside).hexdigest())
        temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
        with kept.lock(home):
            before = self._current(home)
            try:
                _disk.disk.write(temporary, data)
                fsync_path(temporary)
                if checksum:
                    files.write_bytes(checksum_file(path), beside)
                else:
                    fsync_path(path.parent)
                self.put(home, entries)
                _disk.disk.replace(temporary, path)
                fsync_path(path.parent)
            except (OSError, StorageError) as error:
                if temporary.exists():  # else all of it is there, though perhaps not durable
                    self._take_back(home, before, entries, temporary)
                raise error if isinstance(error, StorageError) else storage_error(error, path) from error
        return sha256

    def _take_back(self, home: Path, before: Manifest, entries: Entries, temporary: Path) -> None:
        """List the former entries again; if the disk prevents it, leave the renaming to the next start."""
        now = self._current(home)
        if now.sha256 != before.sha256:
            old = {name: before.get(name) for name in entries}
            try:
                self.put(home, old)
            except StorageError:
                kept.put(home, _with(now, old, number=now.number, sha256=now.sha256))
                self._numbers.pop(home, None)
                return
        temporary.unlink(missing_ok=True)

    def put(self, home: Path, entries: Mapping[str, Listed | None], *, adopt: bool = False) -> None:
        """List files, or list them no longer (None); durable when this returns.

        Parameters
        ----------
        adopt
            Make a manifest of the files in the folder, though files may be missing.

        Raises
        ------
        StorageError
            ``storage_full`` or ``storage_failed``; then the entries are as they were.
        """
        with kept.lock(home):
            old = self._current(home, adopt=adopt)
            new = _with(old, entries, number=old.number + 1, previous=old.sha256)
            left = self._divide(home, new) if len(new.own) > _OWN else []
            data = _text(new)
            new.sha256 = hashlib.sha256(data).hexdigest()
            try:
                files.write_bytes(home / NAME, data)
            except StorageError:
                if (home / NAME).is_file() and sha256_of(home / NAME) == new.sha256:  # not durable, yet there
                    kept.put(home, replace(_with(old, {}, number=new.number, sha256=new.sha256), ahead=True))
                raise
            kept.put(home, new)
            kept.anchors[home] = self.unsettled[new.home] = new.number, new.sha256
            numbers = self._numbers.get(home)
            if numbers is not None and numbers.of is old:
                numbers.take(entries)
                numbers.of = new
            for part in left:
                (home / part).unlink(missing_ok=True)

    def _current(self, home: Path, *, adopt: bool = False) -> Manifest:
        """Return the manifest; for a folder from before there were manifests, make one of its files."""
        found = None if adopt else kept.load(home)
        if found is None:
            found = Manifest(home.relative_to(root_of(home)).as_posix())
            found.own.update(entries_there(home))
        return found

    def _divide(self, home: Path, manifest: Manifest) -> list[str]:
        """Move the entries of a manifest into a part; return the parts that it replaces."""
        if not (home / PARTS).is_dir():
            _disk.disk.make_folder(home / PARTS)
            fsync_path(home)
        left: list[str] = []
        entries: Entries = manifest.own
        if len(manifest.parts) >= _PARTS:
            left, entries = list(manifest.parts), dict(manifest.files())
            manifest.parts = {}
        data = f'{{"files": {_lines(entries)}}}\n'.encode()
        name = f"{PARTS}/{manifest.number:08d}.json"
        files.write_bytes(home / name, data)
        manifest.parts[name] = Listed(len(data), hashlib.sha256(data).hexdigest()), entries
        manifest.own = {}
        return left

    def take_over(self, home: Path, paths: Iterable[Path], more: Mapping[Path, Listed] | None = None) -> None:
        """List files that a worker wrote, by the checksums that it made of them; and ``more`` by their entries."""
        entries: Entries = {path.relative_to(home).as_posix(): one for path, one in (more or {}).items()}
        for path in paths:
            entries |= _entries_of(home, path, adopted=False)
        self.put(home, entries)

    def strike(self, home: Path, names: Iterable[str]) -> None:
        """List files no longer, which are removed or replaced next."""
        self.change(home, dict.fromkeys(names))

    def change(self, home: Path, entries: Mapping[str, Listed | None]) -> None:
        """List files as these entries state, if they are not listed so, in a folder that has a manifest."""
        manifest = kept.load(home)
        found = {} if manifest is None else {name: one for name, one in entries.items() if manifest.get(name) != one}
        if found or (manifest is not None and manifest.ahead):
            self.put(home, found)

    def replace(self, home: Path, names: Iterable[str], paths: Iterable[Path]) -> None:
        """List files no longer, and others that are there instead."""
        entries: Entries = dict.fromkeys(names)
        for path in paths:
            entries |= _entries_of(home, path, adopted=False)
        self.put(home, entries)

    def under(self, home: Path, folder: str) -> list[str]:
        """Return the names that the manifest lists below a folder, of a folder that has one."""
        manifest = kept.load(home)
        return [] if manifest is None else [name for name in manifest.files() if name.startswith(f"{folder}/")]

    def plain(self, home: Path, names: Iterable[str]) -> dict[str, object]:
        """Return the entries of files as they are written."""
        manifest = kept.load(home)
        found = {} if manifest is None else {name: manifest.get(name) for name in names}
        return {name: listed.plain() for name, listed in found.items() if listed is not None}

    # after an end at any instant -------------------------------------------------------------------------------------

    def settle(self, home: Path, *, adopt: bool = False) -> None:
        """Repair the traces of an end at any instant in a folder; nothing may write there at the same time.

        A renaming that the manifest announced is finished, other temporary files are removed, and whole files that are
        not listed are listed: all of them in a folder that was made before there were manifests, or with ``adopt``.
        """
        finish_renaming(home)
        if not _is_ours(home):
            return
        with contextlib.suppress(FileFormatError):  # one that is damaged is named when it is read
            manifest = None if adopt else kept.load(home)
            if manifest is None:
                self.put(home, {}, adopt=True)
            elif found := entries_there(home, manifest):
                self.put(home, found)


def is_listed_on_disk(path: Path) -> bool:
    """Return True if the manifest on the disk lists a file; the one in memory may differ."""
    place = place_of(path)
    try:
        return place is not None and read_manifest(place[0]).get(place[1]) is not None
    except (FileFormatError, OSError):
        return False


def finish_renaming(folder: Path, *, beside: Set[Path] = frozenset()) -> None:
    """Give the temporary files below a folder their names if the manifest lists them so; remove the others.

    Nothing may write there at the same time. The folders in ``beside`` are not touched.
    """
    left = {str(path) for path in beside}
    for where, folders, names in os.walk(folder):  # rglob takes twice as long
        folders[:] = [name for name in folders if os.path.join(where, name) not in left]  # noqa: PTH118
        for name in names:
            if name.startswith(".") and name.endswith(".part"):
                _finish(Path(where, name))


def _finish(part: Path) -> None:
    target = part.with_name(part.name[1:].rsplit(".", 2)[0])
    place = place_of(target)
    with contextlib.suppress(FileFormatError, OSError):
        listed = None if place is None else read_manifest(place[0]).get(place[1])
        if listed is not None and sha256_of(part) == listed.sha256:
            _disk.disk.replace(part, target)
            fsync_path(target.parent)
            return
    part.unlink(missing_ok=True)


def _with(
    old: Manifest, entries: Mapping[str, Listed | None], *, number: int, sha256: str = "", previous: str = ""
) -> Manifest:
    """Return a manifest with other entries; a name that no part has needs no mark that it is gone."""
    new = Manifest(old.home, number, sha256, previous, own={**old.own, **entries}, parts=dict(old.parts))
    for name in [name for name, listed in entries.items() if listed is None]:
        if not any(name in part for _, part in new.parts.values()):
            del new.own[name]
    return new


def _lines(entries: Mapping[str, Listed | None]) -> str:
    lines = (f"{json.dumps(n)}: {json.dumps(None if one is None else one.plain())}" for n, one in entries.items())
    return "{" + ",\n ".join(lines) + "}"


def _text(manifest: Manifest) -> bytes:
    head = {"format": FORMAT, "of": manifest.home, "number": manifest.number, "previous": manifest.previous or None}
    parts = _lines({name: listed for name, (listed, _) in manifest.parts.items()})
    return f'{json.dumps(head)[:-1]},\n"parts": {parts},\n"files": {_lines(manifest.own)}}}\n'.encode()


# files in the folder -------------------------------------------------------------------------------------------------


def _is_ours(home: Path) -> bool:
    return home.name == "recipes" or any(
        (home / mark).is_file() for mark in ("test.json", "plan.json", "certificate.json")
    )


def files_in(home: Path) -> list[str]:
    """Return the names of the files in a folder that its manifest lists, or would list."""
    found = []
    for where, folders, names in os.walk(home):
        inner = where[len(str(home)) + 1 :]
        if inner.split("/")[0] in (PARTS, "views", "frames", "exports"):
            folders.clear()
        found += [name for n in names if is_listed_kind(name := f"{inner}/{n}" if inner else n)]
    return sorted(found)


def entries_there(home: Path, manifest: Manifest | None = None) -> Entries:
    """Return entries of unlisted files, by the checksums on record; none of half a step or result."""
    entries: Entries = {}
    for name in files_in(home) if home.is_dir() else ():
        path = home / name
        if manifest is not None and (manifest.get(name) is not None or not _is_whole(path, name)):
            continue
        if path.suffix != ".sha256":
            entries |= _entries_of(home, path, adopted=True)
    return entries


def _is_whole(path: Path, name: str) -> bool:
    """Return True if an unlisted file is whole, by its own checksums."""
    if path.name == "step.json":
        try:
            found = json.loads(path.read_bytes())
            same = all(sha256_of(path.with_name(f"{cam}.tif")) == found["sha256"][cam] for cam in CAMERAS)
            return same and found["n"] == int(path.parent.name)  # else it was copied by hand
        except (OSError, ValueError, KeyError, TypeError):
            return False
    if is_of_a_worker(name) and path.suffix == ".nc":
        return recorded_sha256(path) == sha256_of(path)
    if path.name.startswith("step_") and path.suffix == ".json":
        return path.with_suffix(".nc").is_file()
    return True


def _entries_of(home: Path, path: Path, *, adopted: bool) -> Entries:
    """Return the entry of a file and of its ``.sha256`` file."""
    name, beside = path.relative_to(home).as_posix(), checksum_file(path)
    recorded = recorded_sha256(path) or _recorded_in(home, name)
    lacks = (adopted and recorded is None and path.suffix not in (".json", ".deleted")) or name == "calibration.json"
    entries: Entries = {
        name: Listed(path.stat().st_size, recorded or sha256_of(path), adopted=lacks and adopted and recorded is None)
    }
    if beside.is_file():
        entries[f"{name}.sha256"] = Listed(beside.stat().st_size, sha256_of(beside))
    return entries


def _recorded_in(home: Path, name: str) -> str | None:
    """Return a file's checksum from a document of its test or analysis; None if no document has it."""
    if name.startswith("calibrations/"):
        return Path(name).stem
    document, key = (home / "test.json", "calibration_sha256") if name == "calibration.json" else (None, "")
    if name.endswith("/mask.png"):
        document, key = (home / name).with_name("analysis.json"), "mask_sha256"
    try:
        known = None if document is None else json.loads(document.read_bytes())
    except (OSError, ValueError):
        return None
    found = known.get(key) if isinstance(known, dict) else None
    if name == "calibration.json" and isinstance(known, dict):
        given = [
            one for one in known.get("calibrations") or {} if not (home / "calibrations" / f"{one}.json").is_file()
        ]
        found = given[0] if len(given) == 1 else None if (home / "calibrations" / f"{found}.json").is_file() else found
    return found if isinstance(found, str) else None
