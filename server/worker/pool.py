"""Several worker processes of the service's own as one executor: as many tasks at once as there are processes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from stereorig.server.worker.embedded import ComputeWorker
from stereorig.server.worker.executor import TaskExecutor, TaskFuture


class WorkerPool(TaskExecutor):
    """Gives each task to the process with the fewest; the processes start with the first task.

    Parameters
    ----------
    workers
        Not yet started; the pool shuts them down.
    """

    def __init__(self, workers: list[ComputeWorker]) -> None:
        self._workers = workers
        self._lock = threading.Lock()
        self._tasks = [0] * len(workers)

    @property
    def width(self) -> int:
        """Number of tasks that run at once."""
        return len(self._workers)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> TaskFuture:
        """Run ``fn(*args, **kwargs)`` in the process with the fewest tasks; everything must pickle."""
        with self._lock:
            k = self._tasks.index(min(self._tasks))
            self._tasks[k] += 1
        try:
            future = self._workers[k].submit(fn, *args, **kwargs)
        except BaseException:
            self._ended(k)
            raise
        future.add_done_callback(lambda _: self._ended(k))
        return future

    def _ended(self, k: int) -> None:
        with self._lock:
            self._tasks[k] -= 1

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """End the processes; running and waiting tasks are cancelled."""
        for worker in self._workers:
            worker.shutdown(wait, cancel_futures=cancel_futures)
