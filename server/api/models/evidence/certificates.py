"""Certificates, as they travel."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from stereorig.server.base.models import Label, Listing, Reply, Request
from stereorig.server.results.certificate.plan import CertificatePlan
from stereorig.server.results.certificate.procedure import By, Kind

Outcome = Literal["pass", "conditional", "fail"]


class CertificateRequest(Request):
    """A certificate to make from an analysis' results."""

    test_id: Annotated[str, StringConstraints(max_length=40)] = Field(
        description="Test whose steps were taken for it.", examples=["t000001-a31f0c"]
    )
    analysis_id: Annotated[str, StringConstraints(max_length=40)] = Field(
        description="Analysis that measured them.", examples=["a000001-77d0b3"]
    )
    plan: CertificatePlan = Field(description="Known values of the steps, and the requirements on the system.")


class WithdrawRequest(Request):
    """Withdrawal of a certificate."""

    reason: Annotated[Label, StringConstraints(min_length=1)] = Field(
        description="Why it does not hold any more.", examples=["The lens of camera 2 was exchanged."]
    )


class CertificateFinding(Reply):
    """A reason of a verdict, or a suspect."""

    code: str = Field(description="Stable name.", examples=["calibration_scale"])
    text: str = Field(description="The finding with its figures.")
    remedy: str = Field(description="What to do.")


class CertificateReason(CertificateFinding):
    """Why a verdict is no pass."""

    outcome: Outcome = Field(description="Lowest verdict that it allows.")


class CertificateEntry(Reply):
    """Entry of a certificate in a list."""

    id: str = Field(description="Id.", examples=["v000001-5d0a3f"])
    title: str = Field(description="Object of the certificate.")
    outcome: Outcome = Field(description="The verdict when it was made.")
    state: Literal["valid", "failed", "expired", "void", "withdrawn"] = Field(
        description="Whether it holds now: `void` once another calibration was made after it."
    )
    why: str = Field(description="Reason why it does not hold; empty if it does.")
    created_utc: str = Field(description="Time at which it was made.")
    valid_until_utc: str | None = Field(description="Time until which it holds; null of one that failed.")
    test_id: str | None = Field(description="Its test.")
    analysis_id: str | None = Field(description="Its analysis.")


class CertificateReply(CertificateEntry):
    """A certificate; its tables as further entries, as in certificate.json."""

    reasons: list[CertificateReason] = Field(description="Reasons why it is no pass; empty for a pass.")
    suspects: list[CertificateFinding] = Field(description="Suspected causes, the most probable first.")


class CertificateList(Listing):
    """Certificates, oldest first."""

    certificates: list[CertificateEntry] = Field(description="Short entry of each.")


# Verification procedures, as they travel.


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
