"""An analysis as a job: one task a step in the worker, each step's file announced once it can be read."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

from core.errors import (
    Cancelled,
    InputError,
    MeasurementError,
    StateError,
    StereorigError,
    StorageError,
)  # fmt: skip
from server.compute import run_task
from server.io.files import sha256_of
from server.io.images import decode_mask, read_image
from server.jobs import Job
from server.noise_sequence import averages_of
from server.problem import problem_of
from server.regions import make_grid
from server.service import Service
from server.store.durable import without_nan
from server.tasks import StepTask, measure_step
from server.worker import WorkerDiedError


def steps_to_measure(service: Service, test_id: str, reference: int, wanted: list[int] | None) -> list[int]:
    """Return the steps of an analysis, the reference first.

    Raises
    ------
    StateError
        ``no_steps`` if the reference does not exist.
    InputError
        ``step_missing`` if a step that was asked for does not exist.
    """
    there = service.tests.step_numbers(test_id)
    if reference not in there:
        raise StateError(
            f"Test {test_id} has no step {reference} to refer to; it has {len(there)} steps.",
            code="no_steps",
            remedy="Capture or import the reference first.",
        )
    if wanted is None:
        wanted = [n for n in there if n > reference]
    missing = [n for n in wanted if n not in there]
    if missing:
        raise InputError(
            f"Test {test_id} has no step {missing[0]}.", code="step_missing", remedy="Ask for steps that exist."
        )
    return [reference, *[n for n in dict.fromkeys(wanted) if n != reference]]


def inputs_of(service: Service, test_id: str, steps: list[int], calibration: Path) -> dict[str, Any]:
    """Checksums of everything that an analysis reads, fixed when it is made."""
    return {
        "calibration_sha256": sha256_of(calibration),
        "steps": {str(n): service.tests.step(test_id, n).document["sha256"] for n in steps},
    }


def check_region(service: Service, test_id: str, reference: int, settings: dict[str, Any], mask: bytes | None) -> None:
    """Refuse a region that leaves nothing to measure, before a job is made of it; see :func:`make_grid`."""
    image = read_image(service.tests.step(test_id, reference).cam1)
    make_grid(settings, None if mask is None else decode_mask(mask), (image.shape[0], image.shape[1]))


class StepsFailedError(MeasurementError):
    """Some steps could not be measured; the others were, and are kept."""

    code = "steps_failed"
    remedy = "Read each step's problem in the summary; the other steps' results stand."


def run_analysis(service: Service, job: Job, test_id: str, analysis_id: str) -> dict[str, Any]:
    """Compute phase of an analysis: a step that fails does not take the others with it.

    Raises
    ------
    StereorigError
        What went wrong with the reference; or, with the same code, with the first other step that failed.
    """
    document = service.tests.analysis(test_id, analysis_id)
    steps: list[int] = document["steps"]
    finished: list[dict[str, Any]] = []
    failed: dict[int, StereorigError] = {}
    job.result = {"analysis_id": analysis_id, "test_id": test_id, "steps_finished": [], "steps": finished}
    for index, n in enumerate(steps):
        job.check()
        previous = finished[-1]["n"] if finished else None

        def progress(stage: str, done: int, of: int, *, index: int = index, n: int = n) -> None:
            # steps are the unit a user thinks in; within a step, the points found so far
            fraction = min(done / of, 1.0) if of > 0 else 0.0
            job.progress(f"step {n}: {stage}", round(1000 * (index + fraction)), 1000 * len(steps))

        started = time.monotonic()
        try:
            task = _task(service, document, n, previous, steps[index + 1] if index + 1 < len(steps) else None)
            summary = run_task(service.worker, job, measure_step, task, progress=progress)
        except (Cancelled, StorageError, WorkerDiedError):
            raise  # not the step's own doing
        except StereorigError as error:
            if n == steps[0] and document["kind"] == "displacement":
                raise
            failed[n] = error
            continue
        finished.append(without_nan({"n": n, **summary, "wall_s": round(time.monotonic() - started, 3)}))
        job.result["steps_finished"] = [s["n"] for s in finished]
        service.hub.publish("result", {"test_id": test_id, "analysis_id": analysis_id, "n": n, "job_id": job.id})
    job.progress("done", 1000 * len(steps), 1000 * len(steps))
    if failed:
        first = min(failed)
        job.result["steps_failed"] = {str(n): problem_of(error) for n, error in failed.items()}
        raise StepsFailedError(
            f"{len(failed)} of {len(steps)} steps failed; step {first}: {failed[first].cause}",
            code=failed[first].code,
            remedy=failed[first].remedy,
            steps_failed=sorted(failed),
        )
    return job.result


def _task(service: Service, document: dict[str, Any], n: int, previous: int | None, following: int | None) -> StepTask:
    test_id, displacement = document["test_id"], document["kind"] == "displacement"
    reference = document["steps"][0] if displacement else n
    ref, now = (service.tests.verified_step(test_id, k) for k in (reference, n))
    checksums = {
        "calibration.json": document["inputs"]["calibration_sha256"],
        **{f"reference_{cam}": digest for cam, digest in ref.document["sha256"].items()},
        **{f"step_{cam}": digest for cam, digest in now.document["sha256"].items()},
    }
    noise = document["settings"].get("noise")
    if noise:
        checksums["noise.json"] = noise["sha256"]
    after = None
    if following is not None and displacement:
        with contextlib.suppress(StereorigError):  # what is wrong with it is said at its own turn
            after = service.tests.step(test_id, following)
    return StepTask(
        folder=str(service.tests.analysis_path(test_id, document["id"])),
        calibration=str(service.tests.calibration_file(test_id)),
        kind="motion" if n != reference else "shape",
        n=n,
        reference=reference,
        images={"ref1": str(ref.cam1), "ref2": str(ref.cam2), "cur1": str(now.cam1), "cur2": str(now.cam2)},
        previous=previous,
        settings=document["settings"],
        inputs=checksums,
        noise=str(service.tests.analysis_path(test_id, document["id"]) / "noise.json") if noise else None,
        averages={
            str(path): averages_of(step.document)
            for step in (ref, now, after)
            if step is not None
            for path in (step.cam1, step.cam2)
        },
        label=now.document["label"],
        load_n=now.document["load_n"],
        following=None if after is None else (str(after.cam1), str(after.cam2)),
    )


def close(service: Service, job: Job, test_id: str, analysis_id: str, state: str) -> None:
    """Write ``summary.json``: what was found in the steps that were finished, whatever became of the job."""
    found = job.result or {}
    document = {
        "analysis_id": analysis_id,
        "state": state,
        "job_id": job.id,
        "problem": job.problem,
        "steps": found.get("steps", []),
        "steps_failed": found.get("steps_failed", {}),
    }
    service.tests.put_summary(test_id, analysis_id, document)
