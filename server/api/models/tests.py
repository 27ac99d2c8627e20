"""Tests and steps, as they travel."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from stereorig.core.names import CameraName
from stereorig.core.settings import Real, Whole
from stereorig.drivers.acquisition.simultaneity import SKEW_SOURCES, SkewSource
from stereorig.server.api.models.jobs import Accepted
from stereorig.server.api.models.warnings import AnalysisWarning
from stereorig.server.base.models import (
    ON_ONE_LINE,
    Channels,
    JobState,
    Label,
    Listing,
    Notes,
    Number,
    Reply,
    Request,
    Timestamp,
)
from stereorig.server.documents.made import TrashEntry
from stereorig.server.documents.steps import BurstIndex, StepQuality
from stereorig.server.workflows.recording import RecordPlan

TestName = Annotated[str, StringConstraints(min_length=1, max_length=300), ON_ONE_LINE]


class TestRequest(Request):
    """A new test."""

    name: TestName = Field(description="Name, in any script; on one line, without control characters.")
    calibration_id: str | None = Field(
        None,
        description="Calibration to measure with, copied into the test; `latest`: the newest one accepted.",
        max_length=40,
    )
    specimen: Label = Field("", description="The specimen, free text.")
    notes: Notes = Field("", description="Free text.")


class TestPatch(Request):
    """Fields of a test to change."""

    name: Annotated[str, StringConstraints(min_length=1, max_length=300), ON_ONE_LINE] | None = Field(
        None, description="Name."
    )
    specimen: Label | None = Field(None, description="The specimen.")
    notes: Notes | None = Field(None, description="Free text.")
    calibration_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None,
        description="Calibration that new analyses are measured with; `latest`: the newest one accepted. Analyses that "
        "there are keep theirs.",
    )


class TestEntry(Reply):
    """Entry of a test in a list."""

    id: str = Field(description="Id.", examples=["t000001-0c9f1e"])
    name: str = Field(description="Name.")
    specimen: str | None = Field(None, description="The specimen.")
    calibration_id: str | None = Field(None, description="Calibration it measures with.")
    created_utc: str | None = Field(None, description="Time at which it was made.")


class StepEntry(Reply):
    """Entry of a step in a list."""

    n: int = Field(description="Number; 0 is the reference.")
    label: str | None = Field(None, description="Free text.")
    load_n: float | None = Field(None, description="Load in newton.")
    timestamp_utc: str | None = Field(None, description="The client's own time, if it gave one.")
    source: str | None = Field(None, description="`capture` or `import`.")
    captured_utc: str | None = Field(None, description="Time of the capture or import, by the service's clock.")
    skew_ms: float | None = Field(None, description="Difference of the two exposures' beginnings.")
    quality: str | None = Field(None, description="`ok`, or the first thing that is wrong.")
    channels: dict[str, float] | None = Field(
        None, description="Scalar readings, by name, where a list was asked for with them; else null."
    )


class AnalysisEntry(Reply):
    """Entry of an analysis in a list."""

    id: str = Field(description="Id.", examples=["a000001-77d0b3"])
    kind: str | None = Field(None, description="`profile` or `displacement`.")
    label: str | None = Field(None, description="Free text.")
    calibration_id: str | None = Field(None, description="Calibration that it is measured with; null: not known.")
    created_utc: str | None = Field(None, description="Time at which it was begun.")
    job_id: str | None = Field(None, description="Its job.")
    state: JobState | None = Field(None, description="State of its last job.")
    steps_failed: list[int] = Field(default_factory=list, description="Steps that could not be measured.")
    warnings: list[AnalysisWarning] = Field(
        default_factory=list, description="Warnings about its results, failed checks first."
    )


class TestReply(Reply):
    """A test."""

    id: str = Field(description="Id.", examples=["t000001-0c9f1e"])
    name: str = Field(description="Name.")
    specimen: str = Field(description="The specimen.")
    notes: str = Field(description="Free text.")
    calibration_id: str | None = Field(None, description="Calibration that new analyses are measured with.")
    calibrations: dict[str, str | None] = Field(
        default_factory=dict,
        description="Where another one was chosen since: ids of the calibrations that it, or an analysis, was given, "
        "by their checksum.",
    )
    created_utc: str = Field(description="Time at which it was made.")
    n_steps: int = Field(0, description="Number of its complete steps.")
    steps: list[StepEntry] = Field(
        default_factory=list,
        description="Its complete steps, in order; the first 100 if there are more, see `steps_next_cursor`.",
    )
    steps_next_cursor: str | None = Field(
        None, description="Of GET /tests/{id}/steps for the steps after these; null: these are all."
    )
    newest_step: StepEntry | None = Field(None, description="The complete step with the largest number.")
    incomplete_steps: list[int] = Field(default_factory=list, description="Step folders without their commit mark.")
    analyses: list[AnalysisEntry] = Field(default_factory=list, description="Its analyses.")


class TestList(Listing):
    """Tests, oldest first."""

    tests: list[TestEntry] = Field(description="Short entry of each.")


class StepList(Listing):
    """Complete steps, in order."""

    steps: list[StepEntry] = Field(description="Short entry of each.")


class StepPatch(Request):
    """Fields of a step to change; images, times and figures stay as they were taken."""

    label: Label = Field(description="Free text.")


class StepRequest(Request):
    """Capture one step, or a burst of them."""

    label: Label = Field("", description="Free text.")
    load_n: Number | None = Field(None, description="Load in newton.")
    timestamp_utc: Timestamp | None = Field(
        None,
        description="The client's own time of this load step, with its time zone; stored with the service's "
        "`captured_utc`, and never used for order.",
    )
    channels: Channels = Field(
        default_factory=dict,
        description="Any further scalar readings, by name.",
        examples=[{"force_n": 1250.5, "stroke_mm": 0.42, "temperature_c": 21.3}],
    )
    frames: Annotated[Whole, Field(ge=1, le=256)] = Field(
        1, description="Frames averaged; 1 stores the frame as it came."
    )
    count: Annotated[Whole, Field(ge=1, le=10000)] = Field(
        1, description="Steps to take. More than one make a burst: the answer is 202 and a job."
    )
    interval_ms: Annotated[Real, Field(allow_inf_nan=False, ge=0.0, le=86_400_000.0)] = Field(
        0.0, description="From the beginning of one step of a burst to the next; 0: as fast as possible."
    )


class StepReply(Reply):
    """A step: durable on disk when this is sent."""

    warnings: list[str] = Field(
        default_factory=list, description="Faults to put right before this step is measured; mostly empty."
    )
    n: int = Field(description="Number; 0 is the reference.")
    test_id: str = Field(description="Its test.")
    label: str = Field(description="Free text.")
    load_n: float | None = Field(None, description="Load in newton.")
    timestamp_utc: str | None = Field(None, description="The client's own time, if it gave one.")
    channels: dict[str, float] = Field(
        default_factory=dict,
        description="Scalar readings, as sent, and the rig file's channels at the exposure, between the "
        "readings around it.",
    )
    channel_units: dict[str, str] = Field(
        default_factory=dict,
        description="Unit of each channel that a load frame's record gave, as the file states it, or that the rig file "
        "names.",
    )
    channel_u: dict[str, float] = Field(
        default_factory=dict,
        description="Standard uncertainty of each channel of the rig file at the exposure: noise, change between the "
        "readings around it, resolution, latency of the line.",
    )
    source: Literal["capture", "import"] = Field(description="Source of the images.")
    captured_utc: str = Field(description="Time of the capture or import, by the service's clock.")
    skew_ms: float | None = Field(None, description="Difference of the two exposures' beginnings.")
    dz_mm: dict[CameraName, float | None] | None = Field(
        None,
        description="Travel of each camera's axis as the pair was taken; null where the stage did not answer, and its "
        "position is unknown. Null as a whole without a stage.",
        examples=[{"cam1": 0.0, "cam2": 0.0}],
    )
    simulated: list[Literal["cam1", "cam2", "stage"]] | None = Field(
        None, description="Devices that were simulated; null for files that were imported."
    )
    skew_uncertainty_ms: float | None = Field(None, description="Largest error of the skew.")
    skew_source: SkewSource | None = Field(None, description=SKEW_SOURCES)
    quality: StepQuality = Field(description="`code` (`ok` or the fault), and figures of each camera.")
    sha256: dict[str, str] = Field(description="Checksums of both image files.")
    grey_from: dict[str, str] | None = Field(
        None,
        description="By camera, the origin of a colour image's grey levels.",
        examples=[{"cam1": "luminance, 0.299 R + 0.587 G + 0.114 B"}],
    )
    burst: BurstIndex | None = Field(None, description="Its index in its burst, if it is of one.")


class BurstAccepted(Accepted):
    """A burst was begun; its job's `result` lists each step that is durable, and each that failed."""


