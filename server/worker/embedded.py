"""The embedded compute worker: one process of the service's own, restarted when it dies.

Kernels never run in the service's own process: in a thread there they would delay the event loop by tens of
milliseconds.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from stereorig.core.compiling import COMPILING
from stereorig.core.errors import Cancelled
from stereorig.server.base.logs import about, current_ids
from stereorig.server.worker.death import MemoryWatch, cause_of_death, resident_mib
from stereorig.server.worker.executor import TaskExecutor, TaskFuture, WorkerDiedError
from stereorig.server.worker.process import serve

_log = logging.getLogger("stereorig.worker")

_RESTART_PAUSE_S = 5.0
_POLL_S = 0.05
_MEMORY_S = 0.5


@dataclass(eq=False)
class _Task:
    id: int
    future: TaskFuture
    function: Callable[..., Any]
    args: tuple[Any, ...]
    kwargs: dict[str, object]
    #: ids for its log lines
    ids: dict[str, str] = field(default_factory=current_ids)


class ComputeWorker(TaskExecutor):
    """One process that runs one task at a time; spawned by :meth:`start` or with the first task.

    Parameters
    ----------
    threads
        Kernel threads inside the process; by default one per core.
    warm_up
        Function that the process calls with ``threads`` before its first task. Its module is imported before the
        numbers of threads are set: it must not load the numerical libraries itself.
    patience_s
        How long a cancelled task may take to stop before its process is ended.
    lowered
        Let the process come after other programs.
    """

    def __init__(
        self,
        *,
        threads: int | None = None,
        warm_up: Callable[[int], None] | None = None,
        patience_s: float = 0.5,
        lowered: bool = True,
    ) -> None:
        self._lowered = lowered
        self._threads = threads or len(os.sched_getaffinity(0))
        self._warm_up = warm_up
        self._patience_s = patience_s
        self._context = multiprocessing.get_context("spawn")
        self._tasks: queue.SimpleQueue[_Task | None] = queue.SimpleQueue()
        self._next_id = 0
        self._closing = threading.Event()
        self._state_lock = threading.Lock()
        self._process: multiprocessing.process.BaseProcess | None = None
        self._connection: Connection | None = None
        self._restart_at = 0.0
        self._kills, self._held_mib = MemoryWatch({}), None  # type: tuple[MemoryWatch, float | None]
        self.starts = 0
        self.ready = threading.Event()
        self.compiling = threading.Event()  # since the process began; until it is ready
        self._thread = threading.Thread(target=self._run, name="compute-worker", daemon=True)
        self._started = False

    def start(self) -> None:
        """Spawn the process and warm it up, without waiting for it; does nothing if that was done before."""
        with self._state_lock:
            self._start_once()

    def _start_once(self) -> None:
        if not self._started and not self._closing.is_set():
            self._started = True
            self._thread.start()

    @property
    def width(self) -> int:
        """Number of tasks that run at once."""
        return 1

    @property
    def pid(self) -> int | None:
        """Process id of the worker, if it runs."""
        process = self._process
        return process.pid if process is not None else None

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> TaskFuture:
        """Queue ``fn(*args, **kwargs)``; everything must pickle."""
        future = TaskFuture()
        with self._state_lock:
            if self._closing.is_set():
                raise RuntimeError("the compute worker is shut down")
            self._start_once()
            self._next_id += 1
            self._tasks.put(_Task(self._next_id, future, fn, args, kwargs))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:  # noqa: ARG002
        """End the process; running and waiting tasks are cancelled, even if ``cancel_futures`` is False."""
        with self._state_lock:
            self._closing.set()
            self._tasks.put(None)
        if wait and self._started:
            self._thread.join(timeout=10.0)

    # the thread that owns the process --------------------------------------------------------------------------

    def _run(self) -> None:
        self._spawn()
        while True:
            task = self._next_task()
            if task is None or self._closing.is_set():
                if task is not None and task.future.set_running_or_notify_cancel():
                    task.future.set_exception(Cancelled("The service is shutting down."))
                break
            if task.future.set_running_or_notify_cancel():
                with about(**task.ids):
                    self._work_on(task)
        self._end_process()
        with contextlib.suppress(queue.Empty):
            while True:
                left = self._tasks.get_nowait()
                if left is not None and left.future.set_running_or_notify_cancel():
                    left.future.set_exception(Cancelled("The service is shutting down."))

    def _next_task(self) -> _Task | None:
        # while idle, watch the process too: its death is noticed (and mended) before the next task needs it
        while True:
            with contextlib.suppress(queue.Empty):
                return self._tasks.get(timeout=0.2)
            self._drain_idle()
            now = time.monotonic()
            if self._process is not None and not self._process.is_alive() and now > self._restart_at:
                # one that cannot even start must not be started five times a second
                self._restart_at = now + _RESTART_PAUSE_S
                _log.warning("the idle compute worker ended (exit code %s); starting it again", self._process.exitcode)
                self._spawn()

    def _drain_idle(self) -> None:
        connection = self._connection
        with contextlib.suppress(EOFError, OSError):
            while connection is not None and connection.poll():
                self._note(connection.recv())

    def _note(self, message: tuple[Any, ...]) -> None:
        if message[0] == "ready":
            self.ready.set()
        elif message[0] == "compiling":
            self.compiling.set()
            _log.warning("%s", COMPILING)  # a warning reaches the service's terminal
        elif message[0] == "log":
            logging.getLogger(message[1].name).handle(message[1])

    def _spawn(self) -> None:
        self._end_process()
        self._held_mib = None
        self.ready.clear()
        self.compiling.clear()
        ours, theirs = self._context.Pipe()
        self._cancel = self._context.Event()
        process = self._context.Process(
            target=serve,
            args=(
                theirs,
                self._cancel,
                self._threads,
                self._warm_up,
                logging.getLogger().getEffectiveLevel(),
                self._lowered,
            ),
            name="stereorig-worker",
            daemon=True,
        )
        process.start()
        theirs.close()
        self._process, self._connection = process, ours
        self.starts += 1

    def _end_process(self, *, at_once: bool = False) -> None:
        process, self._process = self._process, None
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if process is not None:
            process.kill() if at_once else process.terminate()
            process.join(timeout=2.0)
            if process.is_alive():
                process.kill()
                process.join()
            with contextlib.suppress(ValueError):  # its end was taken note of elsewhere
                process.close()

    def _work_on(self, task: _Task) -> None:
        try:
            result = self._exchange(task)
        except Exception as error:  # noqa: BLE001 - it belongs to the future
            task.future.set_exception(error)
        else:
            task.future.set_result(result)
        if self._process is None and not self._closing.is_set():
            self._spawn()  # only now: the caller that waits for the task need not wait for the new process

    def _exchange(self, task: _Task) -> Any:
        if self._process is None or not self._process.is_alive():
            self._spawn()
        connection, process = self._connection, self._process
        assert connection is not None
        assert process is not None
        if not self._wait_ready(task, connection, process):
            return self._died(process)
        self._cancel.clear()
        self._kills, next_reading = MemoryWatch({}), 0.0
        try:
            connection.send((task.id, task.function, task.args, task.kwargs))
        except (BrokenPipeError, ConnectionResetError):
            return self._died(process)
        self._kills = MemoryWatch.now()  # the task does not wait for it
        stop_at: float | None = None
        while True:
            if stop_at is None and (task.future.stop_requested.is_set() or self._closing.is_set()):
                self._cancel.set()
                stop_at = time.monotonic() + self._patience_s
            if stop_at is not None and time.monotonic() > stop_at:
                self._end_process(at_once=True)
                raise Cancelled("The computation was cancelled.")
            if time.monotonic() > next_reading and process.pid is not None:
                next_reading = time.monotonic() + _MEMORY_S
                self._held_mib = resident_mib(process.pid) or self._held_mib
            try:
                if not connection.poll(_POLL_S):
                    if not process.is_alive() and not connection.poll():
                        return self._died(process)
                    continue
                message = connection.recv()
            except (EOFError, OSError):
                return self._died(process)
            self._note(message)
            if message[0] == "progress" and message[1] == task.id and task.future.on_progress is not None:
                task.future.on_progress(*message[2:])
            elif message[0] == "result" and message[1] == task.id:
                return message[2]
            elif message[0] == "error" and message[1] == task.id:
                _log.info("task %d failed:\n%s", task.id, message[3])
                raise message[2]

    def _wait_ready(self, task: _Task, connection: Connection, process: multiprocessing.process.BaseProcess) -> bool:
        # a task that is cancelled while the kernels warm up must not cost a restart
        announced = False
        while not self.ready.is_set():
            if self.compiling.is_set() and not announced and task.future.on_progress is not None:
                announced = True
                task.future.on_progress(COMPILING, 0, 1)
            if task.future.stop_requested.is_set() or self._closing.is_set():
                raise Cancelled("The computation was cancelled.")
            try:
                if connection.poll(_POLL_S):
                    self._note(connection.recv())
                elif not process.is_alive():
                    return False
            except (EOFError, OSError):
                return False
        return True

    def _died(self, process: multiprocessing.process.BaseProcess) -> Any:
        process.join(timeout=2.0)
        code, held_mib = process.exitcode, self._held_mib
        out_of_memory = self._kills.killed_since()
        cause = cause_of_death(code, out_of_memory=out_of_memory, memory_mib=held_mib)
        _log.error("the compute worker ended during a task, %s; starting it again", cause.rstrip("."))
        self._spawn()
        raise WorkerDiedError(
            f"The compute process ended while it worked, {cause}",
            exit_code=code,
            signal=None if code is None or code >= 0 else -code,
            out_of_memory=out_of_memory,
            memory_mib=held_mib,
        )
