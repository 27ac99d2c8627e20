"""One live measurement: a thread takes the newest pair, a thread has it measured, a third watches for silence.

Between the first two is one slot: a pair that is not measured when the next one comes is skipped, and so is a pair that
has waited there for long while the next is near. The computation is a process of its own, so that analyses and captures
continue at the same time.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from stereorig.core.errors import StereorigError
from stereorig.core.names import CAMERAS, UNITS
from stereorig.drivers.acquisition.pairing import Pair
from stereorig.server.base.models import utc_text
from stereorig.server.base.problem import JobProblem, problem_of
from stereorig.server.compute.functions import begin_live, measure_live, warm_up
from stereorig.server.compute.tasks import LiveTask, Plain
from stereorig.server.jobs.events import EventHub
from stereorig.server.rig.cameras import PairMark
from stereorig.server.rig.rig import Rig
from stereorig.server.worker.embedded import ComputeWorker
from stereorig.server.worker.executor import WorkerDiedError
from stereorig.server.worker.shared_images import SharedImages
from stereorig.server.workflows.channels.reading import ReadChannels
from stereorig.server.workflows.live.account import Account, Pace
from stereorig.server.workflows.live.series import LiveSeries, Moment

_log = logging.getLogger("stereorig.live")

_KEPT_EVENTS = 100
_PAUSE_S = 0.02  # after an error without a frame
_WATCH_S = 0.01
_BEGIN_S = 600.0
_FRAME_S = 30.0


class _Ended(Exception):
    """The live measurement was stopped."""


class LiveRun:
    """One live measurement of a test.

    Parameters
    ----------
    test_id
        The test.
    task
        The gauges' points, images and settings to measure with.
    settings
        The request's settings, for the state.
    rig
        Gives the pairs.
    threads
        Kernel threads of its process.
    silence_s
        Values older than this are no longer valid.
    channels
        Channels that the service reads.
    """

    def __init__(
        self,
        test_id: str,
        task: LiveTask,
        settings: Mapping[str, object],
        rig: Rig,
        *,
        threads: int | None,
        silence_s: float,
        channels: ReadChannels,
    ) -> None:
        self.test_id, self.settings, self.silence_s = test_id, settings, silence_s
        self._task, self._rig = task, rig
        self.whole_field = task.whole_field
        self.kinds = {str(gauge["name"]): str(gauge["kind"]) for gauge in task.gauges}
        self.hub = EventHub(keep=_KEPT_EVENTS)
        self.account = Account()
        self.series = LiveSeries()
        self.lines = channels
        self._unheard = channels.listen(self.series.put)
        self.state = "starting"
        self.problem: JobProblem | None = None
        self.begun: Plain = {}
        self.field: tuple[int, Any] | None = None
        """Number of the newest frame with a field, and its displacements (r, c, 3), mm."""
        self.since_utc = utc_text(datetime.now(UTC))
        self._worker = ComputeWorker(threads=threads, warm_up=warm_up, lowered=False)  # its answers are waited for
        self._shared = SharedImages()
        self._newest: Plain = {"number": 0, "valid": False, "reason": "starting", "gauges": {}}
        self._spoke = time.monotonic()
        self._ending = threading.Event()
        self._changed = threading.Condition()
        self._slot: Pair | None = None
        self._pace: Pace | None = None  # of cameras that run free; others are fired as pairs are wanted
        self._fault: str | None = None
        self._gone: str | None = None  # reason why no pairs come; None while they come
        self._number = 0
        self._clock = _HostClock()
        self._threads = [
            threading.Thread(target=target, name=f"live {name}", daemon=True)
            for name, target in (("frames", self._take), ("measure", self._measure), ("watch", self._watch))
        ]

    def start(self) -> None:
        """Begin; the reference is measured first, in the background."""
        self._worker.start()
        self._threads[1].start()

    def stop(self) -> None:
        """End it; safe to call twice."""
        self.end()
        for thread in self._threads:
            if thread.ident is not None and thread is not threading.current_thread():
                thread.join(timeout=5.0)
        self._unheard()
        self._worker.shutdown()
        self._shared.close()
        if self.state != "failed":
            self.state = "ended"
        self._publish_invalid(self.state)

    def end(self) -> None:
        """Let it end by itself, and its streams now."""
        self._ending.set()
        with self._changed:
            self._changed.notify_all()
        self.hub.close()

    @property
    def active(self) -> bool:
        """True while it measures or begins to."""
        return self.state in ("starting", "running")

    def newest(self) -> Plain:
        """Return the newest values; marked not valid if they are older than allowed."""
        with self._changed:
            newest, spoke = self._newest, self._spoke
        if newest["valid"] and time.monotonic() - spoke > self.silence_s:
            return _invalid(newest, "silence")
        return newest

    # threads --------------------------------------------------------------------------------------------------------

    def _check(self) -> None:
        if self._ending.is_set():
            raise _Ended

    def _take(self) -> None:
        """Take pairs; the newest one waits in the slot."""
        mark: PairMark | None = None
        while not self._ending.is_set():
            try:
                pairs = self._rig.pair
                if pairs.fires:  # nothing is exposed that would be thrown away
                    self._pace = None
                    self._await_empty()
                elif self._pace is None:
                    self._pace = Pace()
                mark, passed, pair = pairs.newest(mark, self._check)
            except _Ended:
                return
            except StereorigError as error:
                self.account.without_frame(error.code)
                with self._changed:
                    self._gone = error.code
                self._lost(error.code)
                self._ending.wait(_PAUSE_S)
                continue
            self.account.came(passed + 1)
            self.account.skipped(passed)
            if self._pace is not None:
                with self._changed:
                    self._pace.came(_arrived_s(pair), passed)
            if not pair.accepted:
                self.account.refused("skew_too_large")
                self._lost("skew_too_large")
                continue
            with self._changed:
                if self._slot is not None:
                    self.account.skipped(1)
                self._slot, self._fault, self._gone = pair, None, None
                self._changed.notify_all()

    def _await_empty(self) -> None:
        with self._changed:
            while self._slot is not None:
                self._check()
                self._changed.wait(_WATCH_S)

    def _measure(self) -> None:
        try:
            self._begin()
            self._threads[0].start()
            self._threads[2].start()
            while True:
                pair = self._next()
                try:
                    self._measure_one(pair)
                except StereorigError as error:
                    self.account.refused(error.code)
                    self._lost(error.code)
                    # its process died over the frame, or between two: another one was started, which knows nothing
                    if error.code in (WorkerDiedError.code, "live_ended"):
                        self._begin()
        except _Ended:
            pass
        except StereorigError as error:
            self.problem, self.state = problem_of(error), "failed"
            _log.warning("the live measurement of test %s ended: %s", self.test_id, error.cause)
            self._ending.set()
            self._publish_invalid(error.code)
        except Exception as error:  # noqa: BLE001 - the state reports it
            self.problem, self.state = problem_of(error), "failed"
            _log.exception("the live measurement of test %s failed", self.test_id)
            self._ending.set()
            self._publish_invalid("internal_error")

    def _begin(self) -> None:
        self.state = "starting"
        self.begun = self._result(_BEGIN_S, begin_live, self._task)
        self.state = "running"

    def _next(self) -> Pair:
        with self._changed:
            while (wait_s := self._wait_s()) > 0.0:
                self._check()
                self._changed.wait(wait_s)
            taken, self._slot = self._slot, None
            assert taken is not None, "waited for"
            self._changed.notify_all()
            return taken

    def _wait_s(self) -> float:
        """Return how long the slot is to be watched before the pair in it is taken."""
        if self._slot is None:
            return _WATCH_S * 10
        pace = self._pace  # the thread that takes pairs may end it at any moment
        return 0.0 if pace is None else pace.wait_s(_arrived_s(self._slot), time.monotonic())

    def _measure_one(self, pair: Pair) -> None:
        pixels, frame = self._shared.put([pair[cam].pixels for cam in CAMERAS]), pair.cam1
        exposed_ns = frame.begun_ns
        found = self._result(_FRAME_S, measure_live, pixels, exposed_ns / 1e9)
        self._number += 1
        latency_ms = 1e3 * (time.monotonic() - _arrived_s(pair))
        self.account.measured(found["how"], latency_ms, time.monotonic())
        gauges = {name: _gauge(self.kinds[name], one) for name, one in found["gauges"].items()}
        values = {name: {q: number["value"] for q, number in gauge["values"].items()} for name, gauge in gauges.items()}
        self.series.add(Moment(self._number, exposed_ns / 1e9, values))
        self.field = (self._number, found["field"]) if "field" in found else None
        self._publish(
            {
                "number": self._number,
                "valid": True,
                "reason": "",
                "time_s": exposed_ns / 1e9,
                "device_time_s": frame.device_ns / 1e9,
                "exposed_utc": self._clock.utc(exposed_ns),
                "skew_ms": pair.skew_ms,
                "skew_uncertainty_ms": pair.skew_uncertainty_ms,
                "skew_source": pair.skew_source,
                "how": found["how"],
                "points": found["points"],
                "status": found["status"],
                "arrived_s": _arrived_s(pair),
                "latency_ms": round(latency_ms, 3),
                "gauges": gauges,
            }
        )

    def _result(self, patience_s: float, function: Any, *arguments: Any) -> Plain:
        future = self._worker.submit(function, *arguments)
        deadline = time.monotonic() + patience_s
        while True:
            try:
                found: Plain = future.result(timeout=0.1)
            except TimeoutError:
                if self._ending.is_set() or time.monotonic() > deadline:
                    future.request_stop()
                    raise _Ended from None
                continue
            return found

    def _watch(self) -> None:
        """Publish invalid values if no value has come for too long."""
        while not self._ending.wait(_WATCH_S):
            if self._newest["valid"] and time.monotonic() - self._spoke > self.silence_s:
                self._publish_invalid(self._fault or "silence")

    # values ---------------------------------------------------------------------------------------------------------

    def _lost(self, code: str) -> None:
        """Note why a value is missing, and say so at once where the last one was valid."""
        self._fault = code
        if self._newest["valid"] or self._newest["reason"] != code:
            self._publish_invalid(code)

    def _publish_invalid(self, reason: str) -> None:
        self._publish(_invalid(self._newest, reason))

    def _publish(self, values: Plain) -> None:
        with self._changed:
            if self._gone is not None and values["valid"]:  # a frame of before is measured only now
                values = _invalid(values, self._gone)
            self._newest, self._spoke = values, time.monotonic()
        self.hub.publish("values", values)


class _HostClock:
    """The calendar's time of moments on the host's monotonic clock."""

    def __init__(self) -> None:
        self._zero = datetime.now(UTC) - timedelta(seconds=time.monotonic())

    def utc(self, at_ns: int) -> str:
        return utc_text(self._zero + timedelta(microseconds=at_ns / 1e3))


def _arrived_s(pair: Pair) -> float:
    """Time at which a pair was in memory: its later frame."""
    return max(pair[cam].host_ns for cam in CAMERAS) / 1e9


def _gauge(kind: str, found: Plain) -> Plain:
    missing = str(found["missing"])
    values = {
        quantity: {
            "value": value,
            "u": _known(u),
            "u_calibration": _known(common),
            "budget": budget,
            "units": UNITS[kind][quantity],  # type: ignore[index]
        }
        for quantity, (value, u, common, budget) in found["values"].items()
    }
    return {"kind": kind, "valid": not missing, "reason": missing, "values": values}


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _invalid(values: Plain, reason: str) -> Plain:
    """Values that do not hold: every gauge without numbers, with the reason."""
    gauges = {
        name: {**gauge, "valid": False, "reason": reason, "values": {}} for name, gauge in values["gauges"].items()
    }
    return {**values, "valid": False, "reason": reason, "gauges": gauges}
