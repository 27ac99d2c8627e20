"""Records of jobs, and of the requests that things were made for."""

from __future__ import annotations

from pydantic import Field

from stereorig.server.base.models import Document, JobState
from stereorig.server.base.problem import JobProblem

#: of an analysis' job that has ended; they were megabytes, to be read with every list of jobs
KEPT_STEPS = 5


class Progress(Document):
    """Progress of a job."""

    phase: str = Field(description="Phase that it is in.", examples=["views"])
    done: int = Field(description="Units done in this phase.")
    total: int = Field(description="Units in this phase; 0 while unknown.")
    eta_s: float | None = Field(None, description="Seconds left in this phase; null while unknown.")


class JobRecord(Document):
    """Anything that takes longer than a request."""

    id: str = Field(description="Id of the job.", examples=["j000007-a31f0c"])
    kind: str = Field(
        description="`calibration`, `noise`, `analysis`, `repetition`, `certificate`, `export`, `burst`, `record`, "
        "`move`, `home`, `leave_configuration` or `reconnect`."
    )
    state: JobState = Field(description="State of the job.")
    subject: dict[str, object] = Field(description="Ids of the test, analysis or calibration that it works on.")
    progress: Progress = Field(description="Progress.")
    created_utc: str = Field(description="Time at which it was accepted.")
    started_utc: str | None = Field(None, description="Time at which it began.")
    finished_utc: str | None = Field(None, description="Time at which it ended.")
    result: dict[str, object] | None = Field(None, description="Result, when it succeeded.")
    problem: JobProblem | None = Field(None, description="Problem that left no result.")

    def bounded(self, most: int, only: str | None = None) -> JobRecord:
        """Return the record with so many entries of each list in its result at most; ``n_<list>`` counts them all."""
        cut: dict[str, object] = {}
        for name, value in (self.result or {}).items():
            if only not in (None, name):
                continue
            if isinstance(value, list) and len(value) > most:
                cut |= {name: value[:most], f"n_{name}": len(value)}
            elif isinstance(value, dict) and len(value) > most:
                cut |= {name: dict(list(value.items())[:most]), f"n_{name}": len(value)}
        return self if not cut else self.model_copy(update={"result": {**(self.result or {}), **cut}})

    def kept(self) -> JobRecord:
        """Return the record to store: without most figures of an analysis' steps, which their results' folder has."""
        return self.bounded(KEPT_STEPS, only="steps") if self.kind == "analysis" else self

    def ended(self, state: JobState, finished_utc: str, problem: JobProblem | None) -> JobRecord:
        """Return the record of the job's end."""
        progress = self.progress.model_copy(update={"eta_s": None})
        change = {"state": state, "finished_utc": finished_utc, "problem": problem, "progress": progress}
        return self.model_copy(update=change)


class KeptRequest(Document):
    """The request with an Idempotency-Key that a thing was made for."""

    scope: str
    key: str
    body_sha256: str


class Kept(Document):
    """Anything that a request makes."""

    def shown(self) -> dict[str, object]:
        """Return the entries that the API shows."""
        return self.model_dump(exclude_unset=True, exclude={"request"})
