"""The machine and the software on it: versions, processors, memory, clock."""

from __future__ import annotations

import ctypes
import os
import pickle
import platform
import re
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from stereorig.server.base.kernel_folder import can_write, kernel_folders, named_folder
from stereorig.server.doctor.report import Notebook
from stereorig.server.formats.version import software_version

#: whose versions matter in a report of trouble
_PACKAGES = ("numpy", "scipy", "opencv-python-headless", "numba", "pyserial", "fastapi", "netCDF4", "tifffile")
#: features of packages that need not be there
_EXTRAS = {
    "xarray": ("xarray", "data sets"),
    "progress": ("rich", "progress bars"),
    "aravis": ("PyGObject", "GenICam"),
    "pylon": ("pypylon", "Basler"),
    "standa": ("libximc", "Standa"),
}
_NAME = re.compile(r"^[A-Za-z0-9._-]+")
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
    found = [f"{name} {metadata.version(name)}" for name in _PACKAGES if _installed(name)]
    missing = [name for name in required() if not _installed(name)]
    versions = f"stereorig {software_version()}, Python {platform.python_version()}, {', '.join(found)}"
    if missing:
        book.note(
            "software",
            "packages",
            "failed",
            f"{', '.join(missing)} missing ({versions})",
            remedy=f"pip install {' '.join(missing)}",
        )
    else:
        book.note("software", "packages", "ok", versions)
    there = [extra for extra, (name, _) in _EXTRAS.items() if _installed(name)]
    lacking = [f"{extra} ({what}: {name})" for extra, (name, what) in _EXTRAS.items() if extra not in there]
    text = "; ".join(filter(None, (", ".join(there), f"not installed: {', '.join(lacking)}" if lacking else "")))
    book.note("software", "extras", "ok", text)


def check_kernels(book: Notebook, folders: list[Path] | None = None) -> None:
    """Note the folder of compiled kernels; if none can be written, every start compiles them again."""
    named = named_folder()
    folders = folders or ([named] if named else kernel_folders())
    place = next((p for p in folders if can_write(p)), None)
    if place is None:
        found = f"cannot be kept: {' and '.join(map(str, folders))} cannot be written"
        remedy = "Set NUMBA_CACHE_DIR to a folder that this user may write: else each start compiles for half a minute."
        book.note("software", "compiled kernels", "warning", found, remedy=remedy)
        return
    book.note("software", "compiled kernels", "ok", f"{_age_of(place)} ({place})")


def _age_of(place: Path) -> str:
    """Say whether the fit's kernels are there, and whether this Python and numba would take them."""
    found = [*place.glob("drivers.run_*.nbi"), *place.glob("kernels_*/drivers.run_*.nbi")]
    later = "the first start compiles them, half a minute, while it calibrates"
    if not found:
        return f"none yet: {later}"
    python = f".py{sys.version_info.major}{sys.version_info.minor}"
    numba = metadata.version("numba") if _installed("numba") else ""
    if any(python in index.name and _numba_of(index) == numba for index in found):
        return "there already"
    return f"of another version of Python or numba: {later}"


def _numba_of(index: Path) -> str | None:
    """Return the version of numba that wrote an index: a pickled text, its first item."""
    try:
        with index.open("rb") as file:
            version = _Texts(file).load()
    except (OSError, pickle.UnpicklingError, EOFError, ValueError, IndexError, AttributeError):
        return None
    return version if isinstance(version, str) else None


class _Texts(pickle.Unpickler):
    """Reads plain values alone."""

    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(f"{module}.{name} is no text")


def required() -> list[str]:
    """Return the packages that the program needs, as its distribution states them."""
    try:
        stated = metadata.requires("stereorig") or []
    except metadata.PackageNotFoundError:  # run from its source
        return list(_PACKAGES)
    plain = [one for one in stated if "extra ==" not in one]
    return sorted({*_PACKAGES, *(match[0] for one in plain if (match := _NAME.match(one)))})


def _installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


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
    """Measures by how much the wall clock was set while it ran."""

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
            remedy="A program sets the clock: let one program do it, by slewing.",
            step_ms=1e3 * step,
        )
