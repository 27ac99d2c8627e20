"""The service: every part put together once, with no globals."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from core.errors import StateError
from server.config import RigConfig
from server.events import EventHub
from server.hardware import HardwareGate
from server.jobs import Job, JobManager
from server.rig import Rig
from server.rig.build import check_config
from server.store.calibrations import CalibrationStore
from server.store.catalog import Catalog
from server.store.folder import DataFolder
from server.store.index import rebuild
from server.store.noise import NoiseStore
from server.store.tests import TestStore
from server.worker import ComputeWorker

_log = logging.getLogger("stereorig.service")
_OPEN_WAIT_S = 5.0


class Service:
    """Rig, store, jobs and worker of one running service.

    Parameters
    ----------
    config
        The rig file.
    data
        The data folder; locked while the service runs.
    """

    def __init__(self, config: RigConfig, data: Path) -> None:
        check_config(config)
        self.config = config
        self.folder = DataFolder(data)
        try:
            self.catalog = Catalog(self.folder.root / "catalog.sqlite")
        except BaseException:
            self.folder.close()
            raise
        self.calibrations = CalibrationStore(self.folder)
        self.tests = TestStore(self.folder)
        self.noise = NoiseStore(self.folder)
        self.differences = rebuild(self.catalog, self.folder, self.calibrations, self.tests)
        for line in self.differences:
            _log.info("catalogue: %s", line)
        self.hub = EventHub()
        self.gate = HardwareGate()
        self.jobs = JobManager(
            self.catalog, self.hub, self.gate, self.folder.ids, queue_limit=config.service.compute_queue
        )
        self.worker = ComputeWorker(threads=config.service.kernel_threads, warm_up="server.tasks:warm_up")
        self.rig = Rig(config, self.gate)
        # stopping must not wait behind forty slow requests
        self.stop_thread = ThreadPoolExecutor(max_workers=2, thread_name_prefix="stop")
        self.started_monotonic = time.monotonic()
        self.closing = False
        self._key_locks: dict[tuple[str, str], threading.Lock] = {}
        self._key_guard = threading.Lock()
        opened = threading.Event()
        token = self.gate.claim("the opening of the rig")

        def open_rig() -> None:
            try:
                self.rig.open()
            finally:
                self.gate.release(token)
                opened.set()

        self.gate.start(open_rig)
        # so that the first request finds the rig; a device that hangs must not keep the service from starting
        opened.wait(timeout=_OPEN_WAIT_S)

    def stop_job(self, job: Job) -> None:
        """Stop the stage for a job that is being cancelled, if it holds the hardware."""
        holder = self.gate.holder
        if holder is not None and holder.get("job_id") == job.id and self.rig.fault is None:
            self.rig.stop()
            self.stop_until_released(job.id)

    def stop_until_released(self, job_id: str) -> None:
        """Go on stopping in the background, see :meth:`_stop_until_released`."""
        threading.Thread(target=self._stop_until_released, args=(job_id,), name="stop again", daemon=True).start()

    def _stop_until_released(self, job_id: str) -> None:
        """Stop the stage until a cancelled job has let the hardware go.

        A job that passed its last check just before it was cancelled may start a motion just after the first stop.
        Once it has let go, the next motion is somebody else's and must not be touched.
        """
        for _ in range(100):
            time.sleep(0.02)
            holder = self.gate.holder
            if holder is None or holder.get("job_id") != job_id or self.closing:
                return
            self.rig.stop()

    def stop_streams(self) -> None:
        """End live views and event streams, which would otherwise outlast every shutdown."""
        self.closing = True
        self.hub.close()

    def close(self) -> None:
        """Stop the stage first, then jobs, worker, rig and files."""
        self.stop_streams()
        if self.rig.fault is None:
            try:
                self.rig.stop()
            except Exception:  # noqa: BLE001 - the rest must still be closed
                _log.exception("the stage could not be stopped at shutdown")
        self.jobs.close()
        self.worker.shutdown()
        self.gate.close()
        self.rig.close()
        self.stop_thread.shutdown(wait=False)
        self.catalog.close()
        self.folder.close()

    def once(
        self, scope: str, key: str | None, body_sha256: str, make: Callable[[], dict[str, Any]]
    ) -> tuple[dict[str, Any], bool]:
        """Run ``make`` once per Idempotency-Key; return what it made and whether it was made before.

        ``make`` returns the ids of what it made, from which the answer is built again.

        Raises
        ------
        StateError
            ``idempotency_key_reused`` if the key came with another body before.
        """
        if key is None:
            return make(), False
        with self._key_guard:
            lock = self._key_locks.setdefault((scope, key), threading.Lock())
        with lock:
            earlier = self.catalog.request(scope, key)
            if earlier is not None:
                if earlier[0] != body_sha256:
                    raise StateError(
                        "This Idempotency-Key was used with another body.",
                        code="idempotency_key_reused",
                        remedy="Use a new key for a new request.",
                    )
                return earlier[1], True
            made = make()
            self.catalog.put_request(scope, key, body_sha256, made)
        with self._key_guard:
            self._key_locks.pop((scope, key), None)
        return made, False
