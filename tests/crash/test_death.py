"""Why a process died: signals in words, and the kernel's count of lack of memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stereorig.server.worker import death
from stereorig.server.worker.death import MemoryWatch, cause_of_death, resident_mib


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (-11, "signal 11 (SIGSEGV)"),
        (-7, "signal 7 (SIGBUS)"),
        (-6, "signal 6 (SIGABRT)"),
        (-15, "signal 15 (SIGTERM)"),
        (-64, "signal 64"),
        (3, "exit code 3"),
        (None, "not report"),
    ],
)
def test_an_end_is_told_in_words(code: int | None, words: str) -> None:
    assert words in cause_of_death(code, out_of_memory=False, memory_mib=None)


def test_a_kill_for_want_of_memory_is_told_from_any_other() -> None:
    killed = cause_of_death(-9, out_of_memory=True, memory_mib=3210.4)
    assert "memory ran out" in killed
    assert "3210 MiB" in killed
    assert "another process killed it" in cause_of_death(-9, out_of_memory=False, memory_mib=None)


@pytest.mark.parametrize("counter", ["vmstat", "own group", "group above", "none"])
def test_the_kernels_counts_tell_whether_memory_ran_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counter: str
) -> None:
    proc, groups = tmp_path / "proc", tmp_path / "cgroup"
    (proc / "self").mkdir(parents=True)
    (groups / "lab" / "service").mkdir(parents=True)
    (proc / "self" / "cgroup").write_text("1:cpu:/x\n0::/lab/service\n")
    files = {
        "vmstat": proc / "vmstat",
        "own group": groups / "lab" / "service" / "memory.events",
        "group above": groups / "lab" / "memory.events",
    }
    for file in files.values():
        file.write_text("oom 7\noom_kill 2\noom_group_kill 9\n")
    monkeypatch.setattr(death, "_PROC", proc)
    monkeypatch.setattr(death, "_CGROUPS", groups)
    watch = MemoryWatch.now()
    assert len(watch.kills) == 3
    for file in files.values():
        file.write_text("oom 8\noom_kill 2\noom_group_kill 10\n")
    if counter != "none":
        files[counter].write_text("oom 8\noom_kill 3\n")
    assert watch.killed_since() is (counter != "none")


def test_a_process_memory_is_that_of_the_kernel() -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", "x = bytearray(50_000_000); print(1, flush=True); input()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert child.stdout is not None
    child.stdout.readline()
    held = resident_mib(child.pid)
    child.communicate(b"\n")
    assert held is not None
    assert 50.0 < held < 200.0
    assert resident_mib(child.pid) is None
    assert resident_mib(os.getpid()) is not None
