"""A process for tasks that come now and then: started with the first, ended some time after the last."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from stereorig.core.errors import Cancelled
from stereorig.server.worker.embedded import ComputeWorker
from stereorig.server.worker.executor import TaskFuture

_REST_AFTER_S = 60.0


class RestingWorker:
    """Runs tasks one after the other, in a process that ends when it was idle for a minute."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._worker: ComputeWorker | None = None
        self._unfinished = 0
        self._rest: threading.Timer | None = None
        self._closed = False

    @property
    def unfinished(self) -> int:
        """Number of tasks that run or wait."""
        return self._unfinished

    @property
    def closed(self) -> bool:
        """True after :meth:`close`."""
        return self._closed

    def submit(self, task: Callable[..., Any], *args: Any) -> TaskFuture:
        """Begin a task; everything must pickle.

        Raises
        ------
        Cancelled
            After :meth:`close`.
        """
        with self._lock:
            if self._closed:
                raise Cancelled("The service is shutting down.")
            if self._rest is not None:
                self._rest.cancel()
                self._rest = None
            if self._worker is None:
                self._worker = ComputeWorker(threads=1)
            future = self._worker.submit(task, *args)
            self._unfinished += 1
        future.add_done_callback(self._done)
        return future

    def _done(self, _future: Future[Any]) -> None:
        with self._lock:
            self._unfinished -= 1
            if self._unfinished == 0 and not self._closed:
                self._rest = threading.Timer(_REST_AFTER_S, self._end)
                self._rest.daemon = True
                self._rest.start()

    def _end(self) -> None:
        with self._lock:
            if self._unfinished:
                return
            worker, self._worker = self._worker, None
        if worker is not None:
            worker.shutdown()

    def close(self) -> None:
        """End the process; tasks on their way fail."""
        with self._lock:
            self._closed = True
            worker, self._worker = self._worker, None
            rest, self._rest = self._rest, None
        if rest is not None:
            rest.cancel()
        if worker is not None:
            worker.shutdown()
