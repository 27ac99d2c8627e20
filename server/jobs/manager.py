"""Jobs: anything that takes longer than a request.

A job goes through phases, each on a lane: ``hardware`` (exclusive, never queued) or ``compute`` (queued, bounded, one
time); or it has one phase ``beside`` both. Its states are ``queued running cancelling succeeded failed cancelled
interrupted``. A job is in the catalogue before it is acknowledged; a job that was unfinished when the service ended is
``interrupted`` after the next start.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from stereorig.core.errors import Cancelled, StateError, StereorigError, StorageError
from stereorig.server.base.errors import NotFoundError, QueueFullError
from stereorig.server.base.json_values import without_nan
from stereorig.server.base.logs import about
from stereorig.server.base.models import Ids
from stereorig.server.base.problem import RESTART, problem_of
from stereorig.server.documents.jobs import JobRecord
from stereorig.server.jobs.events import EventHub
from stereorig.server.jobs.hardware import HardwareHold
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import ACTIVE, Job, Phase, State, Waiting, Work, new_record
from stereorig.server.store.catalog import Catalog
from stereorig.server.store.folder import IdMaker, is_id, now_utc

_log = logging.getLogger("stereorig.jobs")


#: entries of each list in a result that an event holds; further ones are asked for
_SHOWN = 100


class JobManager:
    """Runs jobs, keeps their table.

    Parameters
    ----------
    queue_limit
        How many compute phases may wait; beyond it :class:`QueueFullError`.
    """

    def __init__(
        self, catalog: Catalog, hub: EventHub, hardware: HardwareHold, ids: IdMaker, *, queue_limit: int = 16
    ) -> None:
        self._catalog = catalog
        self._hub = hub
        self._hardware = hardware
        self._ids = ids
        self.queue_limit = queue_limit
        self._lock = threading.Lock()
        self._active: dict[str, Job] = {}
        self._unsaved: dict[str, JobRecord] = {}  # how jobs ended that a full disk has no room for
        self._queue: deque[Job] = deque()
        self._parked: set[Job] = set()  # compute jobs that wait for something to do; they hold no lane
        self._reserved = 0  # jobs that will come to the compute lane after their hardware phase
        self._wake = threading.Condition(self._lock)
        self._closing = False
        self._thread = threading.Thread(target=self._run_compute, name="compute-jobs", daemon=True)

    def start(self) -> None:
        """Mark the jobs that the last service left running as interrupted, and begin to work."""
        self._interrupt_left_overs()
        self._thread.start()

    def _interrupt_left_overs(self) -> None:
        newest = self._catalog.newest_job()
        if newest is not None:
            self._ids.reserve(newest)
        for document in self._catalog.jobs(states=ACTIVE):
            self._catalog.put_job(document.ended("interrupted", now_utc(), problem_of(RESTART)))

    # making and finding ----------------------------------------------------------------------------------------

    def submit(
        self,
        kind: str,
        purpose: str,
        subject: Mapping[str, object],
        phases: Sequence[Phase],
        *,
        prepare: Callable[[Job], Ids] | None = None,
        request: RequestMark | None = None,
        on_end: Callable[[Job, State], None] | None = None,
        on_cancel: Callable[[Job], None] | None = None,
        follows: str | None = None,
        without_disk: bool = False,
    ) -> Job:
        """Acknowledge a job and start it.

        Parameters
        ----------
        purpose
            The holder's name as a busy caller will read it.
        prepare
            Runs once it is certain that the job is accepted, before it starts; the ids that it returns are added
            to the subject.
        request
            Mark of the request for the job: written with it, so that a crash leaves both or none.
        follows
            Id of a test whose new steps wake the job when it waits.
        without_disk
            Start it though the disk does not take its record, which is then written as soon as there is room; never
            for a request that must have one effect only.

        Raises
        ------
        BusyError
            The first phase needs the hardware, which another job holds.
        QueueFullError
            Too many computations wait.
        """
        work = Work(phases, on_end=on_end, on_cancel=on_cancel, follows=follows)
        job = Job(new_record(self._ids.new("j"), kind, subject), work, self._show)
        if work.computes:
            self._reserve()
        token: object | None = None
        try:
            if phases[0].lane == "hardware":
                token = self._hardware.claim(purpose, job_id=job.id, kind=kind)
            made = prepare(job) if prepare is not None else {}
            job.made(made)
            row = None if request is None else request.made({**made, "job_id": job.id})
            try:
                self._catalog.put_job(job.document(), row)
            except StorageError:
                if row is not None or not without_disk:
                    raise
                _log.warning("the record of job %s (%s) is kept in memory: the disk does not take it", job.id, kind)
        except BaseException:
            if token is not None:
                self._hardware.release(token)
            if work.computes:
                self._unreserve()
            raise
        with self._lock:
            self._active[job.id] = job
        self._hub.publish("job", job.document().plain())
        if token is not None:
            self._hardware.start(lambda: self._run_hardware(job, token))
        elif phases[0].lane == "beside":
            threading.Thread(target=self._run_beside, args=(job,), name=f"beside-{job.id}", daemon=True).start()
        else:
            self._enqueue(job)
        return job

    def _reserve(self) -> None:
        with self._lock:
            if self._closing:
                raise StateError("The service is shutting down.", code="shutting_down", remedy="Start it again.")
            if self._reserved >= self.queue_limit:
                raise QueueFullError(f"{self._reserved} computations are waiting, the limit is {self.queue_limit}.")
            self._reserved += 1

    def _unreserve(self) -> None:
        with self._lock:
            self._reserved -= 1

    def document(self, job_id: str) -> JobRecord:
        """Return a job of this or an earlier run."""
        with self._lock:
            job, ended = self._active.get(job_id), self._unsaved.get(job_id)
        if job is not None:
            return job.document()
        if ended is not None:
            return ended
        found = self._catalog.job(job_id) if is_id(job_id, "j") else None
        if found is None:
            raise NotFoundError(f"There is no job {job_id[:40]!r}.", kind="job")
        return found

    def documents(self, limit: int, *, before: str | None = None, most: int | None = None) -> list[JobRecord]:
        """Return jobs, newest first; ``before`` and ``most`` as in :meth:`Catalog.jobs`."""
        with self._lock:
            active = self._unsaved | {j.id: j.document() for j in self._active.values()}
        if most is not None:
            active = {name: one.bounded(most) for name, one in active.items()}
        return [active.get(d.id, d) for d in self._catalog.jobs(limit=limit, before=before, most=most)]

    def is_active(self, job_id: str) -> bool:
        """Return True if a job is not finished."""
        with self._lock:
            return job_id in self._active

    def active_count(self) -> int:
        """Number of jobs that are not finished."""
        with self._lock:
            return len(self._active)

    def is_idle(self) -> bool:
        """Return True if no job is running, and the state of each is on disk."""
        with self._lock:
            return not self._active and not self._unsaved

    def waiting_count(self) -> int:
        """Number of jobs that wait for the compute lane."""
        with self._lock:
            return len(self._queue)

    def cancel(self, job_id: str) -> JobRecord:
        """Ask a job to stop.

        Raises
        ------
        StateError
            ``job_finished`` if there is nothing left to cancel.
        """
        with self._lock:
            job = self._active.get(job_id)
            if job is not None:
                job.cancel()
                waiting = job in self._queue or job in self._parked
                if job in self._queue:
                    self._queue.remove(job)
                    self._reserved -= 1
                elif waiting:
                    self._parked.remove(job)
                else:
                    job.cancelling()
        if job is None:
            state = self.document(job_id).state
            raise StateError(
                f"Job {job_id} is {state} already.",
                code="job_finished",
                remedy="There is nothing to cancel.",
                state=state,
            )
        job.interrupt()
        if job.work.on_cancel is not None:
            job.work.on_cancel(job)
        if waiting:
            self._end(job, "cancelled", Cancelled(f"The {job.record.kind} was cancelled while it waited."))
        else:
            self._save(job)
            self._show(job, "state")
        return job.document()

    def step_committed(self, test_id: str) -> None:
        """Wake the jobs that follow a test."""
        with self._lock:
            followers = [job for job in self._active.values() if job.work.follows == test_id]
        for job in followers:
            self._rouse(job)

    def finish(self, job_id: str) -> JobRecord:
        """Let a job that follows a test end once it has measured all present steps.

        Raises
        ------
        StateError
            ``not_following`` if it follows nothing, or has ended.
        """
        with self._lock:
            job = self._active.get(job_id)
        if job is None or job.work.follows is None:
            raise StateError(
                f"Job {job_id} follows no test." if job is not None else f"Job {job_id} has ended.",
                code="not_following",
                remedy="Only an analysis made with follow = true can be finished, while it runs.",
            )
        job.finishing.set()
        self._rouse(job)
        return job.document()

    def _rouse(self, job: Job) -> None:
        with self._wake:
            job.woken.set()
            if job in self._parked and not self._closing:
                self._parked.remove(job)
                self._queue.append(job)
                self._reserved += 1
                self._wake.notify()

    def _park(self, job: Job) -> bool:
        """Suspend a job until it is woken; False if it was woken already or is to end, and should continue."""
        with self._wake:
            if job.woken.is_set() or job.cancelled or self._closing:
                return False
            self._parked.add(job)
            return True

    def cancel_hardware(self) -> str | None:
        """Cancel the job that holds the hardware, if one does; return its id."""
        holder = self._hardware.holder
        job_id = None if holder is None else holder.job_id
        if job_id is None:
            return None
        with self._lock:
            job = self._active.get(job_id)
            if job is None:
                return None
            job.cancel()
        return job_id

    # running ---------------------------------------------------------------------------------------------------

    def _enqueue(self, job: Job) -> None:
        with self._wake:
            if not self._closing:
                job.await_lane()
                self._queue.append(job)
                self._wake.notify()
                return
        self._end(job, "interrupted", RESTART)

    def _run_hardware(self, job: Job, token: object) -> None:
        # a client that reads of its end may begin something else at once
        job.let_go = lambda: self._hardware.release(token)
        try:
            with about(job_id=job.id):
                finished = self._run_phase(job, 0)
        finally:
            self._hardware.release(token)
        if not finished:
            if job.work.computes:
                self._unreserve()
        elif len(job.work.phases) > 1:
            self._enqueue(job)
        else:
            self._end(job, "succeeded", None)

    def _run_beside(self, job: Job) -> None:
        with about(job_id=job.id):
            if self._run_phase(job, 0):
                self._end(job, "succeeded", None)

    def _run_compute(self) -> None:
        while True:
            with self._wake:
                while not self._queue and not self._closing:
                    self._wake.wait()
                if self._closing:
                    return
                job = self._queue.popleft()
                self._reserved -= 1
            index = 0 if job.work.phases[0].lane == "compute" else 1
            with about(job_id=job.id):
                if self._run_phase(job, index):
                    self._end(job, "succeeded", None)

    def _run_phase(self, job: Job, index: int) -> bool:
        try:
            job.check()
            if job.begin():
                self._save(job)
                self._show(job, "state")
            while True:
                job.woken.clear()
                try:
                    result = job.work.phases[index].run(job)
                except Waiting:
                    if self._park(job):
                        return False
                    job.check()
                    continue
                break
            if result:
                job.result = {**(job.result or {}), **without_nan(dict(result))}
            job.check()
        except Cancelled as error:
            self._end(job, "interrupted" if self._closing else "cancelled", RESTART if self._closing else error)
            return False
        except Exception as error:  # noqa: BLE001 - the job's failure, not the service's
            if job.cancelled and isinstance(error, StereorigError) and error.code == "stage_stopped":
                self._end(job, "interrupted" if self._closing else "cancelled", RESTART if self._closing else error)
                return False
            if not isinstance(error, StereorigError):
                _log.exception("job %s (%s) failed", job.id, job.record.kind)
            self._end(job, "failed", error)
            return False
        return True

    def _end(self, job: Job, state: State, error: BaseException | None) -> None:
        job.failed(None if error is None else problem_of(error))
        if job.work.on_end is not None:
            try:
                job.work.on_end(job, state)
            except Exception as second:  # noqa: BLE001 - a result that was not kept is no success
                _log.exception("closing job %s failed", job.id)
                state = "failed"
                job.failed(problem_of(second))
        ended = now_utc()
        if job.let_go is not None:
            job.let_go()
        # a job's end is visible only once it is on disk
        final = job.document().ended(state, ended, job.record.problem)
        self._save(job, final)
        with self._lock:
            job.end(final)
            self._active.pop(job.id, None)
        self._show(job, "state")

    def _save(self, job: Job, final: JobRecord | None = None) -> None:
        try:
            with job.saving:  # the newest document is the last one written
                if job.ended:
                    return
                job.ended = final is not None
                if final is not None:
                    with self._lock:
                        self._unsaved[job.id] = final
                self._catalog.put_job(final or job.document())
                with self._lock:
                    self._unsaved.pop(job.id, None)
                    late = list(self._unsaved.values())
            for document in late:  # there is room again
                self._catalog.put_job(document)
                with self._lock:
                    self._unsaved.pop(document.id, None)
        except StorageError:
            _log.exception("the state of job %s could not be written", job.id)

    def _show(self, job: Job, change: str) -> None:
        document = {**job.document().kept().bounded(_SHOWN).plain(), "change": change}
        if change == "progress":
            del document["result"]  # progress comes ten times a second
        self._hub.publish("job", document)

    def begin_close(self) -> None:
        """Accept nothing more; a job that ends from now on without its result counts as interrupted."""
        with self._wake:
            self._closing = True
            self._wake.notify_all()

    @property
    def alive(self) -> bool:
        """Return True if the compute lane runs."""
        return self._thread.is_alive() or self._closing

    def close(self) -> None:
        """Interrupt everything; returns when the compute lane has ended."""
        with self._wake:
            self._closing = True
            queued = [*self._queue, *self._parked]
            self._queue.clear()
            self._parked.clear()
            active = [j for j in self._active.values() if j not in queued]
            self._wake.notify_all()
        for job in queued:
            self._end(job, "interrupted", RESTART)
        for job in active:
            job.cancel()
            if job.work.on_cancel is not None:
                job.work.on_cancel(job)
        self._thread.join(timeout=5.0)
