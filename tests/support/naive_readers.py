"""Readers of foreign files without any care, which the cell must hold; its process imports this module."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import netCDF4
import numpy as np

from stereorig.core.errors import ImageError
from stereorig.server.cell import sandbox
from stereorig.server.cell.models import warm_up as warm_up

Files = list[BinaryIO]
_libc = ctypes.CDLL(None, use_errno=True)


def content(files: Files) -> list[str]:
    return [file.read().decode() for file in files]


def walls(files: Files) -> list[str]:
    return sandbox.walls()


def values(files: Files) -> dict[str, Any]:
    arrays = {kind: np.arange(6).reshape(2, 3).astype(kind) for kind in ("u1", "<u2", "<i8", "<f8", "?")}
    return {**arrays, "none": np.zeros((0, 3)), "plain": [1, None, "ü", float("inf"), {"array": [2]}]}


def refuses(files: Files) -> None:
    raise ImageError("It is blank.", code="image_blank", remedy="Take another.", camera="cam1")


def refuses_strangely(files: Files) -> None:
    raise ImageError("It is blank.", code="nothing_that_is_known")


def reads(files: Files, path: str) -> str:
    return os.fdopen(os.open(path, os.O_RDONLY)).read()


def writes(files: Files, path: str) -> None:
    os.open(path, os.O_CREAT | os.O_WRONLY)


def writes_its_file(files: Files) -> int:
    return os.pwrite(files[0].fileno(), b"other", 0)


def lists(files: Files, path: str) -> list[str]:
    return [one.name for one in Path(path).iterdir()]


def removes(files: Files, path: str) -> None:
    Path(path).unlink()


def renames(files: Files, path: str) -> None:
    Path(path).rename(f"{path}.other")


def links(files: Files, path: str) -> None:
    os.link(path, f"{path}.other")


def opens_a_socket(files: Files, port: int) -> None:
    socket.socket()


def connects(files: Files, port: int) -> None:
    """Ask the kernel itself: whatever the library would refuse before."""
    if _libc.socket(socket.AF_INET, socket.SOCK_STREAM, 0) < 0:
        raise OSError(ctypes.get_errno(), "socket")


def forks(files: Files) -> None:
    if os.fork() == 0:
        os._exit(0)


def starts_a_thread(files: Files) -> None:
    threading.Thread(target=print).start()


def runs_a_program(files: Files) -> None:
    os.execv("/bin/true", ["true"])


def kills(files: Files, pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


def traces(files: Files, pid: int) -> None:
    if _libc.ptrace(16, pid, None, None) != 0:  # PTRACE_ATTACH
        raise OSError(ctypes.get_errno(), "ptrace")


def reads_memory_of(files: Files, pid: int) -> None:
    local = ctypes.create_string_buffer(16)
    if _libc.process_vm_readv(pid, local, 1, local, 1, 0) < 0:
        raise OSError(ctypes.get_errno(), "process_vm_readv")


def makes_code(files: Files) -> None:
    import mmap

    mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)


def leaves_the_limits(files: Files) -> None:
    import resource

    resource.prlimit(os.getppid(), resource.RLIMIT_CPU, (1, 1))


def hdf5_numbers(files: Files, ends: bool = True) -> list[str]:
    """Return each variable's bytes as text."""
    with netCDF4.Dataset("heavy.h5", "r", memory=files[0].read()) as data:
        if ends:
            sandbox.end_at_opening()
        data.set_auto_mask(False)
        return [np.asarray(one[...]).tobytes().decode("latin-1") for one in data.variables.values()]


def xml(files: Files) -> None:
    text = files[0].read().decode()
    cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY).getNode("a")


def crashes(files: Files) -> None:
    ctypes.string_at(0)


def gives_up(files: Files) -> None:
    os.abort()


def ends_without_a_word(files: Files) -> None:
    os._exit(3)


def fails(files: Files) -> None:
    raise ValueError("secret of the file")


def grows(files: Files) -> None:
    held = []
    while True:
        held.append(np.ones(50 << 20, np.uint8))


def replies_at_length(files: Files) -> Any:
    return [np.zeros(1 << 20)] * 8


def turns(files: Files) -> None:
    while True:
        pass


def waits(files: Files) -> None:
    threading.Event().wait()


def declares(files: Files, size: int, taken: int) -> int:
    sandbox.declare(size)
    return int(np.ones(taken, np.uint8)[-1])


def replies_with(files: Files, raw: bytes) -> None:
    """Write a reply by itself, as code of an attacker would, and end."""
    for descriptor in range(3, 10):
        try:
            os.pwrite(descriptor, raw, 0)
        except OSError:
            continue
    os._exit(0)


def raises_its_limits(files: Files) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


ATTACKS: list[tuple[Callable[..., object], tuple[str, ...]]] = [
    (reads, ("secret",)),
    (writes, ("new",)),
    (writes_its_file, ()),
    (lists, ("folder",)),
    (removes, ("secret",)),
    (renames, ("secret",)),
    (links, ("secret",)),
    (opens_a_socket, ("port",)),
    (connects, ("port",)),
    (forks, ()),
    (starts_a_thread, ()),
    (runs_a_program, ()),
    (kills, ("pid",)),
    (traces, ("pid",)),
    (reads_memory_of, ("pid",)),
    (makes_code, ()),
    (leaves_the_limits, ()),
    (raises_its_limits, ()),
]
