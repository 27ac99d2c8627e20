"""Documents that the data folder keeps, as they are read: lenient, so that older and hand-copied folders stay readable.

Entries that a document lacks are missing; those that a later version added are kept. Replies of the API derive from
these.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from pydantic import AliasChoices, Field

from server.base.models import Document, JobState
from server.base.problem import JobProblem
from server.formats.records import Record

#: entry of ``test.json``; the second is its earlier name
METADATA_NAMES = ("metadata", "facts")

#: of an analysis' job that has ended; they were megabytes, to be read with every list of jobs
KEPT_STEPS = 5


class Progress(Document):
    """Progress of a job."""

    phase: str = Field(
        description="Phase that it is in.",
        examples=["views"],
        validation_alias=AliasChoices("phase", "stage"),  # the second is its earlier name
    )
    done: int = Field(description="Units done in this phase.")
    total: int = Field(description="Units in this phase; 0 while unknown.")
    eta_s: float | None = Field(None, description="Seconds left in this phase; null while unknown.")


class JobRecord(Document):
    """Anything that takes longer than a request."""

    id: str = Field(description="Id of the job.", examples=["j000007-a31f0c"])
    kind: str = Field(
        description="`calibration`, `noise`, `analysis`, `repetition`, `certificate`, `export`, `burst`, `move`, "
        "`home`, `leave_configuration` or `reconnect`."
    )
    state: JobState = Field(description="State of the job.")
    subject: dict[str, object] = Field(description="Ids of what it works on.")
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
        """Return the record as it is kept: some figures of an analysis' steps, which lie beside their results."""
        return self.bounded(KEPT_STEPS, only="steps") if self.kind == "analysis" else self

    def ended(self, state: JobState, finished_utc: str, problem: JobProblem | None) -> JobRecord:
        """Return the record of the job's end."""
        progress = self.progress.model_copy(update={"eta_s": None})
        change = {"state": state, "finished_utc": finished_utc, "problem": problem, "progress": progress}
        return self.model_copy(update=change)


class StepOutcome(Document):
    """Summary of one step of an analysis; see :class:`server.formats.results.summary.StepSummary`."""

    n: int
    wall_s: float | None = None


class Finished(Document):
    """Steps of an analysis that a job has measured so far."""

    steps: list[StepOutcome] = Field(default_factory=list)
    steps_failed: dict[str, JobProblem] = Field(default_factory=dict)


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


class BurstIndex(Document):
    """Index of a step in its burst."""

    job_id: str
    index: int
    count: int
    interval_ms: float
    since_first_ms: float


class Watched(Document):
    """The watched channel of a reading that took a step."""

    channel: str
    value: float | None = None
    last_value: float | None = None
    threshold: float | None = None


class StepMetadata(Kept):
    """A step's metadata: the client's entries, and the reason for taking it."""

    label: str | None = None
    load_n: float | None = None
    timestamp_utc: str | None = None
    channels: dict[str, float] = Field(default_factory=dict)
    request: KeptRequest | None = None
    burst: BurstIndex | None = None
    watch: Watched | None = None


class PairQuality(Document):
    """Quality of a pair of images."""

    code: str | None = None


class StepRecord(StepMetadata):
    """``step.json``."""

    n: int
    test_id: str | None = None
    source: str | None = None
    captured_utc: str | None = None
    host_monotonic_ns: int | None = None
    skew_ms: float | None = None
    cameras: dict[str, object] | None = None
    frames: int | None = None
    grey_scale: int | float | None = None
    bit_depth: dict[str, int] | None = None
    quality: PairQuality | None = None
    image_size_px: dict[str, list[int]] = Field(default_factory=dict)
    sha256: dict[str, str] = Field(default_factory=dict)

    @property
    def quality_code(self) -> str | None:
        """``ok``, or the first thing that is wrong with the pair."""
        return None if self.quality is None else self.quality.code


class TestRecord(Kept):
    """``test.json``."""

    __test__ = False

    id: str
    created_utc: str | None = None
    name: str | None = None
    specimen: str | None = None
    notes: str | None = None
    calibration_id: str | None = None
    calibration_sha256: str | None = None
    calibrations: dict[str, str | None] = Field(default_factory=dict)
    metadata: object = Field(None, validation_alias=AliasChoices(*METADATA_NAMES))
    request: KeptRequest | None = None


class AnalysisInputs(Document):
    """Checksums of everything that an analysis reads, fixed when it is made."""

    calibration_sha256: str | None = None
    steps: dict[str, dict[str, str]] = Field(default_factory=dict)


class AnalysisRecord(Kept):
    """``analysis.json``."""

    id: str
    test_id: str
    calibration_id: str | None = None
    created_utc: str | None = None
    kind: str | None = None
    label: str | None = None
    settings: dict[str, object] = Field(default_factory=dict)
    steps: list[int] = Field(default_factory=list)
    follow: bool = False
    software: str | None = None
    inputs: AnalysisInputs = AnalysisInputs()
    request: KeptRequest | None = None


class AnalysisJob(Document):
    """A job that worked on an analysis, and the request that asked for it."""

    job_id: str
    request: KeptRequest | None = None
    created_utc: str | None = None


class SummaryRecord(Document):
    """``summary.json`` of an analysis; see :class:`server.formats.results.summary.SequenceSummary`."""

    state: JobState = "interrupted"
    steps: list[StepOutcome] = Field(default_factory=list)
    steps_failed: dict[str, JobProblem] = Field(default_factory=dict)
    job_id: str | None = None
    problem: JobProblem | None = None


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
    """Return the state of what ended with this ``failure.json``: who cancelled it knows that nothing went wrong."""
    return "cancelled" if failure.get("job_state") == "cancelled" else "failed"


class MadeRecord(Document):
    """A calibration or noise measurement as its folder has it: results are beside these fields."""

    id: str
    state: MadeState
    plan: Plan
    problem: Failure | None = None


class Decided(Document):
    """``review.json``: an operator's decision on a calibration."""

    decision: str | None = None
    note: str | None = None


class ViewRecord(Document):
    """A view in ``view.json``."""

    index: int | None = None
    camera: str | None = None
    full_scale: int | float | None = None
    file: str | None = None
    sha256: str | None = None


class CalibrationRecord(MadeRecord):
    """A calibration."""

    taken: list[ViewRecord] | None = None
    review: Decided | None = None
    verdict: object = None


class WatchRecord(Document):
    """``watch.json``, with the value that the next reading is compared with."""

    channel: str
    threshold: float
    frames: int = 1
    label: str | None = None
    active: bool = False
    last_value: float | None = None
    last_step: int | None = None


class RecipeRecord(Document):
    """A recipe's file; its content is checked where it is used."""

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
    why: str | None = Field(None, description="`asked for`; `retention` where an earlier version moved it by itself.")
    size_bytes: int | None = Field(None, description="Room that emptying frees.")


class CertificateSources(Document):
    """What a certificate rests on."""

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
