"""A recording: pairs at the cameras' full rate in a ring of memory, kept as steps by a channel or a call."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
import psutil
from pydantic import Field

from stereorig.core.arrays import Float
from stereorig.core.errors import Cancelled, InputError, StageError, StateError, StereorigError
from stereorig.core.live.channels import Cycles, level_reached, moments, slope_reached
from stereorig.drivers.cameras.protocol import CameraDescription, CameraSettings
from stereorig.server.base.models import Ids, Request
from stereorig.server.documents.steps import BurstIndex, StepMetadata
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.rig.cameras import CapturedPair
from stereorig.server.workflows.capture import NewStep, commit_pairs
from stereorig.server.workflows.channels.reading import StepChannels
from stereorig.server.workflows.service import Service

_POLL_S = 0.05
_LATE_S = 1.0  # readings of channels come so much later than frames at most
_OF_MEMORY = 0.5  # of the memory that is free now
_MOST_DROPPED = 100  # pairs that are named, and not only counted
_TOGETHER, _TOGETHER_BYTES = 32, 2**24  # pairs that are made durable at once, at most
# If the request states neither: software triggers would be as fast as small cameras answer, and a thousand pairs are
# some tenth of a test's most steps, 9999
_USUAL_HZ, _USUAL_S, _USUAL_PAIRS = 100.0, 10.0, 1000
Seconds = Annotated[float, Field(ge=0.0, le=3600.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class RecordTrigger(Request):
    """The moment, or the moments, around which pairs are kept."""

    kind: Literal["call", "level", "slope", "peak", "valley", "phase"] = Field(
        "call",
        description="`call`, `level`, `slope`: all pairs from `before_s` before it to `after_s` behind it, once. "
        "`peak`, `valley`, `phase`: the pair nearest to each of them, for `after_s` from the beginning.",
    )
    channel: str | None = Field(
        None, max_length=100, description="Channel of the rig file; all kinds but `call` need it."
    )
    level: Finite | None = Field(None, description="`level`: the value that is passed, upwards unless `falling`.")
    falling: bool = Field(False, description="`level`: it is passed downwards.")
    slope_per_s: Finite | None = Field(None, description="`slope`: reached upwards; downwards if it is below zero.")
    over_s: Annotated[float, Field(gt=0.0, le=60.0)] = Field(0.1, description="`slope`: it is the mean over this time.")
    every: Annotated[int, Field(ge=1, le=1_000_000)] = Field(1, description="Every N-th peak, valley or cycle.")
    phases_deg: Annotated[list[Finite], Field(min_length=1, max_length=360)] = Field(
        default_factory=lambda: [0.0], description="`phase`: of a cycle, counted from its peak."
    )
    reversal: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = Field(
        None, description="A peak is one when the channel has gone back by this; a fifth of its range if left out."
    )

    @property
    def is_once(self) -> bool:
        """True if all pairs around one moment are kept."""
        return self.kind in ("call", "level", "slope")

    def require_complete(self) -> None:
        """Refuse a trigger that lacks what its kind needs.

        Raises
        ------
        InputError
            ``trigger_incomplete``.
        """
        more = {"level": ["level"], "slope": ["slope_per_s"]}.get(self.kind, [])
        needed = [] if self.kind == "call" else ["channel", *more]
        missing = [name for name in needed if getattr(self, name) is None]
        if missing:
            raise InputError(
                f"A trigger of kind {self.kind} needs {' and '.join(missing)}.",
                code="trigger_incomplete",
                remedy="State it within `trigger`.",
                missing=missing,
            )


class RecordPlan(Request):
    """Plan of a recording: its trigger, times, rate and number of pairs."""

    trigger: RecordTrigger = Field(default_factory=RecordTrigger, description="Trigger that selects the pairs to keep.")
    before_s: Seconds = Field(
        1.0,
        description="Time before the trigger that is kept; of peaks, valleys and phases: how long pairs wait for them, "
        "which must be more than a cycle.",
    )
    after_s: Annotated[float, Field(gt=0.0, le=86_400.0, allow_inf_nan=False)] | None = Field(
        None,
        description="Time behind the trigger that is kept; of peaks, valleys and phases: the recording's length. "
        f"If left out {_USUAL_S:g} s, or less if that would keep more than {_USUAL_PAIRS} pairs.",
    )
    wait_s: Annotated[float, Field(gt=0.0, le=86_400.0)] = Field(600.0, description="Longest wait for the trigger.")
    rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] | None = Field(
        None,
        description=f"Highest rate of software triggers; {_USUAL_HZ:g} Hz if left out. Others have their own rate.",
    )


@dataclass
class _Ring:
    """Counters of the ring's pairs: times by number, and the fate of the requested ones."""

    times_s: dict[int, float] = field(default_factory=dict)
    dropped: Counter[str] = field(default_factory=Counter)
    named: list[dict[str, object]] = field(default_factory=list)
    lost: int = 0
    missed: int = 0  # moments without a pair

    def drop(self, cause: str, number: int | None = None, count: int = 1) -> None:
        self.dropped[cause] += count
        if number is not None and len(self.named) < _MOST_DROPPED:
            self.named.append({"pair": number, "cause": cause})


