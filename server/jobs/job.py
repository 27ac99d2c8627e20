"""One job: its states, its phases, its progress, and its document for the API."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

from stereorig.core.errors import Cancelled
from stereorig.server.base.models import Ids, JobState
from stereorig.server.base.problem import JobProblem
from stereorig.server.documents.jobs import JobRecord, Progress
from stereorig.server.store.folder import now_utc

State = JobState
FINAL: tuple[State, ...] = ("succeeded", "failed", "cancelled", "interrupted")
ACTIVE: tuple[State, ...] = ("queued", "running", "cancelling")


@dataclass(frozen=True)
class Phase:
    """One phase of a job: its lane and its function; the result of ``run`` is merged into the job's result.

    A phase ``beside`` the lanes waits for neither: its work is done in another process.
    """

    lane: Literal["hardware", "compute", "beside"]
    run: Callable[[Job], Mapping[str, object] | None]


class Waiting(Exception):
    """Raised by a compute phase that has nothing to do until its job is woken; it is run again then."""


@dataclass(frozen=True, eq=False)
class Work:
    """Work of a job.

    Parameters
    ----------
    on_end
        Called with the final state before that state is shown (writes summaries).
    on_cancel
        Called at once when the job is cancelled, from the cancelling thread (stops the stage).
    follows
        The test whose new steps wake it.
    """

    phases: Sequence[Phase]
    on_end: Callable[[Job, State], None] | None = None
    on_cancel: Callable[[Job], None] | None = None
    follows: str | None = None

    @property
    def computes(self) -> bool:
        """Return True if it needs the compute lane."""
        return any(phase.lane == "compute" for phase in self.phases)


def new_record(job_id: str, kind: str, subject: Mapping[str, object]) -> JobRecord:
    """Return the record of a job that is accepted now."""
    return JobRecord(
        id=job_id,
        kind=kind,
        state="queued",
        subject=dict(subject),
        progress=_Pace().progress(active=False),
        created_utc=now_utc(),
        started_utc=None,
        finished_utc=None,
        result=None,
        problem=None,
    )


class _Pace:
    """Progress of a job in its units, and its pace."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin to wait."""
        self._phase, self._done, self._total = "waiting", 0, 0
        self._from: tuple[float, int] | None = None
        self._last_shown = 0.0

    def to(self, phase: str, done: int, total: int) -> bool:
        """Take a phase's report; return True if readers should see it: they need it ten times a second."""
        now = time.monotonic()
        changed = phase != self._phase
        if total != self._total or done < self._done or self._from is None:
            self._from = (now, done)  # other units from here on
        self._phase, self._done, self._total = phase, done, total
        if not changed and done < total and now - self._last_shown <= 0.1:
            return False
        self._last_shown = now
        return True

    def progress(self, *, active: bool) -> Progress:
        """Return it as it is shown."""
        eta_s = self._eta_s() if active else None
        return Progress(phase=self._phase, done=self._done, total=self._total, eta_s=eta_s)

    def _eta_s(self) -> float | None:
        """Seconds left in these units, from their own pace; None while there is nothing to go by."""
        begun = self._from  # the phases' thread may replace it at any moment
        if begun is None or self._total <= 0:
            return None
        since, first = begun
        if self._done <= first:
            return None
        pace_s = (time.monotonic() - since) / (self._done - first)
        return round(pace_s * max(self._total - self._done, 0), 2)


class Job:
    """A job at work: its record, and the methods that its phases and its manager call.

    Doubles as progress callback and cancel token of its phases.

    Parameters
    ----------
    record
        As it begins; progress is added when it is shown.
    work
        Its phases and callbacks.
    publish
        Called with the job and the kind of change.
    """

    def __init__(self, record: JobRecord, work: Work, publish: Callable[[Job, str], None]) -> None:
        self.record = record
        self.work = work
        #: whether it should end once it has nothing to do
        self.finishing = threading.Event()
        self.woken = threading.Event()
        #: gives the hardware back, if the job has it; before its end is shown
        self.let_go: Callable[[], None] | None = None
        #: held while a document is written: one after the other, and none after the final one
        self.saving = threading.Lock()
        self.ended = False
        self._publish = publish
        self._guard = threading.Lock()
        self._pace = _Pace()
        self._cancel = threading.Event()
        self._stop_waiting: Callable[[], None] | None = None

    @property
    def id(self) -> str:
        """Id of the job."""
        return self.record.id

    @property
    def subject(self) -> dict[str, object]:
        """Ids of the test, analysis or calibration that it works on."""
        return self.record.subject

    # for its phases --------------------------------------------------------------------------------------------

    @property
    def cancelled(self) -> bool:
        """Return True if the job should stop (:class:`stereorig.core.progress.CancelToken`)."""
        return self._cancel.is_set()

    def check(self) -> None:
        """Raise :class:`stereorig.core.errors.Cancelled` if the job should stop."""
        if self.cancelled:
            raise Cancelled(f"The {self.record.kind} was cancelled.")

    def progress(self, phase: str, done: int, total: int) -> None:
        """Report progress (:class:`stereorig.core.progress.Progress`)."""
        if self._pace.to(phase, done, total):
            self._publish(self, "progress")

    def await_part(self, part: str) -> None:
        """Report that it waits for something outside; the progress so far stays."""
        now = self._pace.progress(active=False)
        self.progress(part, now.done, now.total)

    @property
    def result(self) -> dict[str, object] | None:
        """Result so far."""
        return self.record.result

    @result.setter
    def result(self, found: dict[str, object]) -> None:
        self._change(result=found)

    @contextmanager
    def waiting(self, stop: Callable[[], None]) -> Iterator[None]:
        """Wait for something that ``stop`` ends, at once, when the job is cancelled."""
        self._stop_waiting = stop
        try:
            yield
        finally:
            self._stop_waiting = None

    # for its manager -------------------------------------------------------------------------------------------

    def made(self, ids: Ids) -> None:
        """Add the ids of entries made for it to its subject."""
        self._change(subject={**self.record.subject, **ids})

    def await_lane(self) -> None:
        """Wait for its turn, in no units."""
        self._pace.reset()

    def begin(self) -> bool:
        """Set its state to running; return False where an earlier phase did."""
        if self.record.state != "queued":
            return False
        self._change(state="running", started_utc=now_utc())
        return True

    def cancel(self) -> None:
        """Have it stop at its next check."""
        self._cancel.set()

    def cancelling(self) -> None:
        """Show that it is to stop, if it runs."""
        if self.record.state == "running":
            self._change(state="cancelling")

    def interrupt(self) -> None:
        """Stop its waiting, if it waits."""
        stop = self._stop_waiting
        if stop is not None:
            stop()

    def failed(self, problem: JobProblem | None) -> None:
        """Keep why it has no result."""
        self._change(problem=problem)

    def end(self, record: JobRecord) -> None:
        """Take the record of its end."""
        self._change(state=record.state, finished_utc=record.finished_utc)

    def document(self) -> JobRecord:
        """Return the job as the API shows and the catalogue keeps it."""
        record = self.record
        return record.model_copy(update={"progress": self._pace.progress(active=record.state in ACTIVE)})

    def _change(self, **fields: object) -> None:
        with self._guard:  # who cancels it and who runs it are two threads
            self.record = self.record.model_copy(update=fields)
