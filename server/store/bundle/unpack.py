"""Opening of a bundle into a data folder: checked whole first, shown whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from core.errors import FileFormatError, StateError, StorageError
from server.formats import disk as _disk
from server.formats.files import fsync_path, storage_error
from server.store.bundle.content import FORMAT, MANIFEST, BundleFile, Manifest, altered, check_names, refused
from server.store.durable import record_of
from server.store.folder import STAGING, DataFolder
from server.store.indexing.build import reindex
from server.store.trash import Trash
from server.store.verify import verify_test

_CHUNK_BYTES = 1 << 20
#: texts are deflated, and the rest is stored: what grows more was made to fill disks or memory
_MAX_GROWTH, _SMALL_BYTES, _MAX_TEXT_BYTES = 200, 1 << 20, 512 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1


@dataclass(frozen=True)
class Opened:
    """A test that a bundle brought into a data folder."""

    test_id: str
    files: int
    bytes: int


def unpack(bundle: Path, data: Path) -> Opened:
    """Bring the test of a bundle into a data folder, which is made where there is none.

    Raises
    ------
    FileFormatError
        ``bundle_unreadable`` for no archive, or one that was cut short; ``bundle_newer``; ``bundle_altered`` if a file
        is not as the manifest or the test states it; ``bundle_refused`` for names, sizes or methods that no version of
        this program writes.
    StateError
        ``test_exists`` if the test is there, or in the trash; ``data_folder_locked`` if a service runs there.
    StorageError
        ``storage_full`` or ``storage_failed``. In every case the test is there whole, or not at all.
    """
    with _archive(bundle) as archive:
        manifest = _manifest(archive, bundle)
        for name, stated in manifest.files.items():
            for _ in _content(archive, name, stated):
                pass
    new = not data.exists()
    folder = DataFolder(data).open()
    try:
        _check_place(folder, manifest)
        staging = folder.root / f"{STAGING}{secrets.token_hex(4)}.part"
        try:
            with _archive(bundle) as archive:
                _extract(archive, manifest, staging)
            _check_test(staging, manifest.test_id)
            test = Path("tests", manifest.test_id)
            _disk.disk.replace(staging / test, folder.root / test)
            new = False
            fsync_path(folder.tests)
        except OSError as error:
            raise storage_error(error, folder.root) from error
        finally:
            shutil.rmtree(staging, ignore_errors=True)
        reindex(folder, believe=True)
    finally:
        folder.close()
        if new:
            shutil.rmtree(data, ignore_errors=True)
    return Opened(manifest.test_id, len(manifest.files), sum(one.bytes for one in manifest.files.values()))


@contextlib.contextmanager
def _archive(bundle: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(bundle) as archive:
            yield archive
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        if bundle.is_file() and os.access(bundle, os.R_OK):
            raise  # of the data folder
        raise FileFormatError(
            f"{bundle} is no file that can be read.", code="file_missing", remedy="Check the path."
        ) from error
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise FileFormatError(
            f"{bundle} cannot be read as a bundle: {error}.",
            code="bundle_unreadable",
            remedy="It was cut short or altered on its way: copy it again; nothing was opened.",
            file=bundle.name,
        ) from error


def _manifest(archive: zipfile.ZipFile, bundle: Path) -> Manifest:
    """Return the manifest, after everything that can be said without reading the files."""
    members = archive.infolist()
    size = bundle.stat().st_size
    packed = sum(one.compress_size for one in members)
    if packed > size:
        raise refused(f"its members take {packed} bytes in a file of {size}: they overlap")
    for one in members:
        name = one.filename[:120]
        if one.flag_bits & _ENCRYPTED or one.compress_type not in _METHODS:
            raise refused(f"{name!r} is encrypted or packed by a method that is not used", file=name)
        most = min(_MAX_GROWTH * one.compress_size + _SMALL_BYTES, _MAX_TEXT_BYTES)
        if one.compress_type != zipfile.ZIP_STORED and one.file_size > most:
            raise refused(f"{one.compress_size} bytes of {name!r} would become {one.file_size}", file=name)
    names = [one.filename for one in members]
    if MANIFEST not in names:
        raise FileFormatError(
            f"{bundle} has no {MANIFEST}.",
            code="bundle_unreadable",
            remedy="Give a file that 'stereorig bundle' wrote.",
            file=bundle.name,
        )
    try:
        document = json.loads(archive.read(MANIFEST))
        found = document.get("format")
    except (ValueError, AttributeError, RecursionError) as error:
        raise altered(f"{MANIFEST} cannot be read as a JSON object", file=MANIFEST) from error
    if not isinstance(found, int) or isinstance(found, bool) or found > FORMAT:
        raise FileFormatError(
            f"The bundle has format {str(found)[:40]}, this version reads up to {FORMAT}.",
            code="bundle_newer",
            remedy="Use the version that wrote it, or a newer one.",
        )
    try:
        manifest = record_of(Manifest, document, Path(MANIFEST))
    except FileFormatError as error:
        raise altered(error.cause.rstrip("."), file=MANIFEST) from error
    check_names(manifest, names)
    return manifest


def _content(archive: zipfile.ZipFile, name: str, stated: BundleFile) -> Iterator[bytes]:
    """Yield the content of a file; the last piece only once all of it matches the manifest."""
    if archive.getinfo(name).file_size != stated.bytes:
        raise altered(f"{name} has {archive.getinfo(name).file_size} bytes, not {stated.bytes}", file=name)
    digest, size = hashlib.sha256(), 0
    with archive.open(name) as source:
        while chunk := source.read(_CHUNK_BYTES):
            digest.update(chunk)
            size += len(chunk)
            if size > stated.bytes:
                raise altered(f"{name} has more than {stated.bytes} bytes", file=name)
            yield chunk
    if size != stated.bytes or digest.hexdigest() != stated.sha256:
        raise altered(f"{name} does not match its checksum", file=name)


def _check_place(folder: DataFolder, manifest: Manifest) -> None:
    trash = Trash(folder.root)
    deleted = {entry.test_id for entry in trash.entries() if entry.kind == "test"}
    if (folder.tests / manifest.test_id).exists() or manifest.test_id in deleted:
        where = "in the trash of" if manifest.test_id in deleted else "in"
        raise StateError(
            f"Test {manifest.test_id} is {where} {folder.root} already.",
            code="test_exists",
            remedy="Open the bundle in another data folder, or delete the test for good first.",
        )
    whole = sum(one.bytes for one in manifest.files.values())
    if whole > folder.free_mib() * 2**20:
        raise StorageError(
            f"The bundle's {whole / 2**20:.0f} MiB do not fit into the {folder.free_mib():.0f} MiB that are left.",
            code="storage_full",
            remedy="Free space on that disk, or give a data folder on another one.",
        )


def _extract(archive: zipfile.ZipFile, manifest: Manifest, staging: Path) -> None:
    folders = {staging}
    _disk.disk.make_folder(staging)
    for name in ("steps", "analyses"):
        _make(staging / "tests" / manifest.test_id / name, folders)
    for name, stated in manifest.files.items():
        path = staging / name
        _make(path.parent, folders)
        _disk.disk.write(path, b"".join(_content(archive, name, stated)))
        fsync_path(path)
    for folder in sorted(folders, reverse=True):
        fsync_path(folder)


def _make(folder: Path, known: set[Path]) -> None:
    if folder not in known:
        _make(folder.parent, known)
        _disk.disk.make_folder(folder)
        known.add(folder)


def _check_test(staging: Path, test_id: str) -> None:
    """Refuse what matches the manifest, and does not hold together as a test."""
    try:
        found = [one for one in verify_test(staging, test_id).findings if one.level in ("damaged", "foreign")]
        stated = json.loads((staging / "tests" / test_id / "test.json").read_bytes()).get("id")
    except (ValueError, AttributeError, TypeError, KeyError, RecursionError) as error:
        raise altered(f"its documents cannot be read ({type(error).__name__})") from error
    if found:
        raise altered(f"{found[0].path}: {found[0].text}", file=found[0].path)
    if stated != test_id:
        raise altered(f"its test.json is of {str(stated)[:40]!r}, not of {test_id}", file="test.json")
