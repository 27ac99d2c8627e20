"""Calibrations, as they travel."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StringConstraints, with_config
from typing_extensions import TypedDict

from stereorig.core.plan.settings import PlannedMeasurement, PlannedRig
from stereorig.core.settings import SUBSET_PX, Real, SpacingPx, SubsetPx, Whole
from stereorig.drivers.acquisition.simultaneity import SKEW_SOURCES, SkewSource
from stereorig.drivers.cameras.protocol import CameraIdentity
from stereorig.server.api.models.analyses import Region
from stereorig.server.api.models.calibration_checks import KeptCheck
from stereorig.server.api.models.jobs import Accepted, JobProblem
from stereorig.server.base.models import Label, Listing, Number, Reply, Request, StepNumber
from stereorig.server.documents.made import MadeState, Review
from stereorig.server.documents.results import ViewResiduals
from stereorig.server.formats.figures.card import card


class CalibrationRequest(Request):
    """Plan of a calibration; the rig file gives the parts left out."""

    positions_mm: list[Number] | None = Field(
        None, description="dZ of the positions that are fitted.", min_length=1, max_length=100
    )
    held_out_mm: list[Number] | None = Field(
        None, description="dZ of the positions kept for the check.", max_length=100
    )
    frames: Annotated[Whole, Field(ge=1, le=256)] | None = Field(None, description="Frames averaged at each position.")
    localiser: Literal["profile", "paper"] | None = Field(None, description="Grid line localiser.")
    label: Label = Field("", description="Free text.")


class RepairRequest(Request):
    """Steps from whose speckle the cameras' relative orientation is estimated again."""

    test_id: Annotated[str, StringConstraints(max_length=40)] = Field(
        description="Test that has the steps.", examples=["t000001-0c9f1e"]
    )
    steps: Annotated[list[StepNumber], Field(min_length=1, max_length=20)] = Field(
        description="Steps taken after the bump; several, at other depths and tilts, make it surer.", examples=[[0, 1]]
    )
    region: Region | None = Field(None, description="Region of the points in camera 1's images; null: all.")
    subset_px: SubsetPx = SUBSET_PX.default
    spacing_px: SpacingPx | None = Field(None, description="Distance of the points; null: as many as add information.")
    max_turn_deg: Annotated[Real, Field(gt=0.0, le=20.0)] = Field(
        5.0, description="A larger turn of one camera against the other is refused."
    )
    max_strain_microstrain: Annotated[Real, Field(gt=0.0, le=1e5)] = Field(
        1000.0, description="A larger standard uncertainty of a shape's strain from the new orientation is refused."
    )
    label: Label = Field("", description="Free text.")


class CalibrationAccepted(Accepted):
    """A calibration was begun."""

    calibration_id: str = Field(description="Id of the calibration to be.", examples=["c000001-5b02aa"])


class ExpectRequest(Request):
    """Plan of a calibration that is only predicted; the rig file gives the parts left out."""

    positions_mm: list[Number] | None = Field(
        None, description="dZ of the positions that are fitted.", min_length=1, max_length=100, examples=[[0.0, 5.0]]
    )
    held_out_mm: list[Number] | None = Field(
        None, description="dZ of the positions kept for the check; they change nothing here.", max_length=100
    )
    localiser: Literal["profile", "paper"] | None = Field(None, description="Grid line localiser.")
    noise_px: Annotated[Real, Field(ge=1e-6, le=10.0)] | None = Field(
        None, description="Standard deviation with which an intersection's coordinate is found; 0.005 if left out."
    )
    roll_deg: Annotated[Real, Field(ge=-180.0, le=180.0)] | None = Field(
        None,
        description="Turn of the grid in the images; null: as the rig's newest calibration found it; 0 without one.",
    )
    rig: PlannedRig | None = Field(
        None, description="Differences from the rig file, for a planned rig; the stage is not asked then."
    )
    measurement: PlannedMeasurement | None = Field(
        None, description="The measurement that is planned; null: the defaults of each of its fields."
    )


