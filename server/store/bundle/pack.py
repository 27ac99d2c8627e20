"""Packing of a test into one file."""

from __future__ import annotations

import hashlib
import json
import time
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

from stereorig.core.errors import FileFormatError, InputError, StateError
from stereorig.server.formats.environment import current_environment
from stereorig.server.formats.files import sha256_of, written_temporary
from stereorig.server.formats.manifest import NAME, read_manifest
from stereorig.server.formats.version import software_version
from stereorig.server.store.bundle.content import CRATE, FORMAT, MANIFEST, UNFINISHED, BundleFile, files_of
from stereorig.server.store.bundle.crate import MeasuredAnalysis, crate
from stereorig.server.store.folder import DataFolder, now_utc
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.verify import verify_test

_CHUNK_BYTES = 1 << 20
#: texts shrink to a tenth; images and results end in noise, and are stored as they are
_DEFLATED = (".json", ".deleted", ".sha256")


@dataclass(frozen=True)
class Packed:
    """A bundle that was written.

    Attributes
    ----------
    sha256
        SHA-256 of the whole file: noted elsewhere, it proves that the bundle was not changed since.
    """

    file: Path
    files: int
    bytes: int
    sha256: str


def pack(data: Path, test_id: str, out: Path, *, licence: str | None = None) -> Packed:
    """Pack a test with images, settings, calibrations and analyses into one file.

    Parameters
    ----------
    data
        The data folder; it is only read, a service may run on it.
    out
        The file to write; one that is there is not replaced.
    licence
        Address or text of the licence of the data, for the bundle's metadata.

    Raises
    ------
    NotFoundError
        There is no such test.
    FileFormatError
        ``test_damaged`` if a file does not match its checksum.
    StateError
        ``test_changed`` if the test was changed during packing: its manifest would not be of these files.
    InputError
        ``output_unusable`` if there is something at ``out``.
    StorageError
        ``storage_full`` or ``storage_failed``; then nothing is left at ``out``.
    """
    tests = TestStore(DataFolder(data))
    test = tests.path(test_id)
    if out.exists() or not out.absolute().parent.is_dir():
        cause = "is there already" if out.exists() else "would be in a folder that does not exist"
        raise InputError(f"{out} {cause}.", code="output_unusable", remedy="Give another name with -o.")
    damaged = [one for one in verify_test(data, test_id).findings if one.level == "damaged"]
    if damaged:
        raise FileFormatError(
            f"{damaged[0].path} of test {test_id}: {damaged[0].text}.",
            code="test_damaged",
            remedy="Restore the file from a backup, or delete the step or analysis; 'stereorig verify' lists all.",
            file=damaged[0].path,
        )
    written = read_manifest(test) if (test / NAME).is_file() else None
    created_utc, environment = now_utc(), current_environment()
    with written_temporary(out) as temporary, zipfile.ZipFile(temporary, "x", zipfile.ZIP_STORED) as archive:
        files: dict[str, BundleFile] = {}
        for path in files_of(test):
            name = f"tests/{test_id}/{path.relative_to(test).as_posix()}"
            try:
                files[name] = _add(archive, name, path)
            except FileNotFoundError:
                if UNFINISHED.search(name) is None:  # those go when the analysis ends
                    raise
        if written is not None and read_manifest(test).number != written.number:
            raise StateError(
                f"Test {test_id} was changed while it was packed.",
                code="test_changed",
                remedy="Wait until captures and analyses of the test have ended, then pack it again.",
            )
        manifest = {
            "format": FORMAT,
            "test_id": test_id,
            "created_utc": created_utc,
            "written_by": f"stereorig {software_version()}",
            "environment": asdict(environment),
            "files": {name: found.plain() for name, found in files.items()},
        }
        analyses = [
            MeasuredAnalysis(tests.analyses.read(test_id, one), tests.analyses.summary(test_id, one))
            for one in tests.analyses.ids(test_id)
        ]
        shown = crate(
            tests.read(test_id),
            analyses,
            files,
            created_utc=created_utc,
            software_version=software_version(),
            licence=licence,
        )
        for name, document in ((MANIFEST, manifest), (CRATE, shown)):
            text = json.dumps(document, indent=1, ensure_ascii=False).encode()
            archive.writestr(_member(name, time.time()), text)
    return Packed(out, len(files), out.stat().st_size, sha256_of(out))


def _member(name: str, modified: float) -> zipfile.ZipInfo:
    at = time.gmtime(modified)
    member = zipfile.ZipInfo(name, (max(at.tm_year, 1980), at.tm_mon, at.tm_mday, at.tm_hour, at.tm_min, at.tm_sec))
    member.compress_type = zipfile.ZIP_DEFLATED if name.endswith(_DEFLATED) else zipfile.ZIP_STORED
    member.external_attr = 0o644 << 16
    return member


def _add(archive: zipfile.ZipFile, name: str, path: Path) -> BundleFile:
    digest, size = hashlib.sha256(), 0
    with path.open("rb") as source:
        member = _member(name, path.stat().st_mtime)
        member.file_size = path.stat().st_size  # from it the archive decides on 64 bits
        with archive.open(member, "w") as target:
            while chunk := source.read(_CHUNK_BYTES):
                digest.update(chunk)
                size += len(chunk)
                target.write(chunk)
    return BundleFile(bytes=size, sha256=digest.hexdigest())
