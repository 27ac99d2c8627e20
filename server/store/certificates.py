"""Certificates on disk: a folder each with the page, and ``certificate.json`` as the last file, which makes it one.

The inputs of a certificate cannot be deleted until it is withdrawn; it is itself never changed or removed.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass

from stereorig.core.errors import FileFormatError, StateError
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.made import CertificateRecord
from stereorig.server.formats.manifest import checked_bytes, is_there
from stereorig.server.store.durable import known_json, make_folder, read_record
from stereorig.server.store.folder import DataFolder, is_id, now_utc

_DOCUMENT, _PAGE, _WITHDRAWN = "certificate.json", "certificate.html", "withdrawn.json"


@dataclass(frozen=True)
class _Base:
    """The inputs of a certificate."""

    test_id: str | None
    analysis_id: str | None
    steps: frozenset[str]

    def holds(self, kind: str, ids: Mapping[str, object]) -> bool:
        """Return True if a thing of its test is part of it."""
        match kind:
            case "test":
                return True
            case "analysis":
                return self.analysis_id == ids.get("analysis_id")
            case "step":
                return str(ids.get("n")) in self.steps
        return False


class CertificateStore:
    """The certificates of one data folder."""

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder
        self._root = folder.root / "certificates"
        # each is read once, and never changed after: its inputs are kept in memory
        self._reading = threading.Lock()
        self._known: set[str] = set()
        self._in_force: dict[str, dict[str, _Base]] = {}  # by test and certificate

    def reserve_ids(self) -> None:
        """Reserve the ids that exist, of folders that a kill left unfinished too."""
        for path in self._root.glob("v*"):
            if is_id(path.name, "v"):
                self._folder.ids.reserve(path.name)

    def ids(self) -> list[str]:
        """Ids of all certificates, in the order of their making."""
        return sorted(p.parent.name for p in self._root.glob(f"v*/{_DOCUMENT}") if is_id(p.parent.name, "v"))

    def new_id(self) -> str:
        """Return the id of a certificate that is to be made."""
        return self._folder.ids.new("v")

    def put(self, certificate_id: str, document: Mapping[str, object], page: bytes) -> None:
        """Keep a certificate; durable when this returns."""
        if not self._root.is_dir():
            make_folder(self._root)
        path = self._root / certificate_id
        make_folder(path)
        self._folder.manifests.write(path / _PAGE, page, checksum=True)
        self._folder.manifests.write_json(path / _DOCUMENT, document, checksum=True)

    def read(self, certificate_id: str) -> CertificateRecord:
        """Return a certificate.

        Raises
        ------
        NotFoundError
            If there is none with this id.
        FileFormatError
            ``checksum_mismatch`` if it is not as it was written.
        """
        path = self._root / certificate_id / _DOCUMENT
        if not is_id(certificate_id, "v") or not is_there(path):
            raise NotFoundError(f"There is no certificate {certificate_id[:40]!r}.", kind="certificate")
        return read_record(CertificateRecord, path)

    def page(self, certificate_id: str) -> bytes:
        """Return the page as it was made; raises as :meth:`read`."""
        self.read(certificate_id)
        path = self._root / certificate_id / _PAGE
        if not is_there(path):
            raise FileFormatError(
                f"The page of certificate {certificate_id} is missing.",
                code="file_missing",
                remedy="Restore it from a backup; certificate.json has all of its figures.",
            )
        return checked_bytes(path)

    def withdrawn(self, certificate_id: str) -> Mapping[str, object] | None:
        """Return when, by whom and why a certificate was withdrawn; None: it was not."""
        path = self._root / certificate_id / _WITHDRAWN
        return known_json(path) or None if is_there(path) else None

    def withdraw(self, certificate_id: str, reason: str, by: str) -> None:
        """Withdraw a certificate; it stays, and protects nothing any more.

        Raises
        ------
        StateError
            ``certificate_withdrawn`` if it was withdrawn before.
        """
        self.read(certificate_id)
        if self.withdrawn(certificate_id) is not None:
            raise StateError(
                f"Certificate {certificate_id} was withdrawn before.",
                code="certificate_withdrawn",
                remedy="Nothing is left to do.",
            )
        self._folder.manifests.write_json(
            self._root / certificate_id / _WITHDRAWN, {"utc": now_utc(), "by": by, "reason": reason}
        )

    def learn(self) -> None:
        """Read the certificates that were not read before; a service does it behind its start."""
        with self._reading:
            self._learn()

    def _learn(self) -> None:
        try:
            there = os.listdir(self._root)  # noqa: PTH208 - names, not paths
        except FileNotFoundError:
            return
        for certificate_id in sorted(name for name in there if name not in self._known and is_id(name, "v")):
            path = self._root / certificate_id / _DOCUMENT
            if not path.is_file():
                continue  # not whole yet, or never
            try:
                made_of = read_record(CertificateRecord, path).made_of
            except FileFormatError:
                continue  # `verify` reports a damaged one; it must not prevent every deletion
            self._known.add(certificate_id)
            if self.withdrawn(certificate_id) is None:
                base = _Base(made_of.test_id, made_of.analysis_id, frozenset(made_of.steps))
                self._in_force.setdefault(str(made_of.test_id), {})[certificate_id] = base

    def resting_on(self, kind: str, ids: Mapping[str, object]) -> str | None:
        """Return a certificate in force that rests on a test, step or analysis; None without one.

        It takes time for the test's own certificates and for new ones, however many the folder holds.
        """
        if kind not in ("test", "step", "analysis"):
            return None  # a test keeps its own copy of the calibration
        with self._reading:
            self._learn()
            mine = self._in_force.get(str(ids.get("test_id")), {})
            for certificate_id in [one for one, base in sorted(mine.items()) if base.holds(kind, ids)]:
                if self.withdrawn(certificate_id) is None:
                    return certificate_id
                del mine[certificate_id]
        return None
