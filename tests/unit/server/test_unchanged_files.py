"""What was made of a file is kept until somebody touches it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from stereorig.server.results.warnings import analysis
from stereorig.server.results.warnings.analysis import analysis_warnings
from stereorig.server.store.durable import UnchangedFiles, known_json, write_json


class Reader:
    """Counts how often it was asked."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def __call__(self, path: Path) -> str:
        self.asked.append(path.name)
        return path.read_text() if path.is_file() else "gone"


def test_a_file_is_read_once_until_it_is_touched(tmp_path: Path) -> None:
    kept, read, path = UnchangedFiles(8), Reader(), tmp_path / "one"
    path.write_text("a")
    assert [kept.made_of(path, read) for _ in range(3)] == ["a"] * 3
    assert read.asked == ["one"]
    other = tmp_path / "other"
    other.write_text("b")  # as long
    os.utime(other, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))
    other.replace(path)
    assert kept.made_of(path, read) == "b"
    path.unlink()
    assert [kept.made_of(path, read) for _ in range(2)] == ["gone"] * 2
    assert read.asked == ["one"] * 4


def test_the_files_asked_for_last_are_kept_up_to_a_number(tmp_path: Path) -> None:
    kept, read = UnchangedFiles(2), Reader()
    for name in "abc":
        (tmp_path / name).write_text(name)
    for name in "abacab":
        assert kept.made_of(tmp_path / name, read) == name
    assert read.asked == ["a", "b", "c", "b"]


def test_small_files_are_read_each_time_where_that_is_said(tmp_path: Path) -> None:
    kept, read, path = UnchangedFiles(8, least_bytes=4), Reader(), tmp_path / "one"
    for text, times in (("abc", 2), ("abcd", 1)):
        path.write_text(text)
        read.asked.clear()
        assert [kept.made_of(path, read) for _ in range(2)] == [text] * 2
        assert len(read.asked) == times


def test_the_checks_of_an_analysis_read_its_newest_step_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "t000001-abcdef" / "analyses" / "a1"
    asked: list[str] = []

    def counted(path: Path, *more: Any) -> dict[str, Any]:
        asked.append(path.name)
        return known_json(path, *more)

    def put(n: int, share: float) -> None:
        step = tmp_path / "t000001-abcdef" / "steps" / f"{n:04d}"
        for home in (folder, step):
            home.mkdir(parents=True, exist_ok=True)
        write_json(step / "step.json", {"n": n})
        write_json(folder / f"step_{n:04d}.json", {"n": n, "valid_fraction": share, "valid": 1, "points": 2})
        (folder / f"step_{n:04d}.nc").touch()

    monkeypatch.setattr(analysis, "known_json", counted)
    for n in range(5):
        put(n, 1.0)
    assert analysis_warnings(folder) == []
    assert len([name for name in asked if name.startswith("step")]) == 10
    asked.clear()
    put(5, 0.6)
    (found,) = analysis_warnings(folder)
    assert (found.code, found.steps) == ("low_coverage", (5,))
    assert sorted(name for name in asked if name.startswith("step")) == ["step.json", "step_0005.json"]
    put(2, 0.4)  # measured again
    (found,) = analysis_warnings(folder)
    assert (found.level, found.steps) == ("failed", (2, 5))
    assert json.loads((folder / "step_0002.json").read_text())["valid_fraction"] == 0.4