class ExpectedNumber(Reply):
    """A parameter and its expected uncertainty."""

    value: float = Field(description="Nominal value.", examples=[12300.0])
    sigma: float = Field(description="Expected standard deviation.", examples=[6.1])


class ExpectedPoint(Reply):
    """Uncertainty of a point that comes from the parameters."""

    name: str = Field(description="`middle`, or the corner of the target's volume.", examples=["middle"])
    xyz_mm: list[float] = Field(description="The point, system frame.", examples=[[0.0, 0.0, 0.0]])
    sigma_mm: list[float] = Field(
        description="Standard deviation of its X, Y, Z, from the calibration alone.", examples=[[2e-5, 2e-5, 3e-5]]
    )


class Assumed(Reply):
    """Assumptions of an expectation."""

    noise_px: float = Field(description="Standard deviation of an intersection's coordinate.", examples=[0.005])
    line_model: str = Field(description="Localiser of the lines.", examples=["straight"])
    roll_deg: float = Field(description="Turn of the target about the optical axis.", examples=[0.0])
    text: str = Field(description="The same in a sentence.")


class AssumedMeasurement(Reply):
    """Assumptions of the measurement's part of an expectation."""

    subset_px: int = Field(description="Subset.", examples=[33])
    spacing_px: int = Field(description="Distance of neighbouring points.", examples=[10])
    strain_window: int = Field(description="Points across the strain's gauge.", examples=[9])
    image_noise_grey: float = Field(description="Standard deviation of a pixel's noise.", examples=[2.0])
    contrast_grey: float = Field(description="Standard deviation of the pattern's grey levels.", examples=[40.0])
    gradient_grey_per_px: float = Field(description="Rms gradient along one direction that follows.", examples=[18.8])
    match_px: float = Field(
        description="Standard deviation of one comparison's shift, per direction, px.", examples=[0.0046]
    )
    text: str = Field(description="The same in a sentence.")


class PlannedQuantityReply(Reply):
    """Expected uncertainty of one quantity of a measurement, k = 1."""

    name: str = Field(
        description="`X` `Y` `Z` `u` `v` `w` `exx` `eyy` `exy`, `length along X` or `length along Y`.", examples=["w"]
    )
    of: Literal["point", "length", "mean", "strain"] = Field(
        description="A point in the middle of the target, a length, the mean over a square, a strain gauge."
    )
    unit: Literal["mm", "1"] = Field(description="Unit of its uncertainty.")
    size_mm: float | None = Field(description="Size of the length, square or gauge; null: a point.")
    translation_mm: tuple[float, float, float] | None = Field(
        description="Translation of the body since the reference; null: a quantity of its shape."
    )
    sigma: float | None = Field(description="Standard uncertainty; null if it is not known.", examples=[0.0012])
    budget: dict[str, float] = Field(
        description="The same by cause: `matching` (new at each step), `reference` (noise of the reference pair, "
        "common to all steps), `calibration`, `stage`, `target`; their squares add up. Empty if it is not known."
    )
    missing: str = Field(description="Reason why it is not known.", examples=[""])


class ExpectedView(Reply):
    """What a camera sees at its stand-off."""

    field_mm: tuple[float, float] = Field(description="Width and height of its field of view.", examples=[[175, 146]])
    um_per_px: float = Field(description="Size of a pixel on the specimen.", examples=[71.4])
    speckle_mm: tuple[float, float] = Field(description="Diameters of speckle of 3 and 5 px.", examples=[[0.21, 0.36]])
    depth_mm: tuple[float, float | None] | None = Field(
        description="Distances nearer and farther at which a point is blurred to one pixel; null: without end, or "
        "focal length and f-number are not stated."
    )
    blur_px: float | None = Field(description="Motion during the exposure; null if that or the speed is not stated.")
    photons_at_1000_lx: float | None = Field(
        description="Photons of green light that a pixel gets in the exposure from a matt white surface lit with "
        "1,000 lx; null if focal length, f-number or exposure is not stated."
    )
    missing: list[str] = Field(description="Values that are not stated.", examples=[["f_number"]])


