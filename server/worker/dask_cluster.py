"""A Dask cluster as an executor: the same interface as the service's own worker, and as many tasks at once as it has.

A task whose worker dies is given to another one by the scheduler. Content that was scattered to a dead worker is
scattered again.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import InvalidStateError
from pathlib import Path
from typing import Any, Literal

from stereorig.core.errors import Cancelled, InputError, MeasurementError
from stereorig.server.formats.files import make_folder, written_temporary
from stereorig.server.formats.manifest import checked_bytes
from stereorig.server.worker import dask_task
from stereorig.server.worker.executor import FileTask, TaskExecutor, TaskFuture, WorkerDiedError

_log = logging.getLogger("stereorig.cluster")

_CONNECT_S = 10.0
_ATTEMPTS = 4
_COUNT_S = 1.0
_LOOK_S = 2.0
Images = Literal["path", "scatter"]


class ClusterError(MeasurementError):
    """The Dask cluster cannot be reached, or gave a task up."""

    code = "cluster_unreachable"
    remedy = "Check that the scheduler of [compute] runs and can be reached, then continue the analysis."


class ClusterFuture(TaskFuture):
    """A task on the cluster."""

    def __init__(self, stop: Callable[[ClusterFuture], None]) -> None:
        super().__init__()
        self.name = secrets.token_hex(8)
        self.remote: Any = None
        self._stop = stop

    def request_stop(self) -> None:
        """End it: at once for its waiters, and on its worker at its next check."""
        if not self.stop_requested.is_set():
            self.stop_requested.set()
            self._stop(self)


class ClusterExecutor(TaskExecutor):
    """Runs tasks on a Dask cluster.

    Parameters
    ----------
    scheduler
        Address, ``tcp://host:8786``.
    images
        ``path``: workers see the service's data folder under the same path. ``scatter``: files travel with the step.
    threads
        Kernel threads of each worker.
    at_least
        Number of tasks to be given to it at once, however few workers it has now: one that grows while tasks wait.

    Raises
    ------
    InputError
        ``dask_missing`` when Dask is not installed.
    """

    def __init__(self, scheduler: str, *, images: Images = "path", threads: int = 1, at_least: int = 1) -> None:
        try:
            import distributed
        except ImportError as error:
            raise InputError(
                "[compute] names a scheduler, and Dask is not installed.",
                code="dask_missing",
                remedy="Install it: pip install 'stereorig[dask]'.",
            ) from error
        self._dask = distributed
        self._scheduler = scheduler
        self._images = images
        self._threads = threads
        self._at_least = at_least
        self._topic = f"stereorig-{secrets.token_hex(6)}"
        self._lock = threading.Lock()
        self._client: Any = None
        self._running: dict[str, ClusterFuture] = {}
        self._closed = False
        self._workers, self._count_again = 0, 0.0
        self._away, self._look_again = "", 0.0

    def _connected(self) -> Any:
        with self._lock:
            if self._closed:
                raise Cancelled("The service is shutting down.")
            client = self._client
            if client is not None and client.status != "running":
                with contextlib.suppress(Exception):
                    client.close(timeout=1)
                client = self._client = None
            if client is None:
                try:
                    client = self._dask.Client(  # type: ignore[no-untyped-call]
                        self._scheduler, timeout=_CONNECT_S, set_as_default=False, name="stereorig"
                    )
                except (OSError, TimeoutError, ValueError) as error:
                    raise ClusterError(f"The scheduler {self._scheduler} does not answer: {error}.") from error
                client.subscribe_topic(self._topic, self._on_event)  # type: ignore[no-untyped-call]
                self._client = client
            return client

    @property
    def width(self) -> int:
        """Number of tasks that run at once: one a worker, or as many as it is to have."""
        if time.monotonic() > self._count_again:
            self._count_again = time.monotonic() + _COUNT_S
            self._workers = len(self._connected().scheduler_info(n_workers=-1)["workers"])
        return max(self._at_least, self._workers)

    @property
    def away(self) -> str:
        """Reason why no task can run now: the scheduler does not answer."""
        client = self._client
        if client is not None and client.status == "running":
            return ""
        if time.monotonic() > self._look_again:
            self._look_again = time.monotonic() + _LOOK_S
            self._away = _refusal(self._scheduler)
        return self._away

    def _on_event(self, event: tuple[Any, dict[str, Any]]) -> None:
        report = event[1]
        future = self._running.get(report["task"])
        if future is not None and future.on_progress is not None:
            future.on_progress(report["phase"], int(report["done"]), int(report["total"]))

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> ClusterFuture:
        """Give a task to the cluster; everything must pickle, and the workers must have the program installed."""
        if kwargs:
            raise TypeError("tasks of the cluster take no keywords")
        future = ClusterFuture(self._stop)
        future.set_running_or_notify_cancel()
        self._running[future.name] = future
        try:
            self._launch(future, fn, args, 1)
        except BaseException:
            self._running.pop(future.name, None)
            raise
        return future

    def _launch(self, future: ClusterFuture, fn: Callable[..., Any], args: tuple[Any, ...], attempt: int) -> None:
        client = self._connected()
        head = (future.name, self._topic, self._threads, fn)
        with_files = self._images == "scatter" and len(args) == 1 and isinstance(args[0], FileTask)
        more: dict[str, Any] = {"key": f"stereorig-{future.name}-{attempt}", "pure": False}
        if with_files:
            contents = {path: _content(client, path) for path in args[0].files()}
            future.remote = client.submit(dask_task.run_with_files, *head, args[0], contents, **more)
        else:
            future.remote = client.submit(dask_task.run, *head, *args, **more)
        folder = args[0].folder if with_files else None
        future.remote.add_done_callback(lambda remote: self._done(future, remote, fn, args, attempt, folder))

    def _done(
        self,
        future: ClusterFuture,
        remote: Any,
        fn: Callable[..., Any],
        args: tuple[Any, ...],
        attempt: int,
        folder: Path | None,
    ) -> None:
        """Called by Dask, in a thread of its own, when a task has succeeded, failed or was lost."""
        if future.done():
            return
        try:
            if remote.status == "finished":
                result = remote.result(timeout=60)
                if folder is not None:
                    result = _keep(folder, *result)
                self._settle(future, result=result)
                return
            error = remote.exception(timeout=60) if remote.status == "error" else None
            if error is not None and not isinstance(error, self._dask.scheduler.KilledWorker | FileNotFoundError):
                self._settle(future, error=error)
            elif isinstance(error, self._dask.scheduler.KilledWorker):
                self._settle(future, error=WorkerDiedError(f"Workers of the cluster died on a step: {error}."))
            elif attempt < _ATTEMPTS and not future.stop_requested.is_set() and not self._closed:
                # its data were on a worker that is gone
                _log.warning("a task was lost with its worker's data; it is sent again")
                self._launch(future, fn, args, attempt + 1)
            else:
                self._settle(future, error=error or ClusterError("The cluster gave a step up."))
        except Exception as problem:  # noqa: BLE001 - it belongs to the future
            self._settle(future, error=problem)

    def _settle(self, future: ClusterFuture, *, result: Any = None, error: BaseException | None = None) -> None:
        self._running.pop(future.name, None)
        future.remote = None  # lets the cluster forget the result
        with contextlib.suppress(InvalidStateError):  # it was stopped since
            if error is not None:
                future.set_exception(error)
            else:
                future.set_result(result)

    def _stop(self, future: ClusterFuture) -> None:
        client, remote = self._client, future.remote
        self._settle(future, error=Cancelled("The computation was cancelled."))

        def cancel_remote() -> None:
            with contextlib.suppress(Exception):  # a cluster that is gone has nothing to stop
                client.cancel([remote], asynchronous=False)
                client.run(dask_task.stop, future.name, wait=False)

        if client is not None and remote is not None:
            threading.Thread(target=cancel_remote, name="stop on the cluster", daemon=True).start()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:  # noqa: ARG002
        """Stop running tasks and disconnect from the cluster, which continues."""
        self._closed = True
        for future in list(self._running.values()):
            future.request_stop()
        with self._lock:
            client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):
                client.close(timeout=2)


def _refusal(scheduler: str) -> str:
    """Return why a scheduler takes no connection; empty if it does."""
    host, _, port = scheduler.removeprefix("tcp://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=1.0).close()
    except OSError as error:
        return f"The Dask scheduler of [compute] does not answer ({error.strerror or error})."
    return ""


def _content(client: Any, path: Path) -> Any:
    """A file's content on the cluster; the same content is sent once."""
    return client.scatter(checked_bytes(path), hash=True, direct=False)


def _keep(folder: Path, answer: Any, written: dict[str, bytes]) -> Any:
    """Write the files of a worker without our disk; the result last, with its checksum."""
    for name, content in written.items():
        make_folder((folder / name).parent)
        with written_temporary(folder / name, checksum=name.endswith(".nc")) as temporary:
            temporary.write_bytes(content)
    return answer
