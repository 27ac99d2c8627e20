"""Tests and their analyses: the test's document, an analysis' settings, jobs and summary."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from stereorig.server.base.models import Document, JobState
from stereorig.server.base.problem import JobProblem
from stereorig.server.documents.jobs import Kept, KeptRequest
from stereorig.server.formats.records import Record


class TestRecord(Record, Kept):
    """``test.json``."""

    id: str
    created_utc: str | None = None
    name: str | None = None
    specimen: str | None = None
    notes: str | None = None
    calibration_id: str | None = None
    calibration_sha256: str | None = None
    calibrations: dict[str, str | None] = Field(default_factory=dict)
    metadata: dict[str, object] = Field(default={})
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


class MotionConsequence(Document):
    """Errors of the points if the change of orientation were not known."""

    shape_um: float = Field(description="Rms error of shape, rigid motion taken out.")
    shape_sigma_um: float = Field(description="Its standard uncertainty.")
    z_um: float = Field(description="Rms error of Z.")
    z_sigma_um: float = Field(description="Its standard uncertainty.")
    displacement_um: float = Field(description="Rms displacement of a specimen at rest, before to after.")
    displacement_sigma_um: float = Field(description="Its standard uncertainty.")
    strain_microstrain: float = Field(description="Largest strain of that false displacement.")
    strain_sigma_microstrain: float = Field(description="Its standard uncertainty.")


class OffsetFinding(Document):
    """A step's epipolar offsets against the calibration's, the reference's or the last step's."""

    against: Literal["calibration", "reference", "last_step"] = Field(description="What they are compared with.")
    camera_moved: bool | None = Field(description="null: the calibration's own error is not known.")
    points: int = Field(description="Number of points.")
    offset_mean_px: float = Field(description="Mean of the smooth offset, or of its change.")
    offset_rms_px: float = Field(description="Its root mean square.")
    expected_px: float = Field(
        description="Offset that noise, systematic errors and the calibration's uncertainty explain."
    )
    pattern_px: dict[str, float] = Field(description="Rms of its `mean`, `slope` and `curvature` over the image.")
    carried_by: Literal["mean", "slope", "curvature"] = Field(description="The largest of these.")
    chi_square: float = Field(description="Chi-square of the six terms against the expected ones.")
    p_value: float = Field(description="Chance of so large an offset without a motion.")
    sigmas: float = Field(description="The same in standard deviations.")
    change_deg: list[float] = Field(
        description="Turn of camera 2 about its x, y, z, and of the baseline's direction forward and sideways, degrees."
    )
    change_sigma_deg: list[float] = Field(description="Standard uncertainties.")
    determined: float = Field(description="How many of these five the offsets determine.")
    consequence: MotionConsequence | None = Field(description="Consequence of that change.")
    text: str = Field(description="The finding in a sentence.")


class CameraMotion(Document):
    """Motion of a camera since the calibration, the reference or the step before."""

    camera_moved: bool | None = Field(description="True, false, or null if it cannot be decided.")
    text: str = Field(description="The finding in a sentence.")
    calibration: OffsetFinding | None = Field(description="Against the calibration.")
    reference: OffsetFinding | None = Field(description="Against the reference; null for the reference itself.")
    last_step: OffsetFinding | None = Field(description="Against the step before; null if that is the reference.")


class StepOutcome(Record, Document):
    """Summary of one step of an analysis; see :class:`stereorig.server.formats.results.summary.StepSummary`."""

    n: int
    wall_s: float | None = None
    camera_motion: CameraMotion | None = None


class Finished(Document):
    """Steps of an analysis that a job has measured so far."""

    steps: list[StepOutcome] = Field(default_factory=list)
    steps_failed: dict[str, JobProblem] = Field(default_factory=dict)


class SummaryRecord(Finished):
    """``summary.json`` of an analysis; see :class:`stereorig.server.formats.results.summary.SequenceSummary`."""

    state: JobState = "interrupted"
    calibration: dict[str, object] = Field(default={})
    job_id: str | None = None
    problem: JobProblem | None = None
