"""Verification procedures, as they travel."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from server.base.models import Reply, Request
from server.results.certificate.plan import CertificatePlan
from server.results.certificate.procedure import By, Kind


class NextRequest(Request):
    """Which state of the bench the next step is taken in."""

    confirmed: bool = Field(False, description="True: what a person has to do for this step is done.")


class ProcedureStepReply(Reply):
    """One step of a procedure."""

    n: int = Field(description="Number that the test gives it; 0 is the reference.")
    kind: Kind = Field(description="What it is for; `free`: the plan names nothing for it.")
    by: By = Field(description="Who brings the specimen there: nobody, the stage, or a person, who confirms it.")
    what: str = Field(description="What is done.")
    label: str = Field(description="Label that the step gets.")
    stage_mm: float | None = Field(
        None, description="Where the stage stands, along Z, from where it stood at the reference; null: where it is."
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
