"""Wire models: what goes over HTTP, apart from what the code works with inside."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, model_validator

from core.field.patch import DEFAULT_PATCH, PatchSetting
from core.strain.options import DEFAULT_WINDOW, WIDEST_WINDOW, StrainTensor


def _not_a_truth_value(value: Any) -> Any:
    # true would be taken for 1: an axis would move by a millimetre
    if isinstance(value, bool):
        raise ValueError("must be a number, not true or false")
    return value


Real = Annotated[float, BeforeValidator(_not_a_truth_value)]
Whole = Annotated[int, BeforeValidator(_not_a_truth_value)]
Number = Annotated[Real, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]
Label = Annotated[str, StringConstraints(max_length=300)]
CameraName = Literal["cam1", "cam2"]
Pixel = Annotated[Real, Field(allow_inf_nan=False, ge=0.0, le=32767.0)]
JobState = Literal["queued", "running", "cancelling", "succeeded", "failed", "cancelled", "interrupted"]


class Request(BaseModel):
    """A body: closed, finite numbers only."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Reply(BaseModel):
    """An answer; may gain fields in later versions."""

    model_config = ConfigDict(extra="allow")


# jobs -----------------------------------------------------------------------------------------------------------


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
    kind: str = Field(description="`calibration`, `noise`, `analysis`, `move`, `home` or `reconnect`.")
    state: JobState = Field(description="Where it is in its life.")
    subject: dict[str, Any] = Field(description="Ids of what it works on.")
    progress: Progress = Field(description="How far it is.")
    created_utc: str = Field(description="When it was accepted.")
    started_utc: str | None = Field(None, description="When it began.")
    finished_utc: str | None = Field(None, description="When it ended.")
    result: dict[str, Any] | None = Field(None, description="What it found, when it succeeded.")
    problem: JobProblem | None = Field(None, description="Why it has no result.")


class JobList(Reply):
    """Jobs, newest first."""

    jobs: list[JobReply] = Field(description="Jobs, newest first.")


class Accepted(Reply):
    """A job was accepted."""

    job: JobReply = Field(description="The job; poll or follow it.")


# rig ------------------------------------------------------------------------------------------------------------


class SettingsPatch(Request):
    """Camera settings to change; what is left out stays."""

    exposure_ms: Annotated[Real, Field(gt=0.0, le=60000.0)] | None = Field(None, description="Exposure time.")
    gain_db: Annotated[Real, Field(ge=-100.0, le=100.0)] | None = Field(None, description="Gain.")
    frame_rate_hz: Annotated[Real, Field(gt=0.0, le=10000.0)] | None = Field(None, description="Free-run rate.")
    bit_depth: Annotated[Whole, Field(ge=8, le=16)] | None = Field(None, description="Significant bits per pixel.")


class MoveRequest(Request):
    """Where to move: axes by number, or cameras by their travel dZ."""

    positions_mm: dict[Annotated[Whole, Field(ge=1, le=6)], Number] | None = Field(
        None, description="Absolute position of each axis.", examples=[{"1": 5.0, "2": 5.0}], min_length=1, max_length=6
    )
    by_mm: dict[Annotated[Whole, Field(ge=1, le=6)], Number] | None = Field(
        None, description="Travel of each axis from where it stands.", min_length=1, max_length=6
    )
    dz_mm: dict[CameraName, Number] | None = Field(
        None, description="Travel of each camera from its zero, positive away from the target.", min_length=1
    )

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if sum(v is not None for v in (self.positions_mm, self.by_mm, self.dz_mm)) != 1:
            raise ValueError("give exactly one of positions_mm, by_mm and dz_mm")
        return self


class HomeRequest(Request):
    """Which axes to home."""

    axes: list[Annotated[Whole, Field(ge=1, le=6)]] | None = Field(
        None, description="Axis numbers; all that the cameras use if left out.", min_length=1, max_length=6
    )


class StopReply(Reply):
    """The stage was told to stop."""

    stopped: bool = Field(description="True once the stop command is on the wire.")
    elapsed_ms: float = Field(description="From the request's arrival to the command on the wire.")
    cancelled_job: str | None = Field(None, description="The hardware job that was cancelled with it.")


class SceneRequest(Request):
    """What stands before a simulated rig's cameras."""

    scene: Literal["grid", "steel", "plate", "panel", "block", "strip", "sphere"] = Field(
        description="Name of the scene."
    )
    load: Number = Field(
        0.0, description="kPa for `plate`, kN for `panel`, per cent for `strip`, share of the motion for `block`."
    )
    params: dict[str, Number | list[Number]] = Field(
        default_factory=dict, description="Further parameters of the scene.", max_length=20
    )


