"""Jobs, as they travel."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from server.base.models import JobState, Listing, Reply


class Progress(Reply):
    """How far a job is."""

    stage: str = Field(description="What it is doing.", examples=["views"])
    done: int = Field(description="Units done in this stage.")
    total: int = Field(description="Units in this stage; 0 while unknown.")
    eta_s: float | None = Field(None, description="Seconds left in this stage; null while unknown.")


class JobProblem(Reply):
    """Why a job has no result."""

    code: str = Field(description="Stable code.")
    cause: str = Field(description="The cause, with the values that disagree.")
    remedy: str = Field(description="What can be done.")


class JobReply(Reply):
    """Anything that takes longer than a request."""

    id: str = Field(description="Id of the job.", examples=["j000007-a31f0c"])
    kind: str = Field(
        description="`calibration`, `noise`, `analysis`, `burst`, `move`, `home`, `leave_configuration` or `reconnect`."
    )
    state: JobState = Field(description="Where it is in its life.")
    subject: dict[str, Any] = Field(description="Ids of what it works on.")
    progress: Progress = Field(description="How far it is.")
    created_utc: str = Field(description="When it was accepted.")
    started_utc: str | None = Field(None, description="When it began.")
    finished_utc: str | None = Field(None, description="When it ended.")
    result: dict[str, Any] | None = Field(None, description="What it found, when it succeeded.")
    problem: JobProblem | None = Field(None, description="Why it has no result.")


class JobList(Listing):
    """Jobs, newest first."""

    jobs: list[JobReply] = Field(description="Jobs, newest first.")


class Accepted(Reply):
    """A job was accepted."""

    job: JobReply = Field(description="The job; poll or follow it.")
