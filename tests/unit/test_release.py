"""Parts of a release, each by a reader that is not ours."""

from __future__ import annotations

import datetime
import subprocess
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml

from tests.bench.documents.release import changes, checksums, citation, project, source_archive
from tests.support.requirements import ROOT


def test_the_changes_are_those_of_the_version() -> None:
    version = project()["version"]
    notes = changes((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), version)
    assert notes.startswith(f"# stereorig {version}\n")
    assert "\n## " not in notes
    assert changes("# Changelog\n\n## 0.2.0\n\n- b\n\n## 0.1.0\n\n- a\n", "0.2.0") == "# stereorig 0.2.0\n\n- b\n"
    with pytest.raises(SystemExit, match=r"begins with 0\.2\.0"):
        changes("## 0.2.0\n- b\n", "0.3.0")


def test_the_citation_file_has_what_the_format_requires() -> None:
    found = yaml.safe_load(citation("1.2.3", "2026-11-30", project()["description"]))
    assert found.keys() >= {"cff-version", "message", "title", "authors"}
    assert (found["version"], found["date-released"]) == ("1.2.3", datetime.date(2026, 11, 30))
    assert [one["family-names"] for one in found["references"][0]["authors"]] == ["Helm", "McNeill", "Sutton"]
    assert found["references"][0]["doi"] == "10.1117/1.600624"


def test_the_source_archive_is_the_commit_with_its_metadata(tmp_path: Path) -> None:
    wheel = tmp_path / "stereorig-9.9.9-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as made:
        made.writestr("stereorig-9.9.9.dist-info/METADATA", "Metadata-Version: 2.4\nName: stereorig\nVersion: 9.9.9\n")
    listed = ["git", "ls-files"]
    tracked = subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    with tarfile.open(source_archive(wheel, tmp_path)) as packed:
        members = {one.name: one for one in packed}
        names = {name.removeprefix("stereorig-9.9.9/") for name, one in members.items() if not one.isdir()}
        assert "PKG-INFO" in names
        in_commit = {"pyproject.toml", "core/errors.py", "server/static/index.html", "LICENSE"}
        assert in_commit <= names & set(tracked)
        link = members["stereorig-9.9.9/stereorig/core"]
        assert (link.issym(), link.linkname) == (True, "../core")
        text = packed.extractfile("stereorig-9.9.9/pyproject.toml")
        assert text is not None
        assert b'name = "stereorig"' in text.read()


def test_the_checksums_are_those_that_sha256sum_finds(tmp_path: Path) -> None:
    (tmp_path / "a.whl").write_bytes(b"wheel")
    (tmp_path / "SHA256SUMS").write_text(checksums(tmp_path), encoding="utf-8")
    subprocess.run(["sha256sum", "-c", "--strict", "SHA256SUMS"], cwd=tmp_path, check=True, capture_output=True)