# noise ----------------------------------------------------------------------------------------------------------


class NoiseRequest(Request):
    """How to measure the cameras' noise."""

    frames: Annotated[Whole, Field(ge=2, le=200)] = Field(
        16, description="Pairs of frames; the scene must stand still."
    )
    label: Label = Field("", description="Free text.")


class NoiseAccepted(Accepted):
    """A noise measurement was begun."""

    noise_id: str = Field(description="Id of the noise measurement.", examples=["n000001-5b1c22"])


class NoiseModelReply(Reply):
    """One camera's model: variance = c0 + c1 g + c2 g^2 at grey level g."""

    coefficients: list[float] = Field(description="c0, c1, c2, in grey levels squared, grey levels, 1.")
    coefficients_sd: list[float] = Field(description="Their standard deviations.")
    range_grey: list[float | None] = Field(description="Grey levels between which it holds; null: no end.")
    frames: int = Field(description="Frames it was measured from.")
    misfit: float = Field(description="Scatter of the bins about it, in their own sd; 1 is chance.")
    drift: float = Field(description="Largest relative change of brightness between frames; taken out.")
    shift_px: float = Field(description="Largest motion of the image between frames; taken out.")


class NoiseReply(Reply):
    """A noise measurement."""

    id: str = Field(description="Id.")
    state: Literal["unfinished", "failed", "complete"] = Field(description="Where it is in its life.")
    plan: dict[str, Any] = Field(description="What was asked for.")
    problem: dict[str, Any] | None = Field(None, description="Why it has no models.")
    cam1: NoiseModelReply | None = Field(None, description="Camera 1's model.")
    cam2: NoiseModelReply | None = Field(None, description="Camera 2's model.")


class NoiseList(Reply):
    """Noise measurements, oldest first."""

    noise: list[NoiseReply] = Field(description="Noise measurements, oldest first.")


# calibrations ---------------------------------------------------------------------------------------------------


class CalibrationRequest(Request):
    """Plan of a calibration; what is left out comes from the rig file."""

    positions_mm: list[Number] | None = Field(
        None, description="dZ of the positions that are fitted.", min_length=1, max_length=100
    )
    held_out_mm: list[Number] | None = Field(
        None, description="dZ of the positions kept for the check.", max_length=100
    )
    frames: Annotated[Whole, Field(ge=1, le=256)] | None = Field(None, description="Frames averaged at each position.")
    localiser: Literal["profile", "paper"] | None = Field(None, description="Grid line localiser.")
    label: Label = Field("", description="Free text.")


class CalibrationAccepted(Accepted):
    """A calibration was begun."""

    calibration_id: str = Field(description="Id of the calibration to be.", examples=["c000001-5b02aa"])


class CalibrationReply(Reply):
    """A calibration: its plan, and once complete everything in calibration.json."""

    id: str = Field(description="Id.")
    state: Literal["unfinished", "failed", "complete"] = Field(description="Only `complete` ones can be measured with.")
    plan: dict[str, Any] = Field(description="Positions, frames and localiser asked for.")
    taken: list[dict[str, Any]] | None = Field(None, description="Views taken: camera, role, read-back dZ, checksum.")
    problem: JobProblem | None = Field(None, description="Why there is no calibration.")


class CalibrationList(Reply):
    """Calibrations, oldest first."""

    calibrations: list[dict[str, Any]] = Field(description="Id, state, label, time and verdict of each.")


# tests and steps ------------------------------------------------------------------------------------------------


class TestRequest(Request):
    """A new test."""

    __test__ = False

    name: Annotated[str, StringConstraints(min_length=1, max_length=300)] = Field(description="Name, any characters.")
    calibration_id: str | None = Field(
        None, description="Calibration to measure with; copied into the test.", max_length=40
    )
    specimen: Label = Field("", description="The specimen, for people.")
    notes: Annotated[str, StringConstraints(max_length=20000)] = Field("", description="Free text.")


class TestPatch(Request):
    """Fields of a test to change."""

    __test__ = False

    name: Annotated[str, StringConstraints(min_length=1, max_length=300)] | None = Field(None, description="Name.")
    specimen: Label | None = Field(None, description="The specimen.")
    notes: Annotated[str, StringConstraints(max_length=20000)] | None = Field(None, description="Free text.")


