"""Counters and times of the service at work; `metrics_state` adds its state at a scrape."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, disable_created_metrics
from prometheus_client.core import CollectorRegistry as Registry
from prometheus_client.exposition import generate_latest

from stereorig.core.errors import StereorigError

T = TypeVar("T")
P = ParamSpec("P")

#: the text format that every Prometheus reads
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_REQUEST_S = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 30.0)
_CAPTURE_S = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 60.0)
_STOP_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.5, 2.0)
_JOB_S = (0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0, 7200.0, 36000.0)
_FINAL = frozenset({"succeeded", "failed", "cancelled", "interrupted"})
_MAX_JOBS = 10_000

disable_created_metrics()  # type: ignore[no-untyped-call]  # a second series for each counter, which no client asks for


class Metrics:
    """Counters and histograms of one service, in a registry of their own."""

    def __init__(self) -> None:
        self.registry: Registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        self.request_s = Histogram(
            "stereorig_request_seconds",
            "Time from a request's arrival to the end of its answer; of a stream: to its beginning.",
            ["method", "route"],
            buckets=_REQUEST_S,
            registry=self.registry,
        )
        self.requests = Counter(
            "stereorig_requests", "Requests by route and status.", ["method", "route", "status"], registry=self.registry
        )
        self.capture_s = Histogram(
            "stereorig_capture_seconds",
            "Time that taking or importing a step took, until it was durable.",
            ["source"],
            buckets=_CAPTURE_S,
            registry=self.registry,
        )
        self.captures_failed = Counter(
            "stereorig_captures_failed",
            "Steps that were asked for and not taken, by the error's code.",
            ["source", "code"],
            registry=self.registry,
        )
        self.job_s = Histogram(
            "stereorig_job_seconds",
            "Time from a job's start to its end.",
            ["kind"],
            buckets=_JOB_S,
            registry=self.registry,
        )
        self.job_wait_s = Histogram(
            "stereorig_job_wait_seconds",
            "Time from a job's acceptance to its start.",
            ["kind"],
            buckets=_JOB_S,
            registry=self.registry,
        )
        self.jobs = Counter(
            "stereorig_jobs_finished",
            "Jobs that ended, by kind and last state.",
            ["kind", "state"],
            registry=self.registry,
        )
        self.results = Counter("stereorig_results", "Load steps whose result was written.", registry=self.registry)
        self.stop_s = Histogram(
            "stereorig_stage_stop_seconds",
            "Time from a stop's arrival to the moment when it was on the wire.",
            buckets=_STOP_S,
            registry=self.registry,
        )
        self.connections_refused = Counter(
            "stereorig_connections_refused",
            "Connections ended because they were too many or too slow.",
            ["why"],
            registry=self.registry,
        )
        self._lock = threading.Lock()
        self._jobs: dict[str, dict[str, float]] = {}

    def text(self) -> bytes:
        """Return the counters, in the text format of Prometheus."""
        return generate_latest(self.registry)

    def on_event(self, name: str, data: Mapping[str, Any]) -> None:
        """Count the events of the hub; by the monotonic clock, since the wall clock may be set."""
        if name == "result":
            self.results.inc()
        elif name == "job":
            self._on_job(data)

    def _on_job(self, data: Mapping[str, Any]) -> None:
        now, kind, state = time.monotonic(), str(data["kind"]), str(data["state"])
        with self._lock:
            times = self._jobs.get(data["id"])
            if times is None:
                if state in _FINAL:
                    return  # reported before
                if len(self._jobs) >= _MAX_JOBS:
                    self._jobs.clear()
                times = self._jobs[data["id"]] = {"accepted": now}
            began = state == "running" and "started" not in times
            if began:
                times["started"] = now
            if state in _FINAL:
                del self._jobs[data["id"]]
        if began:
            self.job_wait_s.labels(kind).observe(now - times["accepted"])
        if state in _FINAL:
            self.jobs.labels(kind, state).inc()
            if "started" in times:
                self.job_s.labels(kind).observe(now - times["started"])


class _HasMetrics(Protocol):
    @property
    def metrics(self) -> Metrics: ...


S = TypeVar("S", bound=_HasMetrics)


def timed_capture(source: str) -> Callable[[Callable[Concatenate[S, P], T]], Callable[Concatenate[S, P], T]]:
    """Decorate a function that takes a step, service first: its time, or its failure, is counted."""

    def decorate(function: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
        @functools.wraps(function)
        def timed(service: S, /, *args: P.args, **kwargs: P.kwargs) -> T:
            began = time.monotonic()
            try:
                taken = function(service, *args, **kwargs)
            except BaseException as error:
                code = error.code if isinstance(error, StereorigError) else "internal_error"
                service.metrics.captures_failed.labels(source, code).inc()
                raise
            service.metrics.capture_s.labels(source).observe(time.monotonic() - began)
            return taken

        return timed

    return decorate
