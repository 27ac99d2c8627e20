"""The walls around a process that reads a foreign file: limits, Landlock and seccomp, by the kernel's own calls.

Each wall is raised if the kernel has it; a process that has gone in cannot come out, nor can its children.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import platform
import resource
import signal
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

#: of memory, for a file whose declared size is small
FLOOR_BYTES = 128 << 20
#: memory that is allowed for each byte that a file declares
MEMORY_FACTOR = 4
_SPARE_DESCRIPTORS = 16

_PR_SET_PDEATHSIG, _PR_SET_DUMPABLE, _PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS = 1, 4, 22, 38
_SECCOMP_FILTER, _CAPABILITIES = 2, 0x20080522
_LANDLOCK_CREATE, _LANDLOCK_RESTRICT = 444, 446
_LANDLOCK_VERSION = 1
#: rights of the file system that each version of Landlock handles, and of the network and of signals
_LANDLOCK_FILES = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
_LANDLOCK_NETWORK, _LANDLOCK_SCOPES = 4, 6

#: audit's number of the machine, and which of a call's two numbers is its own
_MACHINES = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
_EXECUTE = 4  # PROT_EXEC
_AT_EMPTY_PATH = 0x1000
_FCNTL = (0, 1, 2, 3, 1030)  # F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_DUPFD_CLOEXEC
#: calls of the kernel that a reader may make: memory, its descriptors, the clock, its end; on x86_64 and on aarch64
_TABLE = """
read 0 63, write 1 64, lseek 8 62, mmap 9 222, munmap 11 215, mprotect 10 226, mremap 25 216, madvise 28 233,
brk 12 214, futex 202 98, close 3 57, fstat 5 80, newfstatat 262 79, pread64 17 67, pwrite64 18 68, readv 19 65,
writev 20 66, ftruncate 77 46, fcntl 72 25, dup 32 23, rt_sigaction 13 134, rt_sigprocmask 14 135,
rt_sigreturn 15 139, sigaltstack 131 132, restart_syscall 219 128, tgkill 234 131, getpid 39 172, gettid 186 178,
getuid 102 174, geteuid 107 175, getgid 104 176, getegid 108 177, uname 63 160, prctl 157 167, sysinfo 99 179,
sched_yield 24 124, sched_getaffinity 204 123, clock_gettime 228 113, clock_getres 229 114, gettimeofday 96 169,
getrusage 98 165, getrlimit 97 163, setrlimit 160 164, prlimit64 302 261, getrandom 318 278, rseq 334 293,
set_robust_list 273 99, membarrier 324 283, exit 60 93, exit_group 231 94
"""
_CALLS = {name: (int(one), int(other)) for name, one, other in (call.split() for call in _TABLE.split(","))}
#: open, openat, openat2; the first is not on aarch64
_OPENING = ((2, 56), (257, 56), (437, 437))


def _one(code: int, value: int, true: int = 0, false: int = 0) -> bytes:
    """Return an instruction of the filter: code, number, and how many to leave out if it holds, and if not."""
    return struct.pack("=HBBI", code, true, false, value)


_LOAD, _EQUAL, _ANY_BIT, _GIVE = 0x20, 0x15, 0x45, 0x06
_ALLOW, _DENY, _END = (_one(_GIVE, value) for value in (0x7FFF0000, 0x00050000 | errno.EPERM, 0x80000000))


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


@dataclass(frozen=True)
class ReadingLimits:
    """Bounds of the reading of a file.

    Attributes
    ----------
    memory_bytes
        Beyond the process' own as it begins.
    cpu_s
        Processor time, whole seconds.
    wall_s
        Time by the clock, for a reader that waits without computing.
    reply_bytes
        Largest size of the reply.
    """

    memory_bytes: int = 1 << 30
    cpu_s: int = 60
    wall_s: float = 900.0
    reply_bytes: int = 1 << 30


#: names of the walls around this process
_raised: list[str] = []
_base_bytes: int | None = None
_libc = ctypes.CDLL(None, use_errno=True)
_libc.prctl.argtypes = (ctypes.c_int, *(ctypes.c_ulong,) * 4)


ALL_WALLS = ("limits", "Landlock", "seccomp")


def walls(_files: Sequence[BinaryIO] = ()) -> list[str]:
    """Return the names of the walls around this process; empty outside."""
    return list(_raised)


def enter(limits: ReadingLimits, descriptors: int, parent: int) -> None:
    """Raise all walls around this process; its open files stay open.

    Parameters
    ----------
    descriptors
        Number of the descriptors that it has.
    parent
        Process with which it ends.

    Raises
    ------
    OSError
        The kernel has a wall and does not raise it.
    """
    global _base_bytes
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")  # the first to go for want of memory
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    _base_bytes = pages * resource.getpagesize()
    for bound, most in (
        (resource.RLIMIT_AS, _base_bytes + limits.memory_bytes),
        (resource.RLIMIT_FSIZE, limits.reply_bytes),
        (resource.RLIMIT_NOFILE, descriptors + _SPARE_DESCRIPTORS),
        (resource.RLIMIT_NPROC, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(bound)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(bound, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (limits.cpu_s, limits.cpu_s + 1))
    _raised.append("limits")
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # it ended before it was asked to be followed
    _prctl(_PR_SET_DUMPABLE, 0)
    _prctl(_PR_SET_NO_NEW_PRIVS, 1)
    if _libc.capset(struct.pack("=II", _CAPABILITIES, 0), bytes(24)) != 0:  # root would leave its limits
        raise OSError(ctypes.get_errno(), "capset")
    if _landlock():
        _raised.append("Landlock")
    if _seccomp(_filter):
        _raised.append("seccomp")


def declare(size_bytes: int) -> None:
    """Bound this process' memory by the size that a file declares for its content; nothing outside the walls."""
    if _base_bytes is not None:
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        soft = _base_bytes + FLOOR_BYTES + MEMORY_FACTOR * size_bytes
        resource.setrlimit(resource.RLIMIT_AS, (min(soft, hard), hard))