class ExpectReply(Reply):
    """Expected uncertainty of a plan."""

    assumed: Assumed = Field(description="Assumptions.")
    parameters: dict[str, ExpectedNumber] = Field(description="Each parameter, as `cam1.phd_px`.")
    points: list[ExpectedPoint] = Field(description="The middle and the corners of the target's volume.")
    shape_rms_mm: float = Field(description="Rms error of shape over the volume, rigid motion taken out.")
    scale: float = Field(description="Standard deviation of the common scale, 1 = 100 %.")
    centre_px: float = Field(description="Largest standard deviation of an image centre.")
    standoff_relative: float = Field(description="Largest standard deviation of a standoff, relative.")
    seen_share: dict[str, float] = Field(description="Share of the intersections seen at the worst position.")
    refused: bool = Field(description="True if views at these positions would be refused.")
    reasons: list[str] = Field(description="Reasons.")
    measurement: AssumedMeasurement = Field(description="Assumptions of the quantities.")
    views: dict[str, ExpectedView] = Field(description="What each camera sees, by its name.")
    quantities: list[PlannedQuantityReply] = Field(description="Quantities of a measurement about the middle.")


class ReviewRequest(Request):
    """A decision on a calibration."""

    decision: Literal["accepted", "discarded"] | None = Field(
        description="`accepted`: to measure with by default; `discarded`: no test may be made with it; null: neither."
    )
    note: Label = Field("", description="Reason.")


class ViewReply(Reply):
    """One view of the target by one camera."""

    index: int = Field(description="Number of the stop, from 0; the second part of the image's path.")
    camera: Literal["cam1", "cam2"] = Field(description="Which camera.")
    device: CameraIdentity | None = Field(None, description="The camera that took it.")
    role: str = Field(
        description="`fitted`, `held_out`, `zero` or `zero_again`; `free`: a free pose; `first_look`: the only one, of "
        "a calibration whose target was not found before anything moved.",
        examples=["fitted"],
    )
    dz_mm: float | None = Field(
        None, description="Travel from zero, read back, positive where target and cameras part; null for a free pose."
    )
    dz_commanded_mm: float | None = Field(None, description="Travel that was asked for.")
    axis: int | None = Field(None, description="Stage axis that moved it.")
    position_mm: float | None = Field(None, description="The axis' position, read back.")
    frames: int | None = Field(None, description="Frames averaged.")
    full_scale: float | None = Field(None, description="Largest grey level that the image can hold.")
    skew_ms: float | None = Field(None, description="Difference of both cameras' exposures.")
    skew_uncertainty_ms: float | None = Field(None, description="Largest error of the skew.")
    skew_source: SkewSource | None = Field(None, description=SKEW_SOURCES)
    file: str = Field(description="Its file in the calibration's folder.", examples=["views/000_cam1.tif"])
    sha256: str = Field(description="Checksum of that file.")


class ViewList(Reply):
    """The views of a calibration."""

    views: list[ViewReply] = Field(description="In the order that they were taken; empty until all are.")


class ResidualsReply(Reply):
    """Residuals of a calibration."""

    views: list[ViewResiduals] = Field(description="Each view.")


@with_config(extra="allow")
class PlanReply(TypedDict, total=False):
    """Plan of a calibration; of an imported one its source instead of positions."""

    created_utc: Annotated[str, Field(description="Time at which it was begun or imported.")]
    label: Annotated[str, Field(description="Free text.")]
    positions_mm: Annotated[list[float], Field(description="Travels that are fitted.")]
    held_out_mm: Annotated[list[float], Field(description="Travels that are kept for the check.")]
    frames: Annotated[int, Field(description="Frames averaged at each position.")]
    localiser: Annotated[Literal["profile", "paper"], Field(description="Localiser of the lines.")]
    source: Annotated[str | None, Field(description="Format that an imported calibration was read as.")]
    job_id: Annotated[str | None, Field(description="The job that takes or took it.")]
    repaired_from: Annotated[str | None, Field(description="Calibration that it was repaired from, which is kept.")]
    test_id: Annotated[str | None, Field(description="Test whose steps it was repaired from.")]
    steps: Annotated[list[int] | None, Field(description="Those steps.")]


