"""``stereorig certify --run``: the steps of a certificate's plan, taken one by one on a running service."""

from __future__ import annotations

from pathlib import Path

from core.errors import InputError
from server.api.models.evidence.procedure import ProcedureReply, ProcedureStepReply
from server.demo.client import ServiceClient
from server.results.certificate.plan import load_plan


def carry_out(plan: Path, test_id: str | None, *, frames: int, url: str, key: str | None) -> int:
    """Plan the procedure in a test and take every step that is not taken yet; return 0.

    Parameters
    ----------
    plan
        Its file.
    test_id
        A test that is there, whose procedure goes on; None: a new one with the newest accepted calibration.

    Raises
    ------
    InputError
        ``certificate_plan_invalid``, ``procedure_order``; ``procedure_by_hand`` where nobody can be asked.
    StateError
        The service's refusal.
    MeasurementError
        A step that could not be taken; it is taken first when the command is run again.
    """
    asked = load_plan(plan)
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}
    with ServiceClient(url.rstrip("/"), headers=headers) as client:
        if test_id is None:
            body = {"name": asked.title or "verification", "calibration_id": "latest"}
            test_id = str(client.call("POST", "/tests", json=body).json()["id"])
            print(f"test {test_id}")
        path = f"/tests/{test_id}/certificate-plan"
        sent = {"plan": asked.model_dump(mode="json", exclude_unset=True), "frames": frames}
        now = ProcedureReply.model_validate(client.call("PUT", path, json=sent).json())
        while now.next is not None:
            step = next(one for one in now.steps if one.n == now.next)
            print(f"step {step.n} of {len(now.steps) - 1}: {step.what}")
            _asked(step)
            job = client.call("POST", f"{path}:next", json={"confirmed": step.by == "hand"}).json()["job"]
            client.wait(str(job["id"]))
            print(f"  taken: {step.label or step.kind}")
            now = ProcedureReply.model_validate(client.call("GET", path).json())
    print(f"All {len(now.steps)} steps are taken. Measure them with strain, then: stereorig certify DATA {plan}")
    print(f"  --test {test_id}")
    return 0


def _asked(step: ProcedureStepReply) -> None:
    """Wait until a person has done what a step asks for."""
    if step.by != "hand" and step.n > 0:
        return
    try:
        input("  Press Enter when it is done. ")
    except EOFError as error:
        raise InputError(
            f"Step {step.n} is taken by hand, and nobody can be asked here. {step.what}",
            code="procedure_by_hand",
            remedy="Run the command in a terminal; steps that are taken stay taken.",
        ) from error
