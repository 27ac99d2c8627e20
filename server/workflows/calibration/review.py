"""Plans of calibrations before they are carried out, and decisions on calibrations afterwards."""

from __future__ import annotations

import math
from typing import Literal

from stereorig.core.errors import StateError
from stereorig.core.plan.settings import PlannedMeasurement, PlannedRig
from stereorig.server.store.folder import now_utc
from stereorig.server.store.indexing.entries import calibration_entry
from stereorig.server.workflows.calibration.sequence import CalibrationPlan, check_plan, rig_metadata, targets_of
from stereorig.server.workflows.service import Service

Decision = Literal["accepted", "discarded"]
#: name of the newest accepted calibration
LATEST = "latest"


def expectation(
    service: Service,
    plan: CalibrationPlan,
    *,
    noise_px: float | None,
    roll_deg: float | None,
    rig: PlannedRig,
    measurement: PlannedMeasurement,
) -> dict[str, object]:
    """Return the uncertainty to expect from a calibration plan, as the API shows it.

    Raises
    ------
    CalibrationInputError
        A plan that would be refused before anything moves.
    StateError
        If the stage cannot reach a position of the plan.
    """
    from stereorig.server.compute.calibration.expectation import (  # slow to load, and not every start needs it
        PlannedCalibration,
        expectation_document,
        rig_as_planned,
    )

    check_plan(plan)
    if roll_deg is None:
        roll_deg = _newest_roll_deg(service)
    as_it_is = rig == PlannedRig()
    if service.rig.config.stage is not None and as_it_is:
        targets_of(service, plan)
    return expectation_document(
        rig_as_planned(rig_metadata(service.config), rig),
        PlannedCalibration(
            positions_mm=plan.positions_mm, localiser=plan.localiser, noise_px=noise_px, roll_deg=roll_deg
        ),
        measurement,
    )


def _newest_roll_deg(service: Service) -> float:
    """Return the target's turn before camera 1, degrees, as the rig's newest complete calibration found it; else 0."""
    complete = (str(e["id"]) for e in service.catalog.entries("calibration") if e.get("state") == "complete")
    for calibration_id in sorted(complete, reverse=True):
        made = service.calibrations.read(calibration_id)
        camera = (made.model_extra or {}).get("cam1")
        # imported and uploaded ones show no view of this rig; a guided one's poses are free
        staged = bool(made.taken) and made.plan.source is None and made.plan.plain().get("kind") != "guided"
        if staged and isinstance(camera, dict) and isinstance(camera.get("alpha_rad"), float):
            return round(math.degrees(camera["alpha_rad"]), 3)
    return 0.0


def decide(service: Service, calibration_id: str, decision: Decision | None, note: str, by: str) -> None:
    """Keep the decision on a calibration; None takes an earlier decision back.

    Raises
    ------
    NotFoundError
        If there is no such calibration.
    StateError
        ``calibration_not_complete`` if there is no calibration to accept.
    """
    state = service.calibrations.read(calibration_id).state
    if state == "unfinished" or (state != "complete" and decision == "accepted"):
        raise StateError(
            f"Calibration {calibration_id} is {state}.",
            code="calibration_not_complete",
            remedy="Decide on a calibration that has ended; only complete ones can be accepted.",
            state=state,
        )
    document = None if decision is None else {"decision": decision, "note": note, "by": by, "decided_utc": now_utc()}
    service.calibrations.put_review(calibration_id, document)
    entry = calibration_entry(service.calibrations, calibration_id)
    service.catalog.put_entry("calibration", "", calibration_id, entry)
    service.hub.publish("calibration", {"calibration_id": calibration_id, "state": entry["state"]})


def newest_accepted(service: Service) -> str:
    """Return the id of the calibration that was made last of those accepted.

    Raises
    ------
    StateError
        ``no_calibration_accepted``.
    """
    accepted = [str(e["id"]) for e in service.catalog.entries("calibration") if e.get("decision") == "accepted"]
    if not accepted:
        raise StateError(
            "No calibration has been accepted.",
            code="no_calibration_accepted",
            remedy="Accept one (PUT /calibrations/{id}/review), or name one by its id.",
        )
    return max(accepted)


def check_not_discarded(service: Service, calibration_id: str) -> None:
    """Refuse a discarded calibration.

    Raises
    ------
    StateError
        ``calibration_discarded``.
    """
    review = service.calibrations.read(calibration_id).review
    if review is not None and review.decision == "discarded":
        why = f": {review.note}" if review.note else "."
        raise StateError(
            f"Calibration {calibration_id} was discarded{why}",
            code="calibration_discarded",
            remedy="Use another one, or take the decision back.",
        )
