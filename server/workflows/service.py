"""The service: every part put together once, with no globals."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self

from stereorig.core.errors import StageError, StereorigError, StorageError
from stereorig.server.base.logs import log_job_event
from stereorig.server.base.metrics import Metrics
from stereorig.server.base.models import Ids
from stereorig.server.base.problem import hide_folder
from stereorig.server.base.streams import Streams
from stereorig.server.cell.cell import Cell
from stereorig.server.compute.functions import warm_up
from stereorig.server.config.rig_file import RigConfig
from stereorig.server.exports.process import ExportProcess
from stereorig.server.jobs.events import EventHub
from stereorig.server.jobs.hardware import HardwareHold
from stereorig.server.jobs.idempotency import OneEffect, RequestMark
from stereorig.server.jobs.job import Job
from stereorig.server.jobs.manager import JobManager
from stereorig.server.rig.build import check_config
from stereorig.server.rig.devices import DeviceFinder
from stereorig.server.rig.process.remote import RemoteRig, rig_process_lost
from stereorig.server.rig.rig import Rig
from stereorig.server.store.calibrations import CalibrationStore
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.certificates import CertificateStore
from stereorig.server.store.folder import DataFolder
from stereorig.server.store.indexing.build import Index
from stereorig.server.store.indexing.clean_stop import take_mark
from stereorig.server.store.models import ModelStore
from stereorig.server.store.noise import NoiseStore
from stereorig.server.store.recipes import RecipeStore
from stereorig.server.store.tests.tests import TestStore
from stereorig.server.store.trash import Trash
from stereorig.server.worker.dask_cluster import ClusterExecutor
from stereorig.server.worker.embedded import ComputeWorker
from stereorig.server.worker.executor import TaskExecutor
from stereorig.server.worker.pool import WorkerPool
from stereorig.server.workflows.analysis.checks import AnalysisChecks
from stereorig.server.workflows.analysis.framed import FramedResults
from stereorig.server.workflows.channels.kept import KeptReadings
from stereorig.server.workflows.channels.reading import ReadChannels

_log = logging.getLogger("stereorig.service")
_OPEN_WAIT_S = 5.0
#: a small data folder is read by then; of a large one the rest is read behind the service
_INDEX_WAIT_S = 1.0
# numbers stay below 2^53, which JavaScript can hold, for some centuries
_EVENTS_A_START = 1_000_000
_END_MOTION_S = 2.0
_REOPEN_S = 30.0
_KEPT_HALTS = 100


class Halts:
    """Stops that came through the front process, for the answers to the requests for them."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._cancelled: OrderedDict[int, str | None] = OrderedDict()

    def note(self, number: int, cancelled_job: str | None) -> None:
        """Note the job that a stop has cancelled."""
        with self._changed:
            self._cancelled[number] = cancelled_job
            while len(self._cancelled) > _KEPT_HALTS:
                self._cancelled.popitem(last=False)
            self._changed.notify_all()

    def cancelled_job(self, number: int, timeout_s: float) -> str | None:
        """Return the job that a stop has cancelled; None if there was none, or it is not known in time."""
        with self._changed:
            self._changed.wait_for(lambda: number in self._cancelled, timeout_s)
            return self._cancelled.get(number)


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
        A worker that was started already, so that it warms up earlier; the service ends it.
    devices
        The rig process, which opens the devices; by default they are opened in this process.
    home
        Home the axes at the start if the rig file asks for it.
    """

    def __init__(
        self,
        config: RigConfig,
        data: Path,
        *,
        record: Path | None = None,
        worker: ComputeWorker | None = None,
        devices: RemoteRig | None = None,
        home: bool = True,
    ) -> None:
        check_config(config)
        self.config = config
        # of a service of several processes the first one is known to its user
        self.folder = DataFolder(data, holder=None if devices is None else os.getppid())
        self.catalog = Catalog(self.folder.root / "catalog.sqlite")
        self.catalog.unsettled = self.folder.manifests.unsettled
        self.calibrations = CalibrationStore(self.folder)
        self.tests = TestStore(self.folder)
        self.noise = NoiseStore(self.folder)
        self.recipes = RecipeStore(self.folder)
        self.certificates = CertificateStore(self.folder)
        self.models = ModelStore(self.tests)
        self.trash = Trash(self.folder.root, self.folder.manifests)
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
        self.worker = worker or ComputeWorker(threads=config.service.kernel_threads, warm_up=warm_up)
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
            workers = [ComputeWorker(threads=threads, warm_up=warm_up) for _ in range(config.compute.processes)]
            self.executor = WorkerPool(workers)
        if devices is None:
            self.rig = Rig(config, self.hardware, self.hub.publish, record=record)
            self.finder = DeviceFinder()
        else:
            self.rig = Rig(config, self.hardware, self.hub.publish, record=record, opener=devices)
            self.finder = DeviceFinder(discover=devices.discover, ports=devices.ports)
            devices.on_stopped, devices.on_gone = self._stopped_outside, self._lose_rig
        #: stops that came through the front process: by number, the job that each has cancelled
        self.halts = Halts()
        self.channels = ReadChannels(config.channels, KeptReadings(self.tests, self.require_room))
        self.checks = AnalysisChecks(self.tests)
        self.exports = ExportProcess(self.folder.root)
        self.cell = Cell()
        self.framed = FramedResults(self.folder.root / ".exports" / "frames")  # removed with the exports
        # stopping must not wait behind forty slow requests
        self.stop_thread = ThreadPoolExecutor(max_workers=2, thread_name_prefix="stop")
        self.abort_thread = ThreadPoolExecutor(max_workers=4, thread_name_prefix="abort")
        self.started_monotonic = time.monotonic()
        self.closing = False
        #: held from the reading of a thing to its change, where a client names the state it means
        self.changes = threading.Lock()
        #: called when streams end, for the sources of some streams
        self.at_streams_end: list[Callable[[], None]] = []
        #: of the live measurement: its frames by fate, and True while it is running
        self.live_account: Callable[[], tuple[dict[str, int], bool]] | None = None
        self.continuing = threading.Lock()
        self._effects = OneEffect(self.catalog)
        self._ended_well = False
        self._end: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._end_thread = threading.Thread(target=self._await_end, name="end", daemon=True)
        self._home = home
        self._parts = contextlib.ExitStack()

    def start(self) -> Self:
        """Open folder and catalogue, start jobs and worker, open the rig.

        If a part fails, the parts opened before it are closed again. A device that is missing is no failure: it is
        shown with its fault, and looked for.

        Raises
        ------
        StateError, StorageError, FileFormatError
            As `stereorig.server.store.folder.DataFolder.open` and `stereorig.server.store.catalog.Catalog.open`.
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
            parts.callback(self.channels.stop)
            self.channels.start()
            self.exports.clear()
            parts.callback(self.exports.close)
            parts.callback(self.cell.close)
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
                self.rig.open(home=self._home)
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
        """Refuse when the data folder is gone, or less than the reserve is left on its disk."""
        self.folder.require_room(self.config.service.free_reserve_mib)

    def not_ready(self) -> list[dict[str, str]]:
        """Return why nothing can be captured or computed now: code and cause each; empty when all can."""
        reasons = []
        if self.closing:
            reasons.append({"code": "shutting_down", "cause": "The service is ending."})
        if self.rig.fault is not None:
            reasons.append({"code": self.rig.fault.code, "cause": self.rig.fault.detail})
        if not self.worker.ready.is_set():
            reasons.append({"code": "worker_starting", "cause": "The compute worker is starting."})
        try:
            self.require_room()
        except StorageError as error:
            reasons.append({"code": error.code, "cause": error.cause})
        if away := self.executor.away:
            reasons.append({"code": "scheduler_away", "cause": away})
        return reasons

    def _stopped_outside(self, number: int, ending: bool) -> None:
        """Follow a stop that the rig process has put on the wire already."""
        if ending:
            self._allow_no_motion()
            return
        cancelled = self.jobs.cancel_hardware()
        self.halts.note(number, cancelled)
        self.note_stop(cancelled)

    def note_stop(self, cancelled_job: str | None) -> None:
        """Announce that the stage was stopped, and stop it until a job that was cancelled has let it go."""
        if cancelled_job is not None:
            self.stop_until_released(cancelled_job)
        self.hub.publish("stage", {"stopped": True, "cancelled_job": cancelled_job})

    def _lose_rig(self) -> None:
        """Open the rig again, without homing it, after the rig process has ended and another one was started."""
        if self.closing:
            return
        self.rig.lose(rig_process_lost())
        self.note_stop(self.jobs.cancel_hardware())
        threading.Thread(target=self._open_rig_again, name="open the rig again", daemon=True).start()

    def _open_rig_again(self) -> None:
        deadline = time.monotonic() + _REOPEN_S
        while not self.closing and time.monotonic() < deadline:
            try:
                with self.hardware.hold("the opening of the rig, whose process had ended"):
                    self.hardware.call(lambda: self.rig.reconnect(home=False))
                    return
            except StereorigError as error:  # a job that has failed lets the hardware go a moment later
                if self.rig.is_open:
                    return  # without a device that is looked for
                _log.debug("the rig is not opened again yet: %s", error)
                time.sleep(0.1)

    def stop_job(self, job: Job) -> None:
        """Stop the stage for a job that is being cancelled, if it holds the hardware."""
        if self.rig.is_open and self.hardware.while_held_by(job.id, self.rig.stop):
            self.stop_until_released(job.id)

    def stop_until_released(self, job_id: str) -> None:
        """Continue to stop in the background, see :meth:`_stop_until_released`."""
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
        """Open folder and catalogue, and repair the traces of an end at any instant.

        Parameters
        ----------
        parts
            Gets the callbacks that close them again.

        Raises
        ------
        StateError, StorageError, FileFormatError
            As `start`.
        """
        parts.callback(hide_folder(self.folder.root))
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

    def _allow_no_motion(self) -> None:
        """Let no job begin, and interrupt the one that holds the hardware: the service ends."""
        self.closing = True
        self.hardware.shut()
        self.jobs.begin_close()
        self.jobs.cancel_hardware()

    def _end_motion(self) -> None:
        """Allow no new motion, and stop the one that runs until its job has let the hardware go."""
        self._allow_no_motion()
        deadline = time.monotonic() + _END_MOTION_S
        try:
            while self.rig.is_open:
                self.rig.stop()
                holder = self.hardware.holder
                if holder is None or holder.job_id is None or time.monotonic() > deadline:
                    return
                time.sleep(0.02)
        except StageError as error:
            _log.warning("the stage could not be stopped at shutdown: %s", error)
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
        """Run ``make`` once per Idempotency-Key, see :meth:`stereorig.server.jobs.idempotency.OneEffect.once`."""
        if scope.startswith("tests/"):
            self.index.read(scope.split("/")[1])  # its folder may know of keys that the catalogue lacks
        return self._effects.once(RequestMark(scope, key, body_sha256), make)
