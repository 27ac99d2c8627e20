"""Cause of a process's end: its signal in words, and whether the kernel ended it for want of memory."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from pathlib import Path

import psutil

_PROC = Path("/proc")
_CGROUPS = Path("/sys/fs/cgroup")
_MEANINGS = {
    signal.SIGSEGV: "it reached for memory that is not its own",
    signal.SIGBUS: "it reached for memory that is not there, as when a mapped file was cut short or a disk failed",
    signal.SIGABRT: "a library gave up",
    signal.SIGILL: "it met an instruction that this processor does not support",
    signal.SIGFPE: "an arithmetic fault",
    signal.SIGTERM: "it was asked to end",
    signal.SIGXCPU: "its limit of processor time was reached",
}


@dataclass(frozen=True)
class MemoryWatch:
    """Counts of the kernel's out-of-memory kills, by the file that holds them; taken before, compared after."""

    kills: dict[Path, int]

    @classmethod
    def now(cls) -> MemoryWatch:
        """Read the counts."""
        sources = [_PROC / "vmstat", *_own_cgroup_files()]
        return cls({source: count for source in sources if (count := _oom_kills(source)) is not None})

    def killed_since(self) -> bool:
        """Return True if any count has grown."""
        later = MemoryWatch.now().kills
        return any(later.get(source, count) > count for source, count in self.kills.items())


def _own_cgroup_files() -> list[Path]:
    """``memory.events`` of our control group and those above it, up to the root."""
    try:
        lines = (_PROC / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return []
    for line in lines:
        number, _, name = line.split(":", 2)
        if number == "0":
            group = _CGROUPS / name.strip("/")
            return [folder / "memory.events" for folder in (group, *group.parents) if folder.is_relative_to(_CGROUPS)]
    return []


def _oom_kills(path: Path) -> int | None:
    try:
        for line in path.read_text().splitlines():
            name, _, count = line.partition(" ")
            if name == "oom_kill":
                return int(count)
    except (OSError, ValueError):
        pass
    return None


def resident_mib(pid: int) -> float | None:
    """Memory that a process holds, MiB; None if it is not known, as when it has ended."""
    try:
        return float(psutil.Process(pid).memory_info().rss) / 2**20 or None
    except psutil.Error:
        return None


def cause_of_death(exit_code: int | None, *, out_of_memory: bool, memory_mib: float | None) -> str:
    """Return how a process ended, as the end of a sentence that begins with "it ended".

    Parameters
    ----------
    exit_code
        As `multiprocessing` has it: negative for a signal.
    out_of_memory
        True if the kernel killed a process for want of memory at that time.
    memory_mib
        Memory that it held at the last reading.
    """
    if exit_code is None:
        return "in a way that the system does not report"
    if exit_code >= 0:
        return f"with exit code {exit_code}"
    number = -exit_code
    try:
        known = signal.Signals(number)
    except ValueError:
        return f"by signal {number}"
    held = "" if memory_mib is None else f" It held {memory_mib:.0f} MiB."
    if known is signal.SIGKILL:
        if out_of_memory:
            return f"by signal 9 (SIGKILL): the kernel ended it because memory ran out.{held}"
        return f"by signal 9 (SIGKILL): another process killed it; the kernel counts no lack of memory.{held}"
    meaning = _MEANINGS.get(known)
    return f"by signal {number} ({known.name})" + ("" if meaning is None else f": {meaning}.{held}")