class RecordRequest(RecordPlan):
    """Record both cameras, and keep steps by a trigger."""

    label: Label = Field("", description="Label of the steps.")


class RecordAccepted(Accepted):
    """A recording was begun; its job's `result` lists each step that is durable, and accounts for every pair."""


class WatchRequest(Request):
    """Channel to watch, and the change that takes a step."""

    channel: Annotated[str, StringConstraints(min_length=1, max_length=100), ON_ONE_LINE] = Field(
        description="Name of a channel of the readings; `load_n` for the load.", examples=["load_n"]
    )
    threshold: Annotated[Number, Field(ge=0.0)] = Field(
        description="A step is taken when the channel differs by this or more from the newest step that has it; 0: "
        "at any difference.",
        examples=[500.0],
    )
    frames: Annotated[Whole, Field(ge=1, le=256)] = Field(1, description="Frames averaged in each step.")
    label: Label = Field("", description="Label of steps whose reading brings none.")


class ReadingRequest(Request):
    """A reading of a script's channels."""

    label: Label = Field("", description="Label of the step, if one is taken.")
    load_n: Number | None = Field(None, description="Load in newton.")
    timestamp_utc: Timestamp | None = Field(None, description="The client's own time of the reading.")
    channels: Channels = Field(
        default_factory=dict,
        description="Scalar readings, by name.",
        examples=[{"force_n": 1250.5, "stroke_mm": 0.42, "temperature_c": 21.3}],
    )


