"""The service: every part put together once, with no globals."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self

from core.errors import StereorigError, StorageError
from server.base.logs import log_job_event
from server.base.metrics import Metrics
from server.base.models import Ids
from server.base.streams import Streams
from server.config.rig_file import RigConfig
from server.exports.process import ExportProcess
from server.jobs.events import EventHub
from server.jobs.hardware import HardwareHold
from server.jobs.idempotency import OneEffect, RequestMark
from server.jobs.job import Job
from server.jobs.manager import JobManager
from server.rig import Rig
from server.rig.build import check_config
from server.rig.devices import DeviceFinder
from server.store.calibrations import CalibrationStore
from server.store.catalog import Catalog
from server.store.certificates import CertificateStore
from server.store.folder import DataFolder
from server.store.indexing.build import Index
from server.store.indexing.clean_stop import take_mark
from server.store.models import ModelStore
from server.store.noise import NoiseStore
from server.store.recipes import RecipeStore
from server.store.tests.tests import TestStore
from server.store.trash import Trash
from server.worker.dask_cluster import ClusterExecutor
from server.worker.embedded import ComputeWorker, make_worker
from server.worker.executor import TaskExecutor
from server.worker.pool import WorkerPool
from server.workflows.analysis.checks import AnalysisChecks
from server.workflows.analysis.framed import FramedResults

_log = logging.getLogger("stereorig.service")
_OPEN_WAIT_S = 5.0
#: a small data folder is read by then; of a large one the rest is read behind the service
_INDEX_WAIT_S = 1.0
# numbers stay below 2^53, which JavaScript can hold, for some centuries
_EVENTS_A_START = 1_000_000
_END_MOTION_S = 2.0


class Service:
    """Rig, store, jobs and worker of one service; nothing is opened before :meth:`start`.

    Parameters
    ----------
    config
        The rig file.
    data
        The data folder; locked from the start to the close.
    record
        File that gets a transcript of the stage's wire.
    worker
        One that was started already, so that it gets warm meanwhile; the service ends it.
    """

    def __init__(
        self, config: RigConfig, data: Path, *, record: Path | None = None, worker: ComputeWorker | None = None
    ) -> None:
        check_config(config)
        self.config = config
        self.folder = DataFolder(data)
        self.catalog = Catalog(self.folder.root / "catalog.sqlite")
        self.calibrations = CalibrationStore(self.folder)
        self.tests = TestStore(self.folder)
        self.noise = NoiseStore(self.folder)
        self.recipes = RecipeStore(self.folder)
        self.certificates = CertificateStore(self.folder)
        self.models = ModelStore(self.tests)
        self.trash = Trash(self.folder.root)
        self.index = Index(self.catalog, self.folder, self.calibrations, self.tests, self.noise)
        self.metrics = Metrics()
        self.hub = EventHub()
        self.hub.listen(self.metrics.on_event)
        self.hub.listen(log_job_event)
        self.streams = Streams(live_view=config.service.live_views, events=config.service.event_streams)
        self.hardware = HardwareHold()
        self.jobs = JobManager(
            self.catalog, self.hub, self.hardware, self.folder.ids, queue_limit=config.service.compute_queue
        )
        self.worker = worker or make_worker(config.service.kernel_threads)
        self.executor: TaskExecutor = self.worker  # of analyses
        if config.compute.scheduler is not None:
            self.executor = ClusterExecutor(
                config.compute.scheduler,
                images=config.compute.images,
                threads=config.compute.threads_per_worker,
                at_least=config.compute.tasks_at_once or 1,
            )
        elif config.compute.processes > 1:
            threads = config.compute.threads_per_worker
            self.executor = WorkerPool([make_worker(threads) for _ in range(config.compute.processes)])
        self.rig = Rig(config, self.hardware, self.hub.publish, record=record)
        self.finder = DeviceFinder()
        self.checks = AnalysisChecks(self.tests)
        self.exports = ExportProcess(self.folder.root)
        self.framed = FramedResults(self.folder.root / ".exports" / "frames")  # removed with the exports
        # stopping must not wait behind forty slow requests
        self.stop_thread = ThreadPoolExecutor(max_workers=2, thread_name_prefix="stop")
        self.abort_thread = ThreadPoolExecutor(max_workers=4, thread_name_prefix="abort")
        self.started_monotonic = time.monotonic()
        self.closing = False
        #: held from the reading of a thing to its change, where a client names the state it means
        self.changes = threading.Lock()
        #: called where streams end: what feeds some of them
        self.at_streams_end: list[Callable[[], None]] = []
        #: of the live measurement: its frames by fate, and whether it goes on
        self.live_account: Callable[[], tuple[dict[str, int], bool]] | None = None
        self.continuing = threading.Lock()
        self._effects = OneEffect(self.catalog)
        self._ended_well = False
        self._end: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._end_thread = threading.Thread(target=self._await_end, name="end", daemon=True)
        self._parts = contextlib.ExitStack()

    def start(self) -> Self:
        """Open folder and catalogue, start jobs and worker, open the rig.

        What was opened before a part that fails is closed again. A rig that cannot be opened does not fail: it is shown
        as a fault.

        Raises
        ------
        StateError, StorageError, FileFormatError
            As `server.store.folder.DataFolder.open` and `server.store.catalog.Catalog.open`.
        """
        with contextlib.ExitStack() as parts:  # closed from the last to the first
            self.open_data(parts)
            # the clock alone may step back, and the catalogue alone may be lost
            self.hub.number_from(_EVENTS_A_START * self.catalog.count_up("starts", int(time.time())))
            parts.callback(self.checks.close)
            parts.callback(self.abort_thread.shutdown, wait=False)
            parts.callback(self.stop_thread.shutdown, wait=False)
            parts.callback(self.rig.close)
            parts.callback(self.hardware.close)
            self.exports.clear()
            parts.callback(self.exports.close)
            self.worker.start()
            parts.callback(self.worker.shutdown)
            self.executor.start()
            parts.callback(self.executor.shutdown)
            self.jobs.start()
            parts.callback(self.jobs.close)
            self._end_thread.start()
            parts.callback(self._end_thread.join, timeout=_END_MOTION_S + 2.0)
            parts.callback(self.begin_end)
            parts.callback(self.stop_streams)
            self._open_rig()
            threading.Thread(target=self.certificates.learn, name="certificates", daemon=True).start()
            self.index.wait(_INDEX_WAIT_S)
            self._parts = parts.pop_all()
        return self

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open_rig(self) -> None:
        """Open the rig on its owner thread, so that the first request finds it; one that hangs is left to itself."""
        opened = threading.Event()
        token = self.hardware.claim("the opening of the rig")

        def open_rig() -> None:
            try:
                self.rig.open()
            finally:
                self.hardware.release(token)
                opened.set()

        self.hardware.start(open_rig)
        opened.wait(timeout=_OPEN_WAIT_S)

    def _end_index(self) -> None:
        """End the reading; note whether the next start may believe the index."""
        whole = self.index.close()
        self._ended_well = whole and self.jobs.is_idle() and self._effects.all_written and not self.hardware.holder

    def _leave_mark(self) -> None:
        """Say that the index may be believed, once the catalogue is closed."""
        if not self._ended_well or self.catalog.write_failed:
            return
        try:
            self.index.leave_mark()
        except (StorageError, OSError) as error:
            _log.warning("the next start reads all tests again: %s", error)

    def require_room(self) -> None:
        """Refuse with ``storage_full`` when less than the reserve is left on the disk."""
        self.folder.require_room(self.config.service.free_reserve_mib)

    def not_ready(self) -> list[dict[str, str]]:
        """Return why nothing can be captured or computed now: code and cause each; empty when all can."""
        reasons = []
        if self.closing:
            reasons.append({"code": "shutting_down", "cause": "The service is ending."})
        if self.rig.fault is not None:
            reasons.append({"code": self.rig.fault.code, "cause": self.rig.fault.cause})
        if not self.worker.ready.is_set():
            reasons.append({"code": "worker_starting", "cause": "The compute worker is starting."})
        try:
            self.require_room()
        except StorageError as error:
            reasons.append({"code": error.code, "cause": error.cause})
        return reasons

    def stop_job(self, job: Job) -> None:
        """Stop the stage for a job that is being cancelled, if it holds the hardware."""
        if self.rig.fault is None and self.hardware.while_held_by(job.id, self.rig.stop):
            self.stop_until_released(job.id)

    def stop_until_released(self, job_id: str) -> None:
        """Go on stopping in the background, see :meth:`_stop_until_released`."""
        threading.Thread(target=self._stop_until_released, args=(job_id,), name="stop again", daemon=True).start()

    def _stop_until_released(self, job_id: str) -> None:
        """Stop the stage until a cancelled job has let the hardware go.

        A job that passed its last check just before it was cancelled may start a motion just after the first stop.
        Once it has let go, the next motion is another client's and must not be stopped.
        """
        for _ in range(100):
            time.sleep(0.02)
            try:
                if self.closing or not self.hardware.while_held_by(job_id, self.rig.stop):
                    return
            except StereorigError as error:  # the job closes the rig just now, or the line was lost
                _log.debug("stopping again failed: %s", error)

    def open_data(self, parts: contextlib.ExitStack) -> None:
        """Open folder and catalogue, and put in order what an end at any instant left there.

        Parameters
        ----------
        parts
            Gets what closes them again.

        Raises
        ------
        StateError, StorageError, FileFormatError
            As `start`.
        """
        self.folder.open()
        parts.callback(self.folder.close)
        known = take_mark(self.catalog.path)
        parts.callback(self._leave_mark)
        self.catalog.open(sound=known is not None)
        parts.callback(self.catalog.close)
        self.noise.end_unfinished()
        self.recipes.reserve_ids()
        self.certificates.reserve_ids()
        self.index.begin(known)
        parts.callback(self._end_index)
        self.index.start()

    def is_alive(self) -> bool:
        """Return True if the threads that everything waits for run."""
        return self.catalog.alive and self.jobs.alive

    def begin_end(self) -> None:
        """Have the stage stopped, at once and in the background; a signal handler may call it: it takes no lock."""
        self._end.put(True)

    def _await_end(self) -> None:
        if self._end.get():
            self._end_motion()

    def _end_motion(self) -> None:
        """Allow no new motion, and stop the one that runs until its job has let the hardware go."""
        self.closing = True
        self.hardware.shut()
        self.jobs.begin_close()
        self.jobs.cancel_hardware()
        deadline = time.monotonic() + _END_MOTION_S
        try:
            while self.rig.fault is None:
                self.rig.stop()
                holder = self.hardware.holder
                if holder is None or holder.job_id is None or time.monotonic() > deadline:
                    return
                time.sleep(0.02)
        except Exception:  # noqa: BLE001 - closing the rig tries again
            _log.exception("the stage could not be stopped at shutdown")

    def stop_streams(self) -> None:
        """End live views and event streams, which would otherwise outlast every shutdown."""
        self.closing = True
        self.hub.close()
        for end in self.at_streams_end:
            end()

    def close(self) -> None:
        """Stop the stage first, then jobs, worker, rig and files; safe to call twice."""
        self._parts.close()

    def once(self, scope: str, key: str | None, body_sha256: str, make: Callable[[], Ids]) -> tuple[Ids, bool]:
        """Run ``make`` once per Idempotency-Key, see :meth:`server.jobs.idempotency.OneEffect.once`."""
        if scope.startswith("tests/"):
            self.index.read(scope.split("/")[1])  # its folder may know of keys that the catalogue lacks
        return self._effects.once(RequestMark(scope, key, body_sha256), make)
