"""The process that keeps the readers loaded, and makes of itself a walled child for every file.

It has one thread, so that a child begins in a known state, and touches no byte of a file or of a reply itself.
"""

from __future__ import annotations

import codecs
import contextlib
import gc
import os
import pickle
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from stereorig.server.base.priority import lower_worker
from stereorig.server.cell import reply, sandbox
from stereorig.server.formats.load_frames.layout import CODE_PAGES

MAX_MESSAGE_BYTES = 64 << 10
MAX_FILES = 8
_IDLE_S = 300.0
_ENCODINGS = (
    "utf-8-sig",
    "latin-1",
    "ascii",
    "utf-16",
    "utf-16-le",
    "utf-16-be",
    "utf-32",
    "cp1252",
    "iso8859-15",
    "cp437",
    *CODE_PAGES,
)
_MAX_DESCRIPTOR = 1 << 20

#: modules whose readers were used once: behind the walls nothing can be loaded
_warm: set[str] = set()


@dataclass
class _Child:
    answer: socket.socket
    deadline: float
    late: bool = False


def keep(control: socket.socket) -> None:
    """Make a child for each message from ``control``, until that is closed or nothing was asked for five minutes.

    A message is a pickled function with its arguments and limits, and the descriptors of the answer about the child's
    end, of the reply, and of the files.
    """
    children: dict[int, _Child] = {}
    wake, woken = os.pipe()
    for end in (wake, woken):
        os.set_blocking(end, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(woken, warn_on_full_buffer=False)
    while True:
        by_answer = {child.answer: pid for pid, child in children.items()}
        waits = min([_IDLE_S, *(max(0.0, c.deadline - time.monotonic()) for c in children.values() if not c.late)])
        watched: list[Any] = [control, wake, *by_answer]
        ready = select.select(watched, [], [], waits)[0]
        if not ready and not children:
            return
        if wake in ready:
            with contextlib.suppress(BlockingIOError):
                os.read(wake, 4096)
        for pid in (by_answer[one] for one in ready if one in by_answer):
            os.kill(pid, signal.SIGKILL)  # the service gave up; not waited for yet, its number is its own
        for pid, child in children.items():
            if time.monotonic() >= child.deadline and not child.late:
                child.late = True
                os.kill(pid, signal.SIGKILL)
        while children:
            pid, status, used = os.wait4(-1, os.WNOHANG)
            if pid == 0:
                break
            child = children.pop(pid)
            with contextlib.suppress(OSError), child.answer:
                child.answer.send(reply.ENDED.pack(status, round(1e6 * (used.ru_utime + used.ru_stime)), child.late))
        if control in ready:
            message, descriptors, _, _ = socket.recv_fds(control, MAX_MESSAGE_BYTES, 2 + MAX_FILES)
            if not message:
                return
            _begin(message, descriptors, children)


def _begin(message: bytes, descriptors: list[int], children: dict[int, _Child]) -> None:
    answer, *passed = descriptors
    function, args, limits = pickle.loads(message)  # from the service alone; loads the reader's modules
    if function.__module__ not in _warm:
        import numpy.ma  # noqa: F401  # np.unique asks for it, and behind the walls nothing can be loaded

        _warm.add(function.__module__)
        getattr(sys.modules[function.__module__], "warm_up", int)()
    gc.freeze()
    parent, pid = os.getpid(), os.fork()
    if pid == 0:
        _read(function, args, limits, passed, parent)
    children[pid] = _Child(socket.socket(fileno=answer), time.monotonic() + limits.wall_s)
    for one in passed:
        os.close(one)


def _read(
    function: Callable[..., object], args: Sequence[Any], limits: sandbox.ReadingLimits, passed: list[int], parent: int
) -> None:
    """Read the files inside the sandbox, write the reply, and end."""
    code = 1
    try:
        signal.set_wakeup_fd(-1)
        for one in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT):
            signal.signal(one, signal.SIG_DFL)
        os.dup2(0, 1)  # nothing
        os.dup2(0, 2)
        kept = sorted({0, 1, 2, *passed})
        for before, after in pairwise([*kept, _MAX_DESCRIPTOR]):
            if before + 1 < after:
                os.closerange(before + 1, after)
        out, *files = (os.fdopen(one, "wb" if k == 0 else "rb", 0 if k == 0 else -1) for k, one in enumerate(passed))
        try:
            sandbox.enter(limits, len(kept), parent)
            reply.write_value(out, function(files, *args))
        except BaseException as error:  # noqa: BLE001 - carried to the service
            out.seek(0)
            out.truncate()
            reply.write_error(out, error)
        code = 0
    finally:
        os._exit(code)


def main() -> None:
    """Keep the readers for the service at the other end of the descriptor that is named."""
    lower_worker()
    for name in _ENCODINGS:  # Python loads each with its first use
        codecs.lookup(name)
    keep(socket.socket(fileno=int(sys.argv[1])))


if __name__ == "__main__":
    main()
