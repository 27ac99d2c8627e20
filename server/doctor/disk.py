"""The data folder: whether it keeps its promises, how fast, and how much fits in."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from pathlib import Path

from stereorig.core.errors import StorageError
from stereorig.server.doctor.report import Notebook, percentile
from stereorig.server.formats.files import storage_error, write_bytes

_SECONDS = 1.5
_MAX_FILES = 64
_FEW_PAIRS, _TOO_FEW_PAIRS = 1000, 20
_MIB = 2**20


def check_disk(book: Notebook, root: Path, *, image_bytes: int, pairs_per_s: float | None) -> None:
    """Write images as the service does (temporary file, fsync, rename, fsync of the folder) and check the room left.

    Parameters
    ----------
    root
        The data folder; if it does not exist yet, the folder above it is tried.
    image_bytes
        Size of one image file.
    pairs_per_s
        Rate at which this rig delivers pairs; None if it is not known.
    """
    folder = root.absolute()
    try:
        while not folder.is_dir() and folder.parent != folder:
            folder = folder.parent
    except PermissionError:  # a folder above it may not be entered
        book.fail("disk", "writing", _not_ours(folder))
        return
    _check_lock(book, root)
    with book.guard("disk", "writing"):
        times = _write(folder, image_bytes)
        rate = image_bytes * len(times) / sum(times) / _MIB
        slowest = percentile(times, 0.99)
        wanted = None if pairs_per_s is None else 2 * image_bytes * pairs_per_s / _MIB
        slow = wanted is not None and rate < wanted
        book.note(
            "disk",
            "writing",
            "warning" if slow else "ok",
            f"{rate:.1f} MiB/s with fsync in {folder}; {1e3 * percentile(times, 0.5):.1f} ms an image, "
            f"p99 {1e3 * slowest:.1f} ms ({len(times)} of {image_bytes / _MIB:.2f} MiB)",
            limit=None if wanted is None else f"{wanted:.1f} MiB/s to keep every pair",
            remedy="The disk cannot keep every pair at the cameras' rate: use a faster one, or capture more seldom.",
            mib_per_s=rate,
            median_ms=1e3 * percentile(times, 0.5),
            p99_ms=1e3 * slowest,
            wanted_mib_per_s=wanted,
        )
    _check_room(book, folder, image_bytes)


def _check_lock(book: Notebook, root: Path) -> None:
    try:
        with (root / "service.lock").open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = file.read().strip() or "another process"
                book.note(
                    "disk",
                    "data folder",
                    "warning",
                    f"{root} is in use by {holder}",
                    remedy="A running service holds the devices too: stop it for a full check.",
                )
                return
    except FileNotFoundError:
        book.note("disk", "data folder", "ok", f"{root} is free" if root.is_dir() else f"{root} will be made")
        return
    except OSError as error:
        book.fail("disk", "data folder", storage_error(error, root))
        return
    book.note("disk", "data folder", "ok", f"{root} is free")


def _write(folder: Path, image_bytes: int) -> list[float]:
    data = os.urandom(image_bytes)  # so that no file system can pack it
    times: list[float] = []
    try:
        with tempfile.TemporaryDirectory(prefix=".doctor-", dir=folder) as temporary:
            end = time.monotonic() + _SECONDS
            while len(times) < _MAX_FILES and (time.monotonic() < end or len(times) < 2):
                start = time.monotonic()
                write_bytes(Path(temporary) / f"image_{len(times) % 4}.bin", data)
                times.append(time.monotonic() - start)
    except PermissionError as error:
        raise _not_ours(folder) from error
    except OSError as error:
        raise storage_error(error, folder) from error
    return times


def _not_ours(folder: Path) -> StorageError:
    return StorageError(
        f"This user (id {os.geteuid()}) may not write in {folder}.",
        remedy="Give the folder to the user that runs the service (chown), or name another with --data.",
    )


def _check_room(book: Notebook, folder: Path, image_bytes: int) -> None:
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        book.fail("disk", "room", StorageError(f"The free space of {folder} cannot be read ({error.strerror})."))
        return
    pairs = free // (2 * image_bytes)
    book.note(
        "disk",
        "room",
        "failed" if pairs < _TOO_FEW_PAIRS else "warning" if pairs < _FEW_PAIRS else "ok",
        f"{free / 2**30:.1f} GiB free, room for {pairs} pairs",
        limit=f"{_FEW_PAIRS} pairs",
        remedy="Free space on this disk, or give another folder with --data.",
        free_gib=free / 2**30,
        pairs=pairs,
    )
