"""Documents that the data folder keeps, as they are read: lenient, so that older and hand-copied folders stay readable.

What a document lacks is missing; what a later version added is kept. Replies of the API derive from these.
"""

from __future__ import annotations

from pydantic import Field

from server.base.models import Document, JobState
from server.base.problem import JobProblem


class Progress(Document):
    """How far a job is."""

    stage: str = Field(description="What it is doing.", examples=["views"])
    done: int = Field(description="Units done in this stage.")
    total: int = Field(description="Units in this stage; 0 while unknown.")
    eta_s: float | None = Field(None, description="Seconds left in this stage; null while unknown.")


class JobRecord(Document):
    """Anything that takes longer than a request."""

    id: str = Field(description="Id of the job.", examples=["j000007-a31f0c"])
    kind: str = Field(
        description="`calibration`, `noise`, `analysis`, `burst`, `move`, `home`, `leave_configuration` or `reconnect`."
    )
    state: JobState = Field(description="Where it is in its life.")
    subject: dict[str, object] = Field(description="Ids of what it works on.")
    progress: Progress = Field(description="How far it is.")
    created_utc: str = Field(description="When it was accepted.")
    started_utc: str | None = Field(None, description="When it began.")
    finished_utc: str | None = Field(None, description="When it ended.")
    result: dict[str, object] | None = Field(None, description="What it found, when it succeeded.")
    problem: JobProblem | None = Field(None, description="Why it has no result.")

    def ended(self, state: JobState, finished_utc: str, problem: JobProblem | None) -> JobRecord:
        """Return the record of the job's end."""
        progress = self.progress.model_copy(update={"eta_s": None})
        change = {"state": state, "finished_utc": finished_utc, "problem": problem, "progress": progress}
        return self.model_copy(update=change)


class StepFound(Document):
    """What was found in one step of an analysis; see :class:`server.formats.results.summary.StepSummary`."""

    n: int
    wall_s: float | None = None


class Finished(Document):
    """What a job has measured so far of an analysis."""

    steps: list[StepFound] = Field(default_factory=list)
    steps_failed: dict[str, JobProblem] = Field(default_factory=dict)
