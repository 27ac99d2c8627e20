"""What a certificate rests on is known without reading every certificate again."""

from __future__ import annotations

from pathlib import Path

import pytest

import stereorig.server.store.certificates
from stereorig.server.documents.made import CertificateRecord
from stereorig.server.store.certificates import CertificateStore
from stereorig.server.store.folder import DataFolder

TEST, OTHER = "t000001-aaaaaa", "t000002-bbbbbb"


def store_in(folder: Path) -> CertificateStore:
    return CertificateStore(DataFolder(folder))


def put(store: CertificateStore, number: int, test_id: str, *, analysis_id: str = "a000001-cccccc") -> str:
    certificate_id = f"v{number:06d}-abcdef"
    made_of = {"test_id": test_id, "analysis_id": analysis_id, "steps": {"1": {}, "2": {}}}
    record = {"id": certificate_id, "outcome": "pass", "created_utc": "2026-01-01T00:00:00Z", "made_of": made_of}
    store.put(certificate_id, record, b"<!doctype html>")
    return certificate_id


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Documents of certificates, as they are read."""
    found: list[Path] = []
    real = stereorig.server.store.certificates.read_record

    def counted(model: type[CertificateRecord], path: Path) -> CertificateRecord:
        found.append(path)
        return real(model, path)

    monkeypatch.setattr(stereorig.server.store.certificates, "read_record", counted)
    return found


def test_a_deletion_reads_each_certificate_once(tmp_path: Path, reads: list[Path]) -> None:
    for number in range(1, 41):
        put(store_in(tmp_path), number, OTHER if number > 1 else TEST)
    store = store_in(tmp_path)  # as after a start
    store.learn()
    assert len(reads) == 40
    for _ in range(3):
        assert store.resting_on("test", {"test_id": TEST}) == "v000001-abcdef"
        assert store.resting_on("step", {"test_id": TEST, "n": 3}) is None
    assert len(reads) == 40
    put(store, 41, TEST, analysis_id="a000009-cccccc")
    assert store.resting_on("analysis", {"test_id": TEST, "analysis_id": "a000009-cccccc"}) == "v000041-abcdef"
    assert len(reads) == 41


def test_what_was_withdrawn_protects_nothing(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    first, second = put(store, 1, TEST), put(store, 2, TEST)
    assert store.resting_on("step", {"test_id": TEST, "n": 1}) == first
    store.withdraw(first, "another lens", "somebody")
    assert store.resting_on("step", {"test_id": TEST, "n": 1}) == second
    store.withdraw(second, "another lens", "somebody")
    assert store.resting_on("test", {"test_id": TEST}) is None
    assert store_in(tmp_path).resting_on("test", {"test_id": TEST}) is None


def test_one_that_is_damaged_protects_nothing_until_it_is_restored(tmp_path: Path) -> None:
    certificate_id = put(store_in(tmp_path), 1, TEST)
    path = tmp_path / "certificates" / certificate_id / "certificate.json"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    store = store_in(tmp_path)
    assert store.resting_on("test", {"test_id": TEST}) is None
    path.write_bytes(whole)
    assert store.resting_on("test", {"test_id": TEST}) == certificate_id


def test_a_certificate_that_was_copied_into_the_folder_protects_too(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    assert store.resting_on("test", {"test_id": TEST}) is None
    put(store_in(tmp_path), 7, TEST)
    assert store.resting_on("test", {"test_id": TEST}) == "v000007-abcdef"
