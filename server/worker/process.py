"""The compute worker's side: one process, spawned, with warm kernels.

Imports nothing heavy before the thread counts are pinned, since the numerical libraries read them once, when they are
loaded.
"""

from __future__ import annotations

import contextlib
import copy
import faulthandler
import gc
import logging
import os
import signal
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from typing import Any

from stereorig.core.compiling import COMPILING, report_compiling
from stereorig.core.errors import Cancelled
from stereorig.server.base.library_threads import one_library_thread
from stereorig.server.base.priority import end_with_parent, lower_worker, settle
from stereorig.server.worker.kernel_compiler import compiled_aside

_log = logging.getLogger("stereorig.worker")
_current: TaskChannel | None = None


class TaskChannel:
    """A running task's channel to its caller: progress out, cancellation in.

    Attributes
    ----------
    keeps_going
        True if the next task comes to this process too, so that it can be begun before it is asked for.
    """

    def __init__(
        self, send: Callable[[tuple[Any, ...]], None], task_id: int, cancel: Event | None, *, keeps_going: bool = False
    ) -> None:
        self._send = send
        self._task_id = task_id
        self._cancel = cancel
        self.keeps_going = keeps_going

    @property
    def cancelled(self) -> bool:
        """Return True if the task should stop."""
        return self._cancel is not None and self._cancel.is_set()

    def check(self) -> None:
        """Raise :class:`stereorig.core.errors.Cancelled` if the task should stop."""
        if self.cancelled:
            raise Cancelled("The computation was cancelled.")

    def progress(self, phase: str, done: int, total: int) -> None:
        """Report progress."""
        self._send(("progress", self._task_id, phase, done, total))


def current_task() -> TaskChannel:
    """Return the running task's channel; one that leads nowhere outside the worker (another executor, a test)."""
    return _current if _current is not None else TaskChannel(lambda _: None, 0, None)


def pin_threads(threads: int) -> None:
    """Set the thread counts of every numerical library; before they are imported."""
    one_library_thread(asked=False)
    os.environ["NUMBA_NUM_THREADS"] = str(threads)


class LogHandler(logging.Handler):
    """Sends log records to the service, which adds the task and formats the lines."""

    def __init__(self, send: Callable[[tuple[Any, ...]], None]) -> None:
        super().__init__()
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record, its arguments and traceback as text."""
        travelling = copy.copy(record)
        travelling.msg, travelling.args = record.getMessage(), None
        if record.exc_info:
            travelling.exc_text = logging.Formatter().formatException(record.exc_info)
            travelling.exc_info = None
        with contextlib.suppress(OSError):  # the service is gone
            self._send(("log", travelling))


def serve(
    connection: Connection,
    cancel: Event,
    threads: int,
    warm_up: Callable[[int], None] | None,
    log_level: int = logging.WARNING,
    lowered: bool = True,
) -> None:
    """Run tasks from ``connection`` one after another until it closes; ``lowered`` behind other programs."""
    global _current
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the service's to handle
    faulthandler.enable()  # a fault in compiled code leaves its traceback on the terminal
    end_with_parent()
    pin_threads(threads)
    import cv2

    cv2.setNumThreads(1)
    lock = threading.Lock()

    def send(message: tuple[Any, ...]) -> None:
        with lock:
            connection.send(message)

    logging.getLogger().addHandler(LogHandler(send))
    logging.getLogger().setLevel(max(log_level, logging.INFO))  # below it, libraries log every detail
    if warm_up is not None:
        try:
            with compiled_aside(), report_compiling(lambda: send(("compiling",))):
                warm_up(threads)
        except Exception:  # noqa: BLE001 - the first task will report the error to its caller
            _log.exception("warming up failed")
    settle()
    if lowered:
        lower_worker()  # not before: the service waits for it to be ready
    send(("ready",))
    while True:
        try:
            task_id, function, args, kwargs = connection.recv()
        except (EOFError, OSError):
            return  # the service is gone
        _current = channel = TaskChannel(send, task_id, cancel, keeps_going=True)
        try:
            with (
                compiled_aside(),
                report_compiling(lambda channel=channel: channel.progress(COMPILING, 0, 1)),  # type: ignore[misc]
            ):
                result = function(*args, **kwargs)
        except BaseException as error:  # noqa: BLE001 - carried back to the caller
            _reply_error(send, task_id, error)
        else:
            send(("result", task_id, result))
        _current = result = args = kwargs = None
        # a task's reference cycles are few objects, which the collector would leave, but large: they hold images
        gc.collect()


def _reply_error(send: Callable[[tuple[Any, ...]], None], task_id: int, error: BaseException) -> None:
    trace = "".join(traceback.format_exception(error))
    try:
        send(("error", task_id, error, trace))
    except Exception:  # noqa: BLE001 - an error that cannot be pickled still has its text
        send(("error", task_id, RuntimeError(f"{type(error).__name__}: {error}"), trace))
