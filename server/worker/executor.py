"""Executors of tasks outside the service's process: what the embedded worker and a cluster have in common.

A task function finds its channel for progress and cancellation with :func:`server.worker.process.current_task`, so the
same function runs under either.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, Self

from core.errors import MeasurementError

Progress = Callable[[str, int, int], None]


class WorkerDiedError(MeasurementError):
    """The compute process ended while it worked."""

    code = "worker_died"
    remedy = (
        "The worker has been started again, finished steps are kept: continue the analysis. If it dies again, look for "
        "memory limits, and report a signal other than SIGKILL with the service's log."
    )


class TaskFuture(Future[Any]):
    """A future with progress, with calls for help, and with cancellation of a running task."""

    def __init__(self) -> None:
        super().__init__()
        self.on_progress: Progress | None = None
        self.on_call: Callable[[Any], None] | None = None
        self.stop_requested = threading.Event()

    def request_stop(self) -> None:
        """Ask the task to stop; it ends with :class:`core.errors.Cancelled` within a second, by force if need be."""
        self.stop_requested.set()
        self.cancel()  # at once, if it has not begun


class TaskExecutor(Executor):
    """Runs tasks; everything that goes to one and comes back must pickle."""

    def start(self) -> None:
        """Get ready before the first task, without waiting; nothing where that was done before."""

    def __enter__(self) -> Self:
        self.start()
        return self

    @property
    @abstractmethod
    def width(self) -> int:
        """Number of tasks that run at once."""

    @property
    def shares_files(self) -> bool:
        """True if the workers see the service's data folder."""
        return True

    @abstractmethod
    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> TaskFuture:
        """Run ``fn(*args, **kwargs)`` when its turn comes."""
