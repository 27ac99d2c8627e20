"""Executors of tasks outside the service's process: the common base of the embedded worker and a cluster.

A task function finds its channel for progress and cancellation with
:func:`stereorig.server.worker.process.current_task`, so the same function runs under either.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any, Self

from stereorig.core.errors import MeasurementError

Progress = Callable[[str, int, int], None]


class WorkerDiedError(MeasurementError):
    """The compute process ended while it worked."""

    code = "worker_died"
    remedy = (
        "The worker has been started again, finished steps are kept: continue the analysis. If it dies again, look for "
        "memory limits, and report a signal other than SIGKILL with the service's log."
    )


class TaskFuture(Future[Any]):
    """A future with progress, and with cancellation of a running task."""

    def __init__(self) -> None:
        super().__init__()
        self.on_progress: Progress | None = None
        self.stop_requested = threading.Event()

    def request_stop(self) -> None:
        """Ask the task to stop, within a second: it raises :class:`stereorig.core.errors.Cancelled`, or is killed."""
        self.stop_requested.set()
        self.cancel()  # at once, if it has not begun


class FileTask(ABC):
    """A task that names files, which can be sent to a worker without the service's disk.

    Attributes
    ----------
    folder
        Where the function writes its results, and finds some of its files.
    """

    folder: Path

    @abstractmethod
    def files(self) -> list[Path]:
        """Return every file that the function reads, as far as they are there."""

    @abstractmethod
    def moved(self, folder: Path, there: Mapping[Path, Path]) -> Self:
        """Return the same task with its files elsewhere."""

    @abstractmethod
    def results(self) -> list[str]:
        """Return the names, in the folder, of the files that the function may write; the one that ends it last."""

    @abstractmethod
    def read_once(self) -> set[Path]:
        """Return the files that no later task reads again."""


class TaskExecutor(Executor):
    """Runs tasks; everything that goes to one and comes back must pickle."""

    def start(self) -> None:
        """Get ready before the first task, without waiting; does nothing if that was done before."""

    def __enter__(self) -> Self:
        self.start()
        return self

    @property
    @abstractmethod
    def width(self) -> int:
        """Number of tasks that run at once."""

    @property
    def away(self) -> str:
        """Reason why no task can run now, as a sentence; empty while tasks can."""
        return ""

    @abstractmethod
    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> TaskFuture:
        """Run ``fn(*args, **kwargs)`` when its turn comes."""
