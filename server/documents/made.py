"""Calibrations, noise measurements, recipes, certificates, and entries of the trash."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import Field

from stereorig.server.base.models import Document, JobState
from stereorig.server.base.problem import JobProblem
from stereorig.server.documents.jobs import Kept, KeptRequest
from stereorig.server.formats.records import Record


class Plan(Kept):
    """``plan.json`` of a calibration or a noise measurement; further entries depend on the kind."""

    created_utc: str
    label: str = ""
    source: str | None = None
    request: KeptRequest | None = None
    job_id: str | None = None


class Failure(JobProblem):
    """``failure.json``: the reason of the failure, and the final state of the job."""

    job_state: JobState = "interrupted"


#: state of a calibration or noise measurement; `cancelled` and `failed` ones have no result to measure with
MadeState = Literal["unfinished", "cancelled", "failed", "complete"]


def failure_state(failure: Mapping[str, object]) -> MadeState:
    """Return the state by a ``failure.json``: ``cancelled`` if the job was cancelled, else ``failed``."""
    return "cancelled" if failure.get("job_state") == "cancelled" else "failed"


class MadeRecord(Document):
    """A calibration or noise measurement as its folder has it: its results are added to these fields."""

    id: str
    state: MadeState
    plan: Plan
    problem: Failure | None = None


class Review(Document):
    """An operator's decision on a calibration."""

    decision: Literal["accepted", "discarded"] = Field(description="The decision.")
    note: str = Field("", description="Reason.")
    by: str = Field("", description="Name of the key, or `local`.")
    decided_utc: str = Field(description="Time of the decision.")


class TakenView(Document):
    """A view in ``view.json``."""

    index: int | None = None
    camera: str | None = None
    full_scale: int | float | None = None
    file: str | None = None
    sha256: str | None = None


class MadeCalibration(MadeRecord):
    """A calibration."""

    taken: list[TakenView] | None = None
    review: Review | None = None
    verdict: object = None


class RecipeRecord(Document):
    """A recipe's file; its content is checked when it is used."""

    id: str
    name: str
    created_utc: str | None = None
    changed_utc: str | None = None
    recipe: dict[str, object] = Field(default_factory=dict)


class TrashEntry(Record, Document):
    """Something that was deleted and can be restored."""

    id: str = Field(description="Id in the trash.", examples=["x000001-3f09aa"])
    kind: Literal["test", "step", "analysis", "calibration", "noise", "unknown"] = Field(description="Kind of thing.")
    test_id: str | None = Field(None, description="Its test, or itself.")
    n: int | None = Field(None, description="Number of a step.")
    analysis_id: str | None = Field(None, description="Id of an analysis.")
    calibration_id: str | None = Field(None, description="Id of a calibration.")
    noise_id: str | None = Field(None, description="Id of a noise measurement.")
    name: str = Field("", description="Its name, as users gave it.")
    deleted_utc: str | None = Field(None, description="Time at which it was deleted.")
    deleted_by: str | None = Field(None, description="Whose key it was; `local` where none is asked for.")
    why: str | None = Field(None, description="Reason: `asked for`.")
    size_bytes: int | None = Field(None, description="Room that emptying frees.")


class CertificateSources(Document):
    """The inputs of a certificate."""

    test_id: str | None = None
    analysis_id: str | None = None
    calibration_sha256: str | None = None
    steps: dict[str, dict[str, str | None]] = Field(default_factory=dict)


class CertificateRecord(Document):
    """``certificate.json``; its tables are further entries."""

    id: str
    title: str = ""
    outcome: Literal["pass", "conditional", "fail"]
    created_utc: str
    valid_until_utc: str | None = None
    software_version: str = ""
    simulated: bool = False
    reasons: list[dict[str, str]] = Field(default_factory=list)
    suspects: list[dict[str, str]] = Field(default_factory=list)
    made_of: CertificateSources
    policy: str = ""