class TestReply(Reply):
    """A test."""

    __test__ = False

    id: str = Field(description="Id.", examples=["t000001-0c9f1e"])
    name: str = Field(description="Name.")
    specimen: str = Field(description="The specimen.")
    notes: str = Field(description="Free text.")
    calibration_id: str | None = Field(None, description="Calibration it measures with.")
    created_utc: str = Field(description="When it was made.")
    steps: list[dict[str, Any]] = Field(default_factory=list, description="Its complete steps.")
    incomplete_steps: list[int] = Field(default_factory=list, description="Step folders without their commit mark.")
    analyses: list[dict[str, Any]] = Field(default_factory=list, description="Its analyses.")


class TestList(Reply):
    """Tests, oldest first."""

    __test__ = False

    tests: list[dict[str, Any]] = Field(description="Id, name, specimen and time of each.")


class StepRequest(Request):
    """Capture one step."""

    label: Label = Field("", description="Free text.")
    load_n: Number | None = Field(None, description="Load in newton.")
    channels: dict[Annotated[str, StringConstraints(min_length=1, max_length=100)], Number] = Field(
        default_factory=dict, description="Any further scalar readings.", max_length=50
    )
    frames: Annotated[Whole, Field(ge=1, le=256)] = Field(
        1, description="Frames averaged; 1 stores the frame as it came."
    )


class StepReply(Reply):
    """A step: durable on disk when this is sent."""

    n: int = Field(description="Number; 0 is the reference.")
    test_id: str = Field(description="Its test.")
    label: str = Field(description="Free text.")
    load_n: float | None = Field(None, description="Load in newton.")
    source: Literal["capture", "import"] = Field(description="Where the images come from.")
    captured_utc: str = Field(description="Time of the capture or import.")
    skew_ms: float | None = Field(None, description="Difference of the two exposures' beginnings.")
    quality: dict[str, Any] = Field(description="`code` (`ok` or what is wrong), and figures of each camera.")
    sha256: dict[str, str] = Field(description="Checksums of both image files.")


# analyses and results -------------------------------------------------------------------------------------------


class Region(Request):
    """Where points may lie: one of rectangle and polygon, a mask if wanted, cracks and holes.

    No subset, neighbour or start value reaches over a crack, a hole's border or the mask's black.
    """

    rectangle: tuple[Pixel, Pixel, Pixel, Pixel] | None = Field(
        None, description="x0, y0, x1, y1 in camera 1's reference image, inclusive.", examples=[[120, 100, 400, 380]]
    )
    polygon: list[tuple[Pixel, Pixel]] | None = Field(None, description="Corners.", min_length=3, max_length=1000)
    mask_png_base64: Annotated[str, StringConstraints(max_length=20_000_000)] | None = Field(
        None, description="Image of camera 1's size, white where points may lie."
    )
    cracks: list[Annotated[list[tuple[Pixel, Pixel]], Field(min_length=2, max_length=1000)]] = Field(
        [],
        description="Lines in camera 1's reference image, each the points that it goes through.",
        max_length=100,
        examples=[[[[150, 240], [260, 238.5], [362, 241]]]],
    )
    holes: list[Annotated[list[tuple[Pixel, Pixel]], Field(min_length=3, max_length=1000)]] = Field(
        [],
        description="Corners of polygons in camera 1's reference image inside which nothing is measured.",
        max_length=100,
        examples=[[[[200, 180], [240, 180], [240, 220], [200, 220]]]],
    )

    @model_validator(mode="after")
    def _some_form(self) -> Self:
        if self.rectangle is not None and self.polygon is not None:
            raise ValueError("give a rectangle or a polygon, not both")
        if self.rectangle is None and self.polygon is None and self.mask_png_base64 is None:
            raise ValueError("give a rectangle, a polygon or a mask")
        return self


class StrainRequest(Request):
    """Strain over a virtual gauge, (window - 1) step_px + subset_px wide."""

    window: Annotated[Whole, Field(ge=3, le=WIDEST_WINDOW)] = Field(
        DEFAULT_WINDOW, description="Points across the gauge, odd."
    )
    order: Literal[1, 2] = Field(
        1, description="Fit planes or quadratics; they differ only where an edge, a hole or a cut takes points away."
    )
    tensor: StrainTensor = Field("green_lagrange", description="Which strain is told.")

    @model_validator(mode="after")
    def _odd(self) -> Self:
        if self.window % 2 == 0:
            raise ValueError(f"window must be odd, got {self.window}")
        return self


