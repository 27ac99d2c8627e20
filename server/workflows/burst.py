"""A burst: steps at an interval, as one job that holds the cameras; each step is durable before it is announced."""

from __future__ import annotations

import time

from stereorig.core.errors import MeasurementError, StereorigError
from stereorig.server.base.metrics import timed_capture
from stereorig.server.base.problem import JobProblem, problem_of
from stereorig.server.documents.steps import BurstIndex, StepMetadata, StepRecord
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.workflows.capture import commit_pair
from stereorig.server.workflows.service import Service

_POLL_S = 0.02
#: errors that may spoil one pair and not the next; any other ends the burst
_OF_THE_PAIR = frozenset({"skew_too_large", "pair_incomplete", "frame_incomplete"})


class BurstIncompleteError(MeasurementError):
    """Some steps of a burst were not taken; the others were, and are kept."""

    code = "burst_incomplete"
    remedy = "Read the job's result: steps that were taken, and each failure's problem. Take the missing ones again."


def start_burst(
    service: Service,
    test_id: str,
    metadata: StepMetadata,
    *,
    count: int,
    interval_ms: float,
    frames: int,
    request: RequestMark,
) -> str:
    """Take ``count`` steps, ``interval_ms`` from one beginning to the next; return the job's id.

    Raises
    ------
    BusyError
        A job or another client has the cameras.
    StorageError
        ``storage_full``.
    """
    service.require_room()
    job = service.jobs.submit(
        "burst",
        f"a burst of {count} steps",
        {"test_id": test_id},
        [Phase("hardware", lambda job: _run(service, job, test_id, metadata, count, interval_ms, frames))],
        request=request,
    )
    return job.id


def _run(
    service: Service, job: Job, test_id: str, metadata: StepMetadata, count: int, interval_ms: float, frames: int
) -> dict[str, object]:
    steps: list[dict[str, object]] = []
    failures: list[dict[str, object]] = []
    problems: list[tuple[int, JobProblem]] = []
    result: dict[str, object] = {"test_id": test_id, "count": count, "steps": steps, "failures": failures}
    job.result = result
    began = time.monotonic()
    first_ns: int | None = None
    for index in range(count):
        job.progress("steps", index, count)
        _wait_until(job, began + index * interval_ms / 1000.0)
        burst_index = BurstIndex(job_id=job.id, index=index, count=count, interval_ms=interval_ms, since_first_ms=0.0)
        try:
            step = _take(service, job, test_id, metadata, frames, burst_index, first_ns)
        except StereorigError as error:
            if error.code not in _OF_THE_PAIR:
                raise
            problem = problem_of(error)
            problems.append((index, problem))
            failures.append({"index": index, "problem": problem.plain()})
            continue
        first_ns = step.host_monotonic_ns if first_ns is None else first_ns
        taken = {"index": index, "n": step.n, "since_first_ms": step.burst and step.burst.since_first_ms}
        steps.append({**taken, "quality": step.quality_code, "sha256": step.sha256})
    job.progress("steps", count, count)
    if problems:
        first, why = problems[0]
        raise BurstIncompleteError(
            f"{len(problems)} of {count} steps were not taken; the first, number {first}: {why.detail}",
            failed=[index for index, _ in problems],
        )
    return result


@timed_capture("capture")
def _take(
    service: Service,
    job: Job,
    test_id: str,
    metadata: StepMetadata,
    frames: int,
    burst_index: BurstIndex,
    first_ns: int | None,
) -> StepRecord:
    service.require_room()
    captured, positions = service.rig.pair.capture(frames, job.check), service.rig.known_positions()
    since_ns = 0 if first_ns is None else captured.host_ns - first_ns
    burst = burst_index.model_copy(update={"since_first_ms": round(since_ns / 1e6, 3)})
    return commit_pair(service, test_id, metadata.model_copy(update={"burst": burst}), captured, positions)


def _wait_until(job: Job, moment: float) -> None:
    """Wait, and check every 20 ms for the burst's end; return at once if the moment has passed."""
    while True:
        job.check()
        left = moment - time.monotonic()
        if left <= 0.0:
            return
        time.sleep(min(left, _POLL_S))
