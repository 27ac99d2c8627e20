"""Tasks on a Dask worker: the same task functions as in the service's own worker, one at a time in a process.

If the worker shares no disk with the service, a step comes with the content of its files and its result is returned as
content; in between both are files in a folder of the worker's own.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stereorig.server.worker import process as worker_process
from stereorig.server.worker.executor import FileTask
from stereorig.server.worker.kernel_compiler import compiled_aside
from stereorig.server.worker.process import TaskChannel

_REPORT_S = 0.2
_MAX_STOPPED = 10_000
_one_at_a_time = threading.Lock()  # kernels of numba's must not be called by two threads at once
_stopped: OrderedDict[str, None] = OrderedDict()
_ready = False


def stop(name: str) -> None:
    """Let a task that runs here end; harmless if it runs elsewhere."""
    _stopped[name] = None
    while len(_stopped) > _MAX_STOPPED:
        _stopped.popitem(last=False)


class _Channel(TaskChannel):
    """Progress through the scheduler, a few times a second; cancellation by :func:`stop`."""

    def __init__(self, name: str, report_progress: Callable[[dict[str, object]], None]) -> None:
        super().__init__(lambda _: None, 0, None)
        self._name = name
        self._report_progress = report_progress
        self._next = 0.0
        self._phase = ""

    @property
    def cancelled(self) -> bool:
        return self._name in _stopped

    def progress(self, phase: str, done: int, total: int) -> None:
        now = time.monotonic()
        if phase != self._phase or now >= self._next:
            self._phase, self._next = phase, now + _REPORT_S
            self._report_progress({"task": self._name, "phase": phase, "done": done, "total": total})


def run(name: str, topic: str, threads: int, function: Callable[..., Any], *args: Any) -> Any:
    """Run a task that finds its files by their paths.

    Parameters
    ----------
    name
        Name of the task, for :func:`stop` and for its progress.
    topic
        Topic of the cluster's events to which its progress is reported.
    threads
        Kernel threads of this worker.
    """
    from distributed import get_worker

    worker = get_worker()
    with _one_at_a_time, compiled_aside():
        _prepare(threads)
        channel = _Channel(name, lambda report: worker.log_event(topic, report))
        worker_process._current = channel
        try:
            channel.check()
            return function(*args)
        finally:
            worker_process._current = None


def _prepare(threads: int) -> None:
    global _ready
    if _ready:
        return
    import cv2

    from stereorig.core.threads import available_threads, set_threads

    cv2.setNumThreads(1)
    set_threads(min(threads, available_threads()))
    _ready = True


def run_with_files(
    name: str,
    topic: str,
    threads: int,
    function: Callable[[FileTask], Any],
    task: FileTask,
    contents: dict[Path, bytes],
) -> tuple[Any, dict[str, bytes]]:
    """Run a task with the content of its files; return the function's answer, and the files that it wrote.

    Parameters
    ----------
    contents
        By path on the service's machine, every file that the task reads.
    """
    root = _folder() / hashlib.sha256(str(task.folder).encode()).hexdigest()[:24]
    folder = root / "results"
    folder.mkdir(parents=True, exist_ok=True)
    there = {}
    for path, content in contents.items():
        name = (
            path.name
            if path.parent == task.folder
            else f"{hashlib.sha256(str(path).encode()).hexdigest()[:16]}-{path.name}"
        )
        target = there[path] = (folder if path.parent == task.folder else root) / name
        # the reference's files are the same each time: a file that is there is not written again
        if not target.exists() or target.stat().st_size != len(content) or target.read_bytes() != content:
            temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
            temporary.write_bytes(content)
            temporary.replace(target)
    moved = task.moved(folder, there)
    answer = run(name, topic, threads, function, moved)
    written = {file: (folder / file).read_bytes() for file in task.results() if (folder / file).is_file()}
    with contextlib.suppress(OSError):
        for read in moved.read_once():
            read.unlink(missing_ok=True)
    return answer, written


_kept: tempfile.TemporaryDirectory[str] | None = None


def _folder() -> Path:
    """Return the process' own folder; it goes with the process."""
    global _kept
    if _kept is None:
        _kept = tempfile.TemporaryDirectory(prefix="stereorig-")
    return Path(_kept.name)
