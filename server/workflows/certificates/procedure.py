"""A verification procedure on the rig: the next step's move and capture as one job."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

from stereorig.core.errors import StateError
from stereorig.core.names import CAMERAS
from stereorig.server.base.errors import NotFoundError
from stereorig.server.documents.steps import StepMetadata
from stereorig.server.jobs.idempotency import RequestMark
from stereorig.server.jobs.job import Job, Phase
from stereorig.server.results.certificate.procedure import PlannedProcedure, ProcedureStep, next_step, procedure_of
from stereorig.server.workflows.capture import commit_pair
from stereorig.server.workflows.service import Service


def put_procedure(service: Service, test_id: str, asked: PlannedProcedure) -> None:
    """Keep a procedure with a test; durable when this returns.

    Raises
    ------
    InputError
        ``procedure_order``.
    """
    procedure_of(asked.plan, moves=service.config.calibration.moves)
    service.tests.put_procedure(test_id, asked.model_dump(mode="json", exclude_unset=True))


def planned(service: Service, test_id: str) -> PlannedProcedure:
    """Return a test's procedure.

    Raises
    ------
    NotFoundError
        ``procedure_missing``.
    """
    document = service.tests.procedure(test_id)
    if not document:
        raise NotFoundError(
            f"Test {test_id} has no procedure.",
            code="procedure_missing",
            remedy="PUT .../certificate-plan with the plan that is to be carried out.",
        )
    return PlannedProcedure.model_validate(document)


def show_procedure(service: Service, test_id: str) -> dict[str, object]:
    """Return a test's procedure: its plan, its steps with their state, and the next one; no plan if it has none."""
    if not service.tests.procedure(test_id):
        return {"plan": None, "frames": 1, "steps": [], "next": None}
    asked = planned(service, test_id)
    steps = procedure_of(asked.plan, moves=service.config.calibration.moves)
    number = service.tests.steps.next_number(test_id)
    taken = {int(str(one["n"])) for one in service.catalog.entries("step", test_id, limit=len(steps))}
    following = next_step(steps, number)
    states = {step.n: "taken" if step.n in taken else "missing" if step.n < number else "to_come" for step in steps}
    return {
        "plan": asked.plan.model_dump(mode="json", exclude_unset=True),
        "frames": asked.frames,
        "steps": [{**asdict(step), "state": states[step.n]} for step in steps],
        "next": None if following is None else following.n,
    }


def start_next(service: Service, test_id: str, *, confirmed: bool, request: RequestMark) -> Job:
    """Begin the next step: the stage's move if the step has one, then the capture; the job's result has its number.

    Raises
    ------
    NotFoundError
        ``procedure_missing``.
    StateError
        ``procedure_complete``; ``procedure_by_hand`` if a person has to move something and has not confirmed that it
        is done.
    StorageError
        ``storage_full``.
    """
    service.require_room()
    asked = planned(service, test_id)
    steps = procedure_of(asked.plan, moves=service.config.calibration.moves)
    step = next_step(steps, service.tests.steps.next_number(test_id))
    if step is None:
        raise StateError(
            f"All {len(steps)} steps of the procedure are taken.",
            code="procedure_complete",
            remedy="Measure the steps with strain, then POST /certificates with this plan.",
        )
    if step.by == "hand" and not confirmed:
        raise StateError(
            f"Step {step.n} is taken by hand. {step.what}",
            code="procedure_by_hand",
            remedy="Do it, then send the request with confirmed = true.",
            n=step.n,
        )
    return service.jobs.submit(
        "procedure",
        f"step {step.n} of a verification procedure",
        {"test_id": test_id, "n": step.n},
        [Phase("hardware", lambda job: _take(service, job, test_id, step, asked.frames))],
        on_cancel=service.stop_job,
        request=request,
    )


def _take(service: Service, job: Job, test_id: str, step: ProcedureStep, frames: int) -> dict[str, object]:
    rig = service.rig
    if step.stage_mm is not None:
        reference = _stage_at_reference(service, test_id)
        targets = rig.targets_for_dz({cam: reference[cam] + step.stage_mm for cam in CAMERAS})
        rig.check_targets(targets)
        job.progress("moving", 0, 2)
        rig.move(targets, job.check)
    job.progress("capturing", 1, 2)
    captured, positions = rig.pair.capture(frames, job.check), rig.known_positions()
    taken = commit_pair(service, test_id, StepMetadata(label=step.label), captured, positions)
    job.progress("capturing", 2, 2)
    return {"n": taken.n, "kind": step.kind, "quality": taken.quality_code}


def _stage_at_reference(service: Service, test_id: str) -> Mapping[str, float]:
    """Return dZ by camera as it was read back at the reference.

    Raises
    ------
    StateError
        ``procedure_reference`` if the reference was not captured on this rig.
    """
    known = service.tests.steps.read(test_id, 0).document.plain().get("dz_mm")
    if not isinstance(known, dict) or not all(isinstance(known.get(cam), int | float) for cam in CAMERAS):
        raise StateError(
            "The stage's position at the reference is not known: step 0 was not captured with it.",
            code="procedure_reference",
            remedy="Begin the procedure in a new test, whose reference the service captures.",
        )
    return {cam: float(known[cam]) for cam in CAMERAS}
