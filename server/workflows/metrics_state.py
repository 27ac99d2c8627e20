"""State at the moment of a scrape: queue, cameras, disk, worker, stage."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from stereorig.core.errors import DeviceError, StereorigError
from stereorig.drivers.stages.protocol import AxisState
from stereorig.server.formats.version import software_version
from stereorig.server.worker.death import resident_mib
from stereorig.server.workflows.service import Service

_log = logging.getLogger("stereorig.metrics")
_MIB = 2**20


def _gauge(name: str, text: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(f"stereorig_{name}", text, value=value)


def metrics_text(service: Service) -> bytes:
    """Return counters and the present state, in the text format of Prometheus."""
    state = CollectorRegistry()
    state.register(StateCollector(service))
    return service.metrics.text() + generate_latest(state)


class StateCollector(Collector):
    """Reads the service when Prometheus asks; a part that cannot be read is left out, never given as zero."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """Yield every figure."""
        parts = (
            self._general,
            self._jobs,
            self._disk,
            self._worker,
            self._readers,
            self._live,
            self._cameras,
            self._stage,
        )
        for part in parts:
            try:
                yield from part()
            except StereorigError as error:
                _log.info("some figures are missing: %s", error)

    def _general(self) -> Iterator[Metric]:
        service = self._service
        info = GaugeMetricFamily("stereorig_build_info", "The program's version; always 1.", labels=["version"])
        info.add_metric([software_version()], 1)
        yield info
        yield _gauge("uptime_seconds", "Time since the service began.", time.monotonic() - service.started_monotonic)
        yield _gauge("ready", "1 if it can capture and compute (/readyz).", not service.not_ready())
        yield _gauge("tests_to_read", "Tests that are still to be read into the catalogue.", service.index.waiting())
        yield _gauge("rig_fault", "1 if the rig could not be opened.", service.rig.fault is not None)
        yield _gauge("hardware_held", "1 while a job holds the hardware.", service.hardware.holder is not None)

    def _jobs(self) -> Iterator[Metric]:
        jobs = self._service.jobs
        yield _gauge("jobs_active", "Jobs that have not ended.", jobs.active_count())
        yield _gauge("compute_queue", "Jobs that wait for the worker.", jobs.waiting_count())
        yield _gauge("compute_queue_limit", "Jobs that may wait; beyond it 503.", jobs.queue_limit)

    def _disk(self) -> Iterator[Metric]:
        service = self._service
        usage = os.statvfs(service.folder.root)
        yield _gauge("disk_free_bytes", "Room on the data folder's disk.", service.folder.free_mib() * _MIB)
        yield _gauge("disk_size_bytes", "Size of the data folder's disk.", usage.f_blocks * usage.f_frsize)
        reserve = service.config.service.free_reserve_mib * _MIB
        yield _gauge("disk_reserve_bytes", "Room below which no step is taken.", reserve)

    def _worker(self) -> Iterator[Metric]:
        worker = self._service.worker
        yield CounterMetricFamily("stereorig_worker_starts", "How often the compute worker was started.", worker.starts)
        yield _gauge("worker_ready", "1 if the worker takes tasks.", worker.ready.is_set())
        memory_mib = None if worker.pid is None else resident_mib(worker.pid)
        if memory_mib is not None:
            yield _gauge("worker_resident_bytes", "Memory of the worker.", memory_mib * _MIB)

    def _readers(self) -> Iterator[Metric]:
        readers = GaugeMetricFamily("stereorig_streams", "Streams that are open, by kind.", labels=["kind"])
        for kind, number in self._service.streams.counts().items():
            readers.add_metric([kind], number)
        yield readers

    def _live(self) -> Iterator[Metric]:
        run = self._service.live_account
        if run is None:
            return
        account, active = run()
        yield _gauge("live_running", "1 while a test is measured live.", active)
        fates = CounterMetricFamily("stereorig_live_frames", "Pairs of the live measurement by fate.", labels=["what"])
        for name, number in account.items():
            fates.add_metric([name], number)
        yield fates

    def _cameras(self) -> Iterator[Metric]:
        pair = self._service.rig.pair
        frames = CounterMetricFamily("stereorig_frames", "Frames by outcome.", labels=["camera", "what"])
        own = GaugeMetricFamily("stereorig_camera_driver", "The driver's own counts.", labels=["camera", "what"])
        faults = GaugeMetricFamily("stereorig_camera_fault", "1 if the camera is lost.", labels=["camera"])
        again = CounterMetricFamily("stereorig_camera_reconnections", "Times it came back.", labels=["camera"])
        for cam, unit in pair.units.items():
            for name, number in unit.counters().items():
                frames.add_metric([cam, name], number)
            faults.add_metric([cam], unit.fault is not None)
            again.add_metric([cam], unit.reconnections)
            try:
                for name, figure in unit.statistics().items():
                    own.add_metric([cam, name], figure)
            except DeviceError as error:  # it was lost just now
                _log.info("no figures of %s: %s", cam, error)
        pairs = CounterMetricFamily("stereorig_pairs", "Triggers by outcome.", labels=["what"])
        for name, number in pair.account().items():
            pairs.add_metric([name], number)
        yield from (frames, own, faults, again, pairs)

    def _stage(self) -> Iterator[Metric]:
        answers = GaugeMetricFamily("stereorig_stage_up", "1 if the motion controller answers.")
        positions = GaugeMetricFamily("stereorig_axis_position_mm", "Position that was read back.", labels=["axis"])
        states = GaugeMetricFamily("stereorig_axis_state", "1 for the state the axis is in.", labels=["axis", "state"])
        try:
            shown = self._service.rig.describe_stage()
            for axis in shown.axes:
                number = str(axis.axis)
                positions.add_metric([number], axis.position_mm)
                for state in AxisState:
                    states.add_metric([number, state.value], axis.state is state)
            if self._service.config.stage is not None:
                answers.add_metric([], shown.fault is None)
        except DeviceError:
            answers.add_metric([], 0)
        yield from (answers, positions, states)
