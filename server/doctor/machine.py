"""The machine and the software on it: versions, processors, memory, clock."""

from __future__ import annotations

import ctypes
import os
import platform
import time
from importlib import metadata
from pathlib import Path

from server.doctor.report import Notebook
from server.formats.version import software_version

_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "numba", "pyserial", "fastapi", "netCDF4", "tifffile")
_MEMORY_GIB = 1.0
# of the wall clock against the monotonic one while the doctor runs; slewing by NTP stays below 0.5 ms a second
_STEP_S = 0.05
_STA_UNSYNC = 0x40


class _Timex(ctypes.Structure):
    # the beginning of struct timex of <sys/timex.h>; the rest is room
    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("room", ctypes.c_char * 256),
    )


def check_software(book: Notebook) -> None:
    """Note the versions that matter in a report of trouble."""
    found, missing = [], []
    for name in _PACKAGES:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    versions = f"stereorig {software_version()}, Python {platform.python_version()}, {', '.join(found)}"
    if missing:
        book.note(
            "software",
            "packages",
            "failed",
            f"{', '.join(missing)} missing ({versions})",
            remedy="Install stereorig anew: pip install stereorig.",
        )
    else:
        book.note("software", "packages", "ok", versions)


def check_machine(book: Notebook) -> None:
    """Processors, load, memory, clock."""
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    book.note(
        "machine",
        "processors",
        "ok" if cpus >= 2 else "warning",
        f"{cpus} ({platform.machine()})",
        limit="2 or more",
        remedy="With one processor computing delays the cameras' threads: use a machine with two or more.",
        processors=cpus,
    )
    load = os.getloadavg()[0]
    book.note(
        "machine",
        "load",
        "ok" if load <= cpus else "warning",
        f"{load:.1f} over the last minute",
        limit=f"{cpus}",
        remedy="Other programs keep all processors busy: end them before frames are lost.",
        load=load,
    )
    _check_memory(book)
    synchronised = _clock_synchronised()
    if synchronised is None:
        book.note("machine", "clock", "not checked", "the system does not say whether its clock is synchronised")
    else:
        book.note(
            "machine",
            "clock",
            "ok" if synchronised else "warning",
            "synchronised" if synchronised else "not synchronised with any other",
            remedy="Times in the results may be off (their order never is): switch NTP on (timedatectl set-ntp true).",
        )


def _check_memory(book: Notebook) -> None:
    available = None
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                available = int(line.split()[1]) / 2**20
    except (OSError, ValueError, IndexError):
        pass
    if available is None:
        book.note("machine", "memory", "not checked", "the system does not say how much is available")
        return
    book.note(
        "machine",
        "memory",
        "ok" if available >= _MEMORY_GIB else "warning",
        f"{available:.1f} GiB available",
        limit=f"{_MEMORY_GIB:g} GiB",
        remedy="End other programs: computing needs room for images and kernels.",
        available_gib=available,
    )


def _clock_synchronised() -> bool | None:
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        state = _Timex()
        if libc.adjtimex(ctypes.byref(state)) < 0:  # modes 0: reads only
            return None
    except (OSError, AttributeError):
        return None
    return not state.status & _STA_UNSYNC


class ClockWatch:
    """Tells whether the wall clock was set while it ran."""

    def __init__(self) -> None:
        self._before = time.time() - time.monotonic()

    def check(self, book: Notebook) -> None:
        """Note how the wall clock ran since this watch was made."""
        step = time.time() - time.monotonic() - self._before
        book.note(
            "machine",
            "clock steps",
            "ok" if abs(step) <= _STEP_S else "warning",
            f"wall clock moved by {1e3 * step:+.1f} ms against the monotonic one",
            limit=f"{1e3 * _STEP_S:g} ms",
            remedy="Somebody sets the clock: let one program do it, by slewing.",
            step_ms=1e3 * step,
        )