class AnalysisRequest(Request):
    """What to compute over a test's steps."""

    kind: Literal["profile", "displacement"] = Field(
        "displacement", description="Shape only, or shape and displacement."
    )
    region: Region = Field(description="Where points may lie.")
    subset_px: Annotated[Whole, Field(ge=5, le=255)] = Field(33, description="Subset size, odd.")
    step_px: Annotated[Whole, Field(ge=1, le=1000)] = Field(10, description="Distance of neighbouring points.")
    patch: PatchSetting = Field(
        DEFAULT_PATCH,
        description="Patch model: stretch and rigid are planes; curved has a second-order shape and motion and about "
        "twice the noise; auto takes stretch or curved, whichever errs less on the field in all, shape and motion "
        "apart; each step's summary has the choice and its reason under patch.",
    )
    interpolation: Literal["cubic", "quintic"] = Field("quintic", description="B-spline order.")
    seeds: Annotated[list[tuple[Pixel, Pixel]], Field(min_length=1, max_length=100)] | None = Field(
        None, description="Start points in camera 1's reference image; found automatically if left out."
    )
    noise_id: Annotated[str, StringConstraints(max_length=40)] | None = Field(
        None, description="Noise measurement whose models weigh the pixels; without it, residuals tell the noise."
    )
    steps: Annotated[list[Annotated[Whole, Field(ge=0, le=9999)]], Field(min_length=1, max_length=10000)] | None = (
        Field(None, description="Steps to measure; all if left out. The reference is always measured.")
    )
    reference: Annotated[Whole, Field(ge=0, le=9999)] = Field(0, description="Reference step.")
    strain: StrainRequest | None = Field(
        default_factory=lambda: StrainRequest.model_validate({}), description="Strain of a displacement; null: none."
    )
    label: Label = Field("", description="Free text.")

    @model_validator(mode="after")
    def _odd(self) -> Self:
        if self.subset_px % 2 == 0:
            raise ValueError(f"subset_px must be odd, got {self.subset_px}")
        return self


class AnalysisAccepted(Accepted):
    """An analysis was begun."""

    analysis_id: str = Field(description="Id of the analysis.", examples=["a000001-77d0b3"])


class AnalysisReply(Reply):
    """An analysis: its settings, and what is finished."""

    id: str = Field(description="Id.")
    test_id: str = Field(description="Its test.")
    kind: Literal["profile", "displacement"] = Field(description="What it computes.")
    state: JobState = Field(description="State of its job.")
    job_id: str | None = Field(None, description="Its job.")
    settings: dict[str, Any] = Field(description="Settings, fixed.")
    steps_finished: list[int] = Field(description="Steps whose results can be read now.")
    summary: dict[str, Any] | None = Field(None, description="Counts, residuals and timings of each step.")


class FieldReply(Reply):
    """One variable of one step's result."""

    name: str = Field(description="Variable.")
    units: str = Field(description="Unit.")
    long_name: str = Field("", description="Meaning.")
    shape: list[int] = Field(description="Rows and columns (and further axes).")
    values: list[Any] = Field(description="Nested rows; null where the point failed.")


class ProbeReply(Reply):
    """Everything known about the measurement point nearest to a pixel."""

    row: int = Field(description="Row of the point.")
    col: int = Field(description="Column of the point.")
    step: int = Field(description="Step.")
    distance_px: float = Field(description="Distance of the pixel asked for from the point.")
    status: str = Field(description="Status of the point.")
    values: dict[str, Any] = Field(description="Its numbers; null where it failed.")


class GaugeStep(Reply):
    """What the gauges read in one step."""

    n: int = Field(description="Number of the step.")
    kind: str = Field(description="`shape` or `displacement`.")
    label: str = Field(description="The step's label.")
    load_n: float | None = Field(None, description="The step's load in newton.")
    rigid_motion: dict[str, Any] | None = Field(None, description="The motion that was taken out, with its covariance.")
    points: list[dict[str, Any]] = Field(default_factory=list, description="Values at places.")
    extensometers: list[dict[str, Any]] = Field(default_factory=list, description="Lengths, elongations, strains.")
    lines: list[dict[str, Any]] = Field(default_factory=list, description="Values along lines; null where missing.")
    areas: list[dict[str, Any]] = Field(default_factory=list, description="Statistics, with the mean's uncertainty.")
    problem: JobProblem | None = Field(None, description="Why the step has no readings.")


class GaugesReply(Reply):
    """Readings over the steps; each number with `value`, `sigma` (standard uncertainty) and `units`."""

    software_version: str = Field(description="Program that read them.")
    settings: dict[str, Any] = Field(description="The request, with its defaults.")
    inputs_sha256: dict[str, str] = Field(description="Checksum of each result file.")
    frame: str = Field(description="Frame of all positions and displacements.")
    subset_px: float = Field(description="Subset of the measurement; tells which pixels neighbours share.")
    alignment: dict[str, Any] | None = Field(None, description="The frame that was laid, and its uncertainty.")
    steps: list[GaugeStep] = Field(description="Readings of each step.")