class Recordings:
    """Calls that trigger recordings, by the jobs."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._called: dict[str, tuple[str, threading.Event]] = {}

    def start(self, test_id: str, metadata: StepMetadata, plan: RecordPlan, request: RequestMark) -> str:
        """Begin to record; return the job's id.

        Raises
        ------
        InputError
            ``trigger_incomplete``; ``channel_unknown``; ``recording_too_large`` if the ring does not fit into the free
            memory.
        BusyError
            A job or another client has the cameras.
        """
        service = self._service
        service.require_room()
        plan.trigger.require_complete()
        if plan.trigger.channel is not None:
            service.channels.readings(plan.trigger.channel)
        plan, limits = self._bounded(plan)
        called = threading.Event()

        def run(job: Job) -> dict[str, object]:
            self._called[test_id] = job.id, called
            try:
                return _Recording(service, job, test_id, metadata, plan, called, limits).run()
            finally:
                self._called.pop(test_id, None)

        phases = [Phase("hardware", run)]
        subject = {"test_id": test_id}

        def prepare(job: Job) -> Ids:
            job.result = {**subject, "limits": limits, "steps": []}
            return {}

        return service.jobs.submit("record", "a recording", subject, phases, prepare=prepare, request=request).id

    def trigger(self, test_id: str) -> str:
        """Trigger the recording of a test now, for any kind of trigger; return its job's id.

        Raises
        ------
        StateError
            ``no_recording``.
        """
        found = self._called.get(test_id)
        if found is None:
            raise StateError(
                f"Test {test_id} is not being recorded.", code="no_recording", remedy="POST /tests/{id}/record first."
            )
        found[1].set()
        return found[0]

    def _bounded(self, plan: RecordPlan) -> tuple[RecordPlan, dict[str, float]]:
        """Return the plan with its limits, and how many pairs the ring holds; refuse more than the memory takes."""
        described = self._service.rig.pair.described()
        size = sum(_bytes(*one) for one in described.values())
        rate_hz = plan.rate_hz or self._service.config.rig.frame_rate_hz
        if self._service.rig.pair.fires:
            rate_hz = plan.rate_hz or _USUAL_HZ
            plan = plan.model_copy(update={"rate_hz": rate_hz})
        elif rate_hz is None:
            rate_hz = 1e3 / max(described["cam1"][1].exposure_ms or 1.0, 1.0)
        if plan.after_s is None:
            left_s = _USUAL_PAIRS / rate_hz - plan.before_s if plan.trigger.is_once else _USUAL_S
            plan = plan.model_copy(update={"after_s": min(_USUAL_S, max(left_s, 1.0 / rate_hz))})
        assert plan.after_s is not None
        held_s = plan.before_s + _LATE_S + (plan.after_s if plan.trigger.is_once else 0.0)
        room = int(1.05 * rate_hz * held_s) + 32
        free = psutil.virtual_memory().available
        if room * size > _OF_MEMORY * free:
            raise InputError(
                f"{held_s:g} s at {rate_hz:g} Hz are {room} pairs or {room * size / 2**20:.0f} MiB; "
                f"{free / 2**20:.0f} MiB of memory are free, of which {100 * _OF_MEMORY:g} % may be used.",
                code="recording_too_large",
                remedy="Record for less time or at a lower rate, or a smaller region of the cameras.",
            )
        limits = {"rate_hz": rate_hz, "before_s": plan.before_s, "after_s": plan.after_s, "most_pairs_in_memory": room}
        return plan, {**limits, "most_memory_mib": round(room * size / 2**20, 1)}


def _bytes(description: CameraDescription, settings: CameraSettings) -> int:
    width, height = description.image_size_px if settings.region_px is None else settings.region_px[2:]
    return width * height * (1 if (settings.bit_depth or max(description.bit_depths)) == 8 else 2)


class _Recording:
    """One recording, on its job's thread."""

    def __init__(
        self,
        service: Service,
        job: Job,
        test_id: str,
        metadata: StepMetadata,
        plan: RecordPlan,
        called: threading.Event,
        limits: Mapping[str, float],
    ) -> None:
        self._service, self._job, self._test_id, self._metadata = service, job, test_id, metadata
        self._plan, self._called, self._pair = plan, called, service.rig.pair
        self._room, self._after_s = int(limits["most_pairs_in_memory"]), limits["after_s"]
        self._ring, self._came, self._fault = _Ring(), 0, ""
        self._began_s, self._trigger_s = time.monotonic(), 0.0
        self._first_s: float | None = None
        self._positions: Mapping[int, float | StageError] = {}
        self._counters: Mapping[str, object] = {}
        self._frames: dict[str, tuple[int, int, int]] = {}  # of the kept frames: first and last number, count
        self._steps: list[dict[str, object]] = []
        self._result: dict[str, object] = {"test_id": test_id, "limits": limits, "steps": self._steps}

    def run(self) -> dict[str, object]:
        """Record, and keep the pairs that the trigger selects."""
        plan, job = self._plan, self._job
        job.result = self._result
        self._positions = self._service.rig.known_positions()
        self._service.channels.attend(self._test_id)
        period_s = 0.0 if plan.rate_hz is None else 1.0 / plan.rate_hz
        self._pair.record(room=self._room, before_s=plan.before_s + _LATE_S, period_s=period_s)
        try:
            (self._once if plan.trigger.is_once else self._by_cycle)()
        finally:
            with contextlib.suppress(StereorigError):  # the cameras may be gone
                self._close_account()
                self._pair.end_record()
            self._account()
        return self._result

    def _close_account(self) -> None:
        """Count the fate of all frames; those that come while steps are made are not recorded."""
        if not self._counters:
            self._look()
            self._counters = self._pair.record_counters()

    def _account(self) -> None:
        ring, kept = self._ring, len(self._steps)
        dropped = sum(ring.dropped.values())
        self._result["account"] = {
            "pairs": self._came,
            "kept": kept,
            "not_chosen": self._came - kept - dropped,
            "dropped": dict(ring.dropped),
            "dropped_pairs": ring.named,
            "moments_without_pair": ring.missed,
            "counters": self._counters,
            "frames_missing": {cam: last - first + 1 - n for cam, (first, last, n) in self._frames.items()},
        }

    def _look(self) -> None:
        """Learn which pairs came."""
        state = self._pair.recorded()
        self._ring.times_s |= dict(state.times_s)
        self._came, self._fault = self._came + len(state.times_s), state.fault
        if state.lost > self._ring.lost:
            self._ring.drop("no_room", count=state.lost - self._ring.lost)
            self._ring.lost = state.lost

    # all pairs around one moment ------------------------------------------------------------------------------------

    def _once(self) -> None:
        plan, job = self._plan, self._job
        job.progress("trigger", 0, 0)
        while (at_s := self._triggered()) is None:
            job.check()
            self._look()
            if time.monotonic() - self._began_s > plan.wait_s:
                raise StateError(
                    f"No trigger came within {plan.wait_s:g} s.",
                    code="no_trigger",
                    remedy="Check the trigger's channel and level, or POST /tests/{id}/record:trigger.",
                )
            time.sleep(_POLL_S)
        self._trigger_s, end_s = at_s, at_s + self._after_s
        self._look()
        asked = [n for n, taken_s in self._ring.times_s.items() if taken_s >= at_s - plan.before_s]
        first = min(asked, default=self._came)
        for number in self._pair.keep_recorded(asked, from_number=first):
            if number < self._came:
                self._ring.drop("left_ring", number)
        late_s = end_s + _LATE_S + 10.0 * _POLL_S
        while max(self._ring.times_s.values(), default=0.0) <= end_s and time.monotonic() < late_s:
            job.check()
            job.progress("recording", max(int(1e3 * (time.monotonic() - at_s)), 0), int(1e3 * self._after_s))
            time.sleep(_POLL_S)
            self._look()
        chosen = [n for n, taken_s in self._ring.times_s.items() if n >= first and taken_s <= end_s]
        self._pair.keep_until(max(chosen, default=-1))
        self._close_account()
        channels = {number: self._service.channels.at(self._ring.times_s[number]) for number in chosen}
        self._commit(channels, len(chosen))

    def _triggered(self) -> float | None:
        trigger = self._plan.trigger
        if self._called.is_set():
            return time.monotonic()
        if trigger.kind == "call":
            return None
        t, y = self._readings(self._began_s - trigger.over_s)
        if trigger.kind == "level":
            return level_reached(t, y, trigger.level or 0.0, falling=trigger.falling)
        return slope_reached(t, y, trigger.slope_per_s or 0.0, over_s=trigger.over_s)

    def _readings(self, since_s: float) -> tuple[Float, Float]:
        t, y = self._service.channels.readings(self._plan.trigger.channel or "")
        begin = int(np.searchsorted(t, since_s, side="right"))
        return t[begin:], y[begin:]

    # pairs at moments of cycles -------------------------------------------------------------------------------------

    def _by_cycle(self) -> None:
        plan, trigger = self._plan, self._plan.trigger
        cycles, fed_s, done, self._trigger_s = Cycles(trigger.reversal), self._began_s, 0, self._began_s
        cycles.see(self._readings(0.0)[1])
        kind = trigger.kind
        assert kind in ("peak", "valley", "phase")
        while time.monotonic() < self._began_s + self._after_s and not self._called.is_set():
            self._job.check()
            self._job.progress("recording", int(time.monotonic() - self._began_s), int(self._after_s))
            time.sleep(_POLL_S)
            self._look()
            t, y = self._readings(fed_s)
            cycles.feed(t, y)
            fed_s = float(t[-1]) if len(t) else fed_s
            found = moments(cycles, kind, every=trigger.every, phases_deg=trigger.phases_deg)
            for at_s in found[done:]:
                self._choose(at_s)
            done = len(found)
            old_s = time.monotonic() - plan.before_s - 10.0
            self._ring.times_s = {n: taken_s for n, taken_s in self._ring.times_s.items() if taken_s > old_s}

    def _choose(self, at_s: float) -> None:
        """Keep the pair nearest to a moment."""
        numbers, times = np.array(list(self._ring.times_s)), np.array(list(self._ring.times_s.values()))
        if len(times) < 2 or np.min(np.abs(times - at_s)) > 1.5 * np.median(np.diff(times)):
            self._ring.missed += 1
            return
        number = int(numbers[np.argmin(np.abs(times - at_s))])
        if self._pair.keep_recorded([number]):
            self._ring.drop("left_ring", number)
            return
        self._commit({number: self._service.channels.at(self._ring.times_s[number])}, 0)

    # steps ----------------------------------------------------------------------------------------------------------

    def _commit(self, channels: Mapping[int, StepChannels], count: int) -> None:
        """Make steps of the pairs that are kept, each durable before it is listed."""
        left = dict.fromkeys(channels)
        batch: list[tuple[int, CapturedPair]] = []

        def make_steps() -> None:
            self._make_steps(batch, channels, count)
            for number, _ in batch:
                del left[number]
            batch.clear()

        try:
            while (found := self._pair.take_recorded()) is not None:
                self._job.check()
                number, captured, accepted = found
                for cam, frame in captured.sequence.items() if count else ():
                    first, _, n = self._frames.get(cam, (frame, frame, 0))
                    self._frames[cam] = first, frame, n + 1
                if count:
                    self._job.progress("steps", len(self._steps), count)
                if number in left and accepted:
                    batch.append((number, captured))
                    size = sum(image.nbytes for image in captured.pixels.values())
                    if len(batch) >= min(_TOGETHER, _TOGETHER_BYTES // size):
                        make_steps()
                elif number in left:
                    self._ring.drop("skew_too_large", number)
                    del left[number]
            make_steps()
        except Cancelled:
            self._ring.drop("cancelled", count=len(left))
            raise

    def _make_steps(
        self, batch: Sequence[tuple[int, CapturedPair]], channels: Mapping[int, StepChannels], count: int
    ) -> None:
        new = []
        for index, (number, captured) in enumerate(batch, len(self._steps)):
            at_s = self._ring.times_s[number]
            self._first_s = at_s if self._first_s is None else self._first_s
            burst = BurstIndex(
                job_id=self._job.id,
                index=index,
                count=count,
                interval_ms=0.0,
                since_first_ms=round(1e3 * (at_s - self._first_s), 3),
                trigger_ms=round(1e3 * (at_s - self._trigger_s), 3),
                pair=number,
            )
            metadata = self._metadata.model_copy(update={"burst": burst})
            new.append(NewStep(metadata, captured, channels[number]))
        self._service.require_room()
        for step in commit_pairs(self._service, self._test_id, new, self._positions) if new else ():
            assert step.burst is not None
            taken = {name: getattr(step.burst, name) for name in ("index", "since_first_ms", "trigger_ms")}
            self._steps.append({**taken, "n": step.n, "quality": step.quality_code, "sha256": step.sha256})
