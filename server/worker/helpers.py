"""Workers without a task, called to help with one that another worker does."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass

from core.errors import Cancelled
from server.worker.executor import TaskExecutor, TaskFuture, WorkerDiedError
from server.worker.tile_task import TileTask, fit_tiles

_log = logging.getLogger("stereorig.tiles")

_CALLS = 2  # more where a helper died


@dataclass(eq=False)
class _Call:
    task: TileTask
    died: int = 0


class Helpers:
    """The helpers of a job's tasks. What they fail to do is done by who called them: their errors are for the log.

    Parameters
    ----------
    executor
        Its workers help.
    """

    def __init__(self, executor: TaskExecutor) -> None:
        self._executor = executor
        self._calls: deque[_Call] = deque()
        self._running: dict[TaskFuture, _Call] = {}

    def hear(self, future: TaskFuture) -> None:
        """Hear the calls of a task."""
        future.on_call = lambda task: self._calls.append(_Call(task))

    def look(self, *, busy: int) -> None:
        """Send workers where they are wanted; ``busy`` of them have tasks of their own."""
        for future in [one for one in self._running if one.done()]:
            self._ended(future, self._running.pop(future))
        while self._calls:
            call = self._calls[0]
            if not call.task.wanted:
                self._calls.popleft()
                continue
            room = self._executor.width - busy - len(self._running)
            if room < 1:
                return
            self._calls.popleft()
            for _ in range(min(room, call.task.tiles - 1)):
                self._running[self._executor.submit(fit_tiles, call.task)] = call

    def stop(self) -> None:
        """Stop those who help."""
        self._calls.clear()
        for future in list(self._running):
            future.request_stop()

    def _ended(self, future: TaskFuture, call: _Call) -> None:
        error = None if future.cancelled() else future.exception()
        if error is None or isinstance(error, Cancelled):
            return
        _log.warning("a worker that helped with a step failed, the step goes on without it: %s", error)
        if isinstance(error, WorkerDiedError) and call.died < _CALLS:
            call.died += 1
            self._calls.append(call)
