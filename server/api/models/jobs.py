"""Jobs, as they travel."""

from __future__ import annotations

from pydantic import Field

from stereorig.server.base.models import Listing, Reply
from stereorig.server.base.problem import JobProblem
from stereorig.server.documents.jobs import JobRecord, Progress

__all__ = ["Accepted", "JobList", "JobProblem", "JobReply", "Progress"]


class JobReply(JobRecord):
    """Anything that takes longer than a request."""


class JobList(Listing):
    """Jobs, newest first."""

    jobs: list[JobReply] = Field(description="Jobs, newest first.")


class JobStep(Reply):
    """A step that a job has taken or measured; further entries depend on the kind of job."""

    n: int = Field(description="Number of the step.")


class JobStepList(Listing):
    """Steps of a job, in order."""

    steps: list[JobStep] = Field(description="Entry of each, as in the job's result.")


class Accepted(Reply):
    """A job was accepted."""

    job: JobReply = Field(description="The job; poll or follow it.")
