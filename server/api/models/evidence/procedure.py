"""Verification procedures, as they travel."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stereorig.server.base.models import Reply, Request
from stereorig.server.results.certificate.plan import CertificatePlan
from stereorig.server.results.certificate.procedure import By, Kind


class NextRequest(Request):
    """Confirmation that the bench is ready for the next step."""

    confirmed: bool = Field(False, description="True: the person's part of this step is done.")


class ProcedureStepReply(Reply):
    """One step of a procedure."""

    n: int = Field(description="Number that the test gives it; 0 is the reference.")
    kind: Kind = Field(description="Its purpose; `free`: the plan names none.")
    by: By = Field(description="Mover of the specimen: none, the stage, or a person, who confirms it.")
    what: str = Field(description="What is done.")
    label: str = Field(description="Label that the step gets.")
    stage_mm: float | None = Field(
        None, description="Stage position along Z, from its position at the reference; null: not moved."
    )
    state: Literal["taken", "missing", "to_come"] = Field(
        description="`missing`: its number was given, and the step is not there any more."
    )


class ProcedureReply(Reply):
    """A test's verification procedure."""

    plan: CertificatePlan | None = Field(
        description="The plan, as `POST /certificates` takes it once all steps are measured; null: none was put."
    )
    frames: int = Field(description="Frames averaged at each step.")
    steps: list[ProcedureStepReply] = Field(description="Its steps, in order.")
    next: int | None = Field(description="Number of the next step; null once all are taken.")
