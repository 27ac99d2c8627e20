"""The audit log's file: what readers see, how it is rotated, and a disk that takes nothing."""

from __future__ import annotations

import errno
import json
import logging
import os
from pathlib import Path

import pytest

from stereorig.server.store import audit_log
from stereorig.server.store.audit_log import AuditLog


def lines_of(path: Path) -> list[dict[str, object]]:
    text = path.read_bytes()
    assert b"\0" not in text
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture
def log(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path)


def test_readers_see_the_lines_alone_and_the_reserve_lies_behind_them(tmp_path: Path, log: AuditLog) -> None:
    log.open()
    log.write(who="a", path="/x\udce9")
    log.close()
    AuditLog(tmp_path).write(who="b")
    path = tmp_path / "audit.log"
    assert [line["who"] for line in lines_of(path)] == ["a", "b"]
    if os.uname().sysname == "Linux":
        assert path.stat().st_blocks * 512 >= 100 * path.stat().st_size


def test_ten_older_files_are_kept_and_give_their_reserve_back(
    tmp_path: Path, log: AuditLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_log, "_FILE_BYTES", 1000)
    for k in range(200):
        log.write(k=k, text="x" * 60)
    log.close()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(["audit.log", *(f"audit.log.{k}" for k in range(1, 11))])
    kept = [line["k"] for k in range(10, 0, -1) for line in lines_of(tmp_path / f"audit.log.{k}")]
    kept += [line["k"] for line in lines_of(tmp_path / "audit.log")]
    assert kept == list(range(200 - len(kept), 200))
    assert (tmp_path / "audit.log.1").stat().st_blocks * 512 <= 8192


def test_a_line_that_is_lost_is_counted_and_prints_no_traceback(
    tmp_path: Path,
    log: AuditLog,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    log.write(k=0)
    write, short = os.write, [0, 10, 10]

    def fails(file: int, data: bytes) -> int:
        taken = short.pop()
        if taken:
            return write(file, data[:taken])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING, "stereorig.audit"):
        patch.setattr(audit_log.os, "write", fails)
        for k in range(3):
            log.write(k=k)
        assert len(caplog.records) == 1
        assert "No space left" in caplog.text
    log.write(k=4)
    log.write(k=5)
    log.close()
    assert [(line["k"], line.get("lines_lost_before")) for line in lines_of(tmp_path / "audit.log")] == [
        (0, None),
        (4, 3),
        (5, None),
    ]
    assert capfd.readouterr() == ("", "")