class VerdictReply(Reply):
    """Verdict on a calibration's quality."""

    level: Literal["good", "warning", "failed"] = Field(description="The verdict.")
    reasons: list[str] = Field(description="Reasons of the verdict.")


def _own_verdict(value: object) -> object:
    # a file from elsewhere may hold anything by that name
    return value if isinstance(value, VerdictReply) or (isinstance(value, dict) and "level" in value) else None


class CalibrationReply(Reply):
    """A calibration: its plan, and once complete everything in calibration.json; also if a verdict refused it."""

    id: str = Field(description="Id.")
    state: MadeState = Field(description="Only `complete` ones can be measured with.")
    plan: PlanReply = Field(description="Positions, frames and localiser asked for.")
    taken: list[ViewReply] | None = Field(None, description="Views taken, each as in GET /calibrations/{id}/views.")
    problem: JobProblem | None = Field(None, description="Problem that left no calibration.")
    verdict: Annotated[VerdictReply | None, BeforeValidator(_own_verdict)] = Field(
        None, description="Its verdict; null: none, as of most imported ones."
    )
    review: Review | None = Field(None, description="The operator's decision; null: none yet.")
    kept_checks: dict[str, KeptCheck] | None = Field(
        None, description="Checks made since, by name, `known_distance` among them; null: none."
    )

    def _repr_html_(self) -> str:
        verdict = self.verdict
        level, reasons = (None, "") if verdict is None else (verdict.level, "; ".join(verdict.reasons))
        return card(f"Calibration {self.id}", [("state", self.state), ("verdict", level), ("reasons", reasons)])


class CalibrationFile(Reply):
    """calibration.json, which `stereorig measure` reads; its statistics are added to these."""

    cam1: dict[str, float] | None = Field(None, description="Camera 1: its parameters by name, the unit in the name.")
    cam2: dict[str, float] | None = Field(None, description="Camera 2.")
    image_size_px: dict[str, list[int]] | None = Field(None, description="Width and height of each camera's images.")
    imported: dict[str, object] | None = Field(
        None, description="Another program's file, whole, in place of the above; its contents are that program's."
    )


class CalibrationEntry(Reply):
    """Entry of a calibration in a list."""

    id: str = Field(description="Id.", examples=["c000001-5b02aa"])
    state: MadeState = Field(description="Only `complete` ones can be measured with.")
    label: str = Field(description="Free text.")
    created_utc: str = Field(description="Time at which it was begun or imported.")
    verdict: VerdictReply | None = Field(description="Its verdict; null: none, as of most imported ones.")
    decision: str | None = Field(None, description="`accepted`, `discarded`; null: no decision.")


class CalibrationList(Listing):
    """Calibrations, oldest first."""

    calibrations: list[CalibrationEntry] = Field(description="Short entry of each.")


class ConversionReply(Reply):
    """Losses of a calibration in another program's form."""

    format: str = Field(description="The form.", examples=["vic3d"])
    software: str = Field(description="This program and its version.")
    source: str = Field(description="Format that it was read as.", examples=["calibration_json"])
    source_sha256: str = Field(description="Checksum of calibration.json.")
    units: str = Field(description="Unit of the numbers.")
    frame: Literal["target", "camera 1"] = Field(description="System frame of the file.")
    image_size_px: list[list[int]] | None = Field(description="Width and height of both images; null: not known.")
    exact: bool = Field(description="True if both lenses were carried over to the last digits.")
    lens: dict[str, dict[str, float]] = Field(
        description="By camera, the difference of both lens models over the image.",
        examples=[{"cam1": {"rms_px": 0.016, "max_px": 0.065}, "cam2": {"rms_px": 0.013, "max_px": 0.051}}],
    )
    read_back: dict[str, float | int | None] = Field(
        description="Errors of the written file at points that both cameras see: epipolar residual, error in space.",
        examples=[{"points": 370, "rms_px": 2e-12, "max_px": 5e-12, "rms_mm": 5e-13, "max_mm": 2e-12}],
    )
    notes: list[str] = Field(description="Assumptions.")