class ReadingReply(Reply):
    """Outcome of a reading."""

    taken: bool = Field(description="True if it took a step.")
    reason: Literal["first", "changed", "below_threshold", "channel_absent"] = Field(
        description="Reason why a step was or was not taken."
    )
    value: float | None = Field(None, description="Value of the watched channel; null if it was absent.")
    last_value: float | None = Field(None, description="Value that it was compared with; null: there was none.")
    step: StepReply | None = Field(None, description="The step, durable on disk.")


# The trash, and the acknowledgement of copies, as they travel.


class TrashList(Listing):
    """The trash, oldest first."""

    trash: list[TrashEntry] = Field(description="Entries of the trash.")


class ExportedRequest(Request):
    """Contents of a test's copy elsewhere."""

    steps: Annotated[Whole, Field(ge=0, le=10000)] = Field(
        description="Number of complete steps in the copy.", examples=[120]
    )
    results: Annotated[Whole, Field(ge=0, le=10_000_000)] = Field(
        description="Number of result files (step_*.nc) in the copy, over all analyses.", examples=[240]
    )


class ExportedReply(Reply):
    """That the test was copied elsewhere."""

    utc: str = Field(description="Time of the acknowledgement.")
    by: str = Field(description="Whose key it was.")
    steps: int = Field(description="Number of complete steps.")
    results: int = Field(description="Number of result files.")
    sha256: str = Field(description="Checksum of the checksums of all of them.")
