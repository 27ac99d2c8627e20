"""One job: its states, its phases, its progress, and what the API shows of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from core.errors import Cancelled
from server.base.models import JobState
from server.base.problem import JobProblem
from server.store.documents import JobRecord, Progress
from server.store.folder import now_utc

State = JobState
FINAL: tuple[State, ...] = ("succeeded", "failed", "cancelled", "interrupted")
ACTIVE: tuple[State, ...] = ("queued", "running", "cancelling")


@dataclass(frozen=True)
class Phase:
    """One phase of a job: where it runs, and what; what ``run`` returns is merged into the job's result."""

    lane: Literal["hardware", "compute"]
    run: Callable[[Job], Mapping[str, object] | None]


class Waiting(Exception):
    """Raised by a compute phase that has nothing to do until somebody wakes its job; it is run again then."""


@dataclass(eq=False)
class Job:
    """One job; ``document`` is what the API shows. Doubles as progress callback and cancel token of its phases."""

    id: str
    kind: str
    subject: dict[str, object]
    phases: Sequence[Phase]
    publish: Callable[[Job, str], None]
    state: State = "queued"
    created_utc: str = field(default_factory=now_utc)
    started_utc: str | None = None
    finished_utc: str | None = None
    result: dict[str, object] | None = None
    problem: JobProblem | None = None
    stage: str = "waiting"
    done: int = 0
    total: int = 0
    #: called with the final state before that state is shown (writes summaries)
    on_end: Callable[[Job, State], None] | None = None
    #: called at once when the job is cancelled, from whatever thread asks (stops the stage)
    on_cancel: Callable[[Job], None] | None = None
    #: gives the hardware back, if the job has it; before its end is shown
    let_go: Callable[[], None] | None = None
    #: the test whose new steps wake it
    follows: str | None = None
    #: whether it should end once it has nothing to do
    finishing: threading.Event = field(default_factory=threading.Event)
    woken: threading.Event = field(default_factory=threading.Event)
    #: stops what the job waits for, at once, when it is cancelled
    stop_waiting: Callable[[], None] | None = None
    saving: threading.Lock = field(default_factory=threading.Lock)
    ended: bool = False
    _pace_from: tuple[float, int] | None = None
    _last_shown: float = 0.0
    _cancel: threading.Event = field(default_factory=threading.Event)

    @property
    def cancelled(self) -> bool:
        """Whether the job should stop (:class:`core.progress.CancelToken`)."""
        return self._cancel.is_set()

    def check(self) -> None:
        """Raise :class:`core.errors.Cancelled` if the job should stop."""
        if self.cancelled:
            raise Cancelled(f"The {self.kind} was cancelled.")

    def progress(self, stage: str, done: int, total: int) -> None:
        """Report progress (:class:`core.progress.Progress`)."""
        now = time.monotonic()
        changed = stage != self.stage
        if total != self.total or done < self.done or self._pace_from is None:
            self._pace_from = (now, done)  # other units from here on
        self.stage, self.done, self.total = stage, done, total
        # a kernel may report thousands of times a second; readers need ten
        if changed or done >= total or now - self._last_shown > 0.1:
            self._last_shown = now
            self.publish(self, "progress")

    @property
    def eta_s(self) -> float | None:
        """Seconds left in these units, from their own pace; None while there is nothing to go by."""
        if self.state not in ACTIVE or self._pace_from is None or self.total <= 0:
            return None
        since, first = self._pace_from
        if self.done <= first:
            return None
        pace_s = (time.monotonic() - since) / (self.done - first)
        return round(pace_s * max(self.total - self.done, 0), 2)

    def document(self) -> JobRecord:
        """Return the job as the API shows and the catalogue keeps it."""
        return JobRecord(
            id=self.id,
            kind=self.kind,
            state=self.state,
            subject=dict(self.subject),
            progress=Progress(stage=self.stage, done=self.done, total=self.total, eta_s=self.eta_s),
            created_utc=self.created_utc,
            started_utc=self.started_utc,
            finished_utc=self.finished_utc,
            result=self.result,
            problem=self.problem,
        )
