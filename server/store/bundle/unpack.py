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
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from stereorig.core.errors import FileFormatError, StateError, StereorigError, StorageError
from stereorig.server.cell import images, models
from stereorig.server.cell.cell import Cell
from stereorig.server.cell.sandbox import ReadingLimits, end_at_opening
from stereorig.server.formats import disk as _disk
from stereorig.server.formats.calibrations.recognise import parse_calibration
from stereorig.server.formats.files import fsync_path, storage_error
from stereorig.server.formats.hdf5_parts import require_own_parts
from stereorig.server.formats.images import decode_image, decode_mask
from stereorig.server.formats.manifest import NAME
from stereorig.server.formats.results.netcdf import opened
from stereorig.server.store.bundle.content import FORMAT, MANIFEST, BundleFile, Contents, altered, check_names, refused
from stereorig.server.store.durable import record_of
from stereorig.server.store.folder import STAGING, DataFolder
from stereorig.server.store.indexing.build import reindex
from stereorig.server.store.manifests import Manifests
from stereorig.server.store.trash import Trash
from stereorig.server.store.verify import verify_test

_CHUNK_BYTES = 1 << 20
_BYTES_A_SECOND = 4 << 20  # are read at the least
#: texts are deflated, and the rest is stored: a member that grows more was made to fill disks or memory
_MAX_GROWTH, _SMALL_BYTES, _MAX_TEXT_BYTES = 200, 1 << 20, 512 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1
_SUMMARY = "/summary.json"


@dataclass(frozen=True)
class OpenedTest:
    """A test that a bundle brought into a data folder."""

    test_id: str
    files: int
    bytes: int


def unpack(bundle: Path, data: Path, *, cell: Cell | None = None) -> OpenedTest:
    """Bring the test of a bundle into a data folder, which is made if it is missing.

    All of it is read in a cell first: archive, images, results, calibrations.

    Parameters
    ----------
    cell
        A cell that is running, and stays; None: a new one for this bundle.

    Raises
    ------
    FileFormatError
        ``bundle_unreadable`` for no archive, or one that was cut short; ``bundle_newer``; ``bundle_altered`` if a file
        is not as the manifest or the test states it; ``bundle_refused`` for names, sizes or methods that no version of
        this program writes; ``file_harmful``.
    TooLargeError
        ``file_too_large``.
    StateError
        ``test_exists`` if the test is there, or in the trash; ``data_folder_locked`` if a service runs there.
    StorageError
        ``storage_full`` or ``storage_failed``. In every case the test is there whole, or not at all.
    """
    with contextlib.closing(Cell()) if cell is None else contextlib.nullcontext(cell) as reading:
        manifest = _inspected(bundle, reading)
    new = not data.exists()
    folder = DataFolder(data).open()
    try:
        _check_place(folder, manifest)
        staging = folder.root / f"{STAGING}{secrets.token_hex(4)}.part"
        try:
            with bundle.open("rb") as file, _archive(file, bundle.name) as archive:
                _extract(archive, manifest, staging)
            _check_test(staging, manifest)
            test = Path("tests", manifest.test_id)
            if not (staging / test / NAME).is_file():  # of a version before there were manifests
                Manifests(staging).settle(staging / test, adopt=True)
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
    return OpenedTest(manifest.test_id, len(manifest.files), sum(one.bytes for one in manifest.files.values()))


def _inspected(bundle: Path, cell: Cell) -> Contents:
    """Return the manifest of a bundle that is as it was written, and so is each of its files."""
    if not bundle.is_file() or not os.access(bundle, os.R_OK):
        raise FileFormatError(f"{bundle} is no file that can be read.", code="file_missing", remedy="Check the path.")
    size = bundle.stat().st_size
    cpu_s = 60 + size // _BYTES_A_SECOND
    limits = ReadingLimits(memory_bytes=(2 << 30) + 2 * size, cpu_s=cpu_s, wall_s=15.0 * cpu_s)
    found = cell.read(_inspect, [bundle], bundle.name, size, of="the bundle", limits=limits)
    manifest = record_of(Contents, found, Path(MANIFEST))
    for name in manifest.files:
        if name.endswith(".nc"):
            cell.read(_inspect_result, [bundle], bundle.name, name, of=name, limits=limits)
    return manifest


def warm_up() -> None:
    """Load the parts of the libraries that they load with their first file only."""
    images.warm_up()
    models.warm_up()


def _inspect(files: list[BinaryIO], bundle: str, size: int) -> dict[str, object]:
    with _archive(files[0], bundle) as archive:
        manifest = _manifest(archive, bundle, size)
        for name, stated in manifest.files.items():
            held = _content(archive, name, stated)
            read = next((read for ending, read in _READERS.items() if PurePosixPath(name).match(ending)), None)
            if read is None:
                for _ in held:
                    pass
                continue
            try:
                read(b"".join(held), name)
            except StereorigError as error:
                raise altered(f"{name}: {error.cause}", file=name) from error
    return manifest.plain()


def _inspect_result(files: list[BinaryIO], bundle: str, name: str) -> None:
    with _archive(files[0], bundle) as archive:
        content = archive.read(name)
    require_own_parts(Path(name), content)
    with opened(Path(name), content) as data:
        end_at_opening()
        for variable in data.variables.values():
            try:
                variable[...]
            except (OSError, RuntimeError, ValueError) as error:
                raise altered(f"{name} cannot be read as a result file", file=name) from error


_READERS: dict[str, Callable[[bytes, str], object]] = {
    "steps/*/*.tif": lambda content, name: decode_image(content, name=name),
    "analyses/*/mask.png": lambda content, name: decode_mask(content, name=name),
    "calibration.json": lambda content, name: parse_calibration(content, name=name),
    "calibrations/*.json": lambda content, name: parse_calibration(content, name=name),
}


@contextlib.contextmanager
def _archive(bundle: BinaryIO, name: str) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(bundle) as archive:
            yield archive
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise FileFormatError(
            f"{name} cannot be read as a bundle: {error}.",
            code="bundle_unreadable",
            remedy="It was cut short or altered on its way: copy it again; nothing was opened.",
            file=name,
        ) from error


def _manifest(archive: zipfile.ZipFile, bundle: str, size: int) -> Contents:
    """Return the manifest, after all checks that need no reading of the files."""
    members = archive.infolist()
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
            file=bundle,
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
        manifest = record_of(Contents, document, Path(MANIFEST))
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


def _check_place(folder: DataFolder, manifest: Contents) -> None:
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


def _extract(archive: zipfile.ZipFile, manifest: Contents, staging: Path) -> None:
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


def _check_test(staging: Path, manifest: Contents) -> None:
    """Refuse a bundle that matches its manifest but is inconsistent as a test."""
    test_id = manifest.test_id
    try:
        documents = {
            name: json.loads((staging / name).read_bytes()) for name in manifest.files if name.endswith(_SUMMARY)
        }
        cut = [name for name, document in documents.items() if not isinstance(document.get("steps"), list)]
        found = [one for one in verify_test(staging, test_id).findings if one.level in ("damaged", "foreign")]
        stated = json.loads((staging / "tests" / test_id / "test.json").read_bytes()).get("id")
    except (ValueError, AttributeError, TypeError, KeyError, RecursionError) as error:
        raise altered(f"its documents cannot be read ({type(error).__name__})") from error
    if cut:
        raise altered(f"{cut[0]} has no steps", file=cut[0])
    if found:
        raise altered(f"{found[0].path}: {found[0].text}", file=found[0].path)
    if stated != test_id:
        raise altered(f"its test.json is of {str(stated)[:40]!r}, not of {test_id}", file="test.json")
