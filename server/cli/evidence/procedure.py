"""``stereorig certify --run``: a certificate's plan carried out on a running service, from its steps to the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stereorig.core.errors import InputError, StateError
from stereorig.server.api.models.evidence.certificates import ProcedureReply, ProcedureStepReply
from stereorig.server.cli.terminal import ProgressLine
from stereorig.server.demo.client import ServiceClient
from stereorig.server.results.certificate.plan import CertificatePlan

if TYPE_CHECKING:
    from stereorig.server.api.models.recipes import Recipe


@dataclass(frozen=True)
class CarriedOut:
    """A certificate that the service made: the document, and its page."""

    document: Mapping[str, object]
    page: bytes


def carry_out(
    plan: CertificatePlan,
    test_id: str | None,
    *,
    frames: int,
    url: str,
    key: str | None,
    recipe: Recipe | None,
    on: ProgressLine,
) -> CarriedOut:
    """Take every step that is not taken yet, measure all that show the body, and make the certificate.

    Parameters
    ----------
    plan
        The plan to carry out.
    test_id
        A test whose procedure is to be continued; None: a new one with the newest accepted calibration.
    frames
        Frames averaged at each step.
    url, key
        Address of the service, and a key for it.
    recipe
        Region and settings of the analysis; None: the test's drawing. Without a region in either, the specimen is
        searched for.
    on
        Prints the progress and the finished steps.

    Raises
    ------
    InputError
        ``certificate_plan_invalid``, ``procedure_order``; ``procedure_by_hand`` without a terminal to ask.
    StateError
        The service's refusal; ``not_calibrated`` before any step is taken.
    MeasurementError
        A step that could not be taken, an analysis or a certificate that failed; steps that are taken stay taken when
        the command is run again.
    """
    headers = {} if key is None else {"Authorization": f"Bearer {key}"}

    def progress(phase: str, done: int, total: int, _left_s: float | None) -> None:
        if total:
            on.status(f"{phase} {done} of {total}")

    with ServiceClient(url.rstrip("/"), progress, headers=headers) as client:
        test_id = _test(client, test_id, plan, on)
        steps = _taken(client, test_id, plan, frames, on)
        body = _asked_of(client, test_id, recipe, on)
        # a step that shows a target in the body's place has no field to match
        body["steps"] = [step.n for step in steps if step.kind != "length"]
        made = client.call("POST", f"/tests/{test_id}/analyses", json=body).json()
        client.wait(str(made["job"]["id"]))
        on.note(f"measured: analysis {made['analysis_id']}")
        sent = {"test_id": test_id, "analysis_id": made["analysis_id"], "plan": _document(plan)}
        job = str(client.call("POST", "/certificates", json=sent).json()["job"]["id"])
        client.wait(job)
        path = f"/certificates/{client.get(f'/jobs/{job}')['result']['certificate_id']}"
        return CarriedOut(client.get(path), client.call("GET", f"{path}/report").content)


def _document(plan: CertificatePlan) -> dict[str, Any]:
    return plan.model_dump(mode="json", exclude_unset=True)


def _test(client: ServiceClient, test_id: str | None, plan: CertificatePlan, on: ProgressLine) -> str:
    """Return the test that the steps are taken in; refuse one without calibration before a body is moved by hand."""
    if test_id is None:
        body = {"name": plan.title or "verification", "calibration_id": "latest"}
        test_id = str(client.call("POST", "/tests", json=body).json()["id"])
        on.note(f"test {test_id}")
    elif client.get(f"/tests/{test_id}").get("calibration_id") is None:
        raise StateError(
            f"Test {test_id} has no calibration: its steps could not be measured.",
            code="not_calibrated",
            remedy="Give it one: on its screen of the page, or PATCH /tests/{id} with calibration_id.",
        )
    return test_id


def _taken(
    client: ServiceClient, test_id: str, plan: CertificatePlan, frames: int, on: ProgressLine
) -> list[ProcedureStepReply]:
    """Plan the procedure, take the steps that are not taken yet; return the steps that are taken."""
    path = f"/tests/{test_id}/certificate-plan"
    sent = {"plan": _document(plan), "frames": frames}
    now = ProcedureReply.model_validate(client.call("PUT", path, json=sent).json())
    while now.next is not None:
        step = next(one for one in now.steps if one.n == now.next)
        on.note(f"step {step.n} of {len(now.steps) - 1}: {step.what}")
        _confirmed(step)
        job = client.call("POST", f"{path}:next", json={"confirmed": step.by == "hand"}).json()["job"]
        client.wait(str(job["id"]))
        on.note(f"  taken: {step.label or step.kind}")
        now = ProcedureReply.model_validate(client.get(path))
    return [step for step in now.steps if step.state == "taken"]


def _confirmed(step: ProcedureStepReply) -> None:
    """Wait until a person has done the action of a step."""
    if step.by != "hand" and step.n > 0:
        return
    try:
        input("  Press Enter when it is done. ")
    except EOFError as error:
        raise InputError(
            f"Step {step.n} is taken by hand, and there is no terminal to ask in. {step.what}",
            code="procedure_by_hand",
            remedy="Run the command in a terminal; steps that are taken stay taken.",
        ) from error


def _asked_of(client: ServiceClient, test_id: str, recipe: Recipe | None, on: ProgressLine) -> dict[str, Any]:
    """Return the analysis to make: region and settings of the recipe, else of the test's drawing."""
    from stereorig.server.api.models.recipes import recipe_in

    drawn = recipe or recipe_in(client.get(f"/tests/{test_id}/workspace"), name="the test's drawing")
    body = drawn.analysis()
    if "region" not in body:
        subset = {name: body[name] for name in ("subset_px",) if name in body}
        found = client.call("POST", f"/tests/{test_id}/region:find", json=subset).json()
        body["region"] = found["region"]
        on.note(f"region: {found['text']}")
    return body