def end_at_opening() -> None:
    """End this process if it tries to open a file from now on; nothing outside the walls.

    The HDF5 library takes a virtual data set for an empty one if its file cannot be opened.
    """
    if "seccomp" in _raised:
        _seccomp(_ending)


def _prctl(option: int, value: int, more: int = 0) -> None:
    if _libc.prctl(option, value, more, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _landlock() -> bool:
    """Deny every right of the file system, of TCP, and signals to others, as far as the kernel handles them."""
    version = _libc.syscall(_LANDLOCK_CREATE, None, ctypes.c_size_t(0), _LANDLOCK_VERSION)
    if version < 1:
        return False
    rights = (1 << _LANDLOCK_FILES[min(version, max(_LANDLOCK_FILES))]) - 1
    network, scopes = 0b11 * (version >= _LANDLOCK_NETWORK), 0b11 * (version >= _LANDLOCK_SCOPES)
    fields = struct.pack("=QQQ", rights, network, scopes)
    handled = fields[: 8 if version < _LANDLOCK_NETWORK else 16 if version < _LANDLOCK_SCOPES else 24]
    rules = _libc.syscall(_LANDLOCK_CREATE, handled, ctypes.c_size_t(len(handled)), 0)
    done = rules >= 0 and _libc.syscall(_LANDLOCK_RESTRICT, rules, 0) == 0
    if not done:
        raise OSError(ctypes.get_errno(), "Landlock")
    os.close(rules)
    return True


def _seccomp(instructions: Callable[[int, int], Iterable[bytes]]) -> bool:
    """Hold the calls of the kernel to a filter; return False if this kernel has none."""
    known = _MACHINES.get(platform.machine())
    if known is None:
        return False
    program = b"".join(instructions(*known))
    buffer = ctypes.create_string_buffer(program, len(program))
    asked = _Program(len(program) // 8, ctypes.addressof(buffer))
    try:
        _prctl(_PR_SET_SECCOMP, _SECCOMP_FILTER, ctypes.addressof(asked))
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.ENOSYS):  # a kernel that was built without
            return False
        raise
    return True


def _filter(machine: int, which: int) -> Iterable[bytes]:
    """Yield the instructions that deny each call that is not in the list (classic BPF on ``struct seccomp_data``)."""
    yield _one(_LOAD, 4) + _one(_EQUAL, machine, 1, 0) + _END  # another machine's calls
    yield _one(_LOAD, 0)
    # argument, test, its values, and the answer if one of them holds
    asks = {
        "newfstatat": (3, _ANY_BIT, (_AT_EMPTY_PATH,), _ALLOW),
        "fcntl": (1, _EQUAL, _FCNTL, _ALLOW),
        "tgkill": (0, _EQUAL, (os.getpid(),), _ALLOW),
        "prlimit64": (0, _EQUAL, (0,), _ALLOW),
        "prctl": (0, _EQUAL, (_PR_SET_SECCOMP,), _ALLOW),
        "mmap": (2, _ANY_BIT, (_EXECUTE,), _DENY),
        "mprotect": (2, _ANY_BIT, (_EXECUTE,), _DENY),
    }
    for name, numbers in _CALLS.items():
        body = _ALLOW
        if name in asks:
            argument, test, values, then = asks[name]
            held = b"".join(_one(test, value, 0, 1) + then for value in values)
            body = _one(_LOAD, 16 + 8 * argument) + held + (_DENY if then is _ALLOW else _ALLOW)
        yield _one(_EQUAL, numbers[which], 0, len(body) // 8) + body
    yield _DENY


def _ending(_machine: int, which: int) -> Iterable[bytes]:
    """Yield the instructions that end a process that opens a file."""
    yield _one(_LOAD, 0)
    for numbers in _OPENING:
        yield _one(_EQUAL, numbers[which], 0, 1) + _END
    yield _ALLOW
