"""Checks of a calibration that a user asks for, as they travel."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import ConfigDict, Field, StringConstraints, model_validator

from stereorig.core.calibration.checks.distance import MARK_SIGMA_PX
from stereorig.core.names import CameraName
from stereorig.core.settings import Pixel, Real
from stereorig.server.base.models import Reply, Request, StepNumber, one_of
from stereorig.server.results.certificate.plan import StatedTarget

Mark = tuple[Pixel, Pixel]
Positive = Annotated[Real, Field(gt=0.0, le=1e9, allow_inf_nan=False)]
NotNegative = Annotated[Real, Field(ge=0.0, le=1e9, allow_inf_nan=False)]


class Marks(Request):
    """Two marks in both cameras' images."""

    cam1: tuple[Mark, Mark] = Field(description="Both marks in camera 1.", examples=[[[82.0, 120.0], [170.0, 121.5]]])
    cam2: tuple[Mark, Mark] = Field(description="The same two, in the same order, in camera 2.")


class TargetOfStep(Request):
    """A target of known size in a step's pair of images."""

    test_id: Annotated[str, StringConstraints(max_length=40)] = Field(description="Id of the test.")
    n: StepNumber = Field(description="Number of the step.")
    target: StatedTarget = Field(
        description="The target, as in a rig file; another than the one that was calibrated with."
    )


class DistanceRequest(Request):
    """A known distance: two marks, or a target of known size."""

    model_config = ConfigDict(json_schema_extra=one_of("points_px", "step"))

    points_px: Marks | None = Field(None, description="Two marks; needs distance_mm.")
    distance_mm: Positive | None = Field(None, description="Known distance of the marks.", examples=[6.0])
    step: TargetOfStep | None = Field(None, description="A target in a step's images, instead of two marks.")
    distance_sigma_mm: NotNegative = Field(0.0, description="Standard deviation of the known distance.")
    point_sigma_px: NotNegative = Field(MARK_SIGMA_PX, description="Standard deviation of the marks' coordinates.")

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if (self.points_px is None) == (self.step is None):
            raise ValueError("give points_px or step")
        return self


class DistanceReply(Reply):
    """A measured against a known distance; kept with the calibration."""

    measured_mm: float = Field(description="Measured distance; for a target, between its two outermost points.")
    known_mm: float = Field(description="Known distance.")
    ratio: float = Field(description="Measured over known.", examples=[1.00012])
    sigma_mm: float = Field(description="Standard uncertainty of the difference.")
    agrees: bool = Field(description="True within three standard uncertainties.")
    text: str = Field(description="The finding in a sentence.")
    points: int = Field(description="Marks measured.")
    residual_mm: float | None = Field(description="Rms distance of a target's points from its description.")
    covariance_known: bool = Field(description="False where the calibration's own uncertainty is not known.")
    measured_on: dict[str, object] = Field(description="Marks, or test, step and target.")
    checked_utc: str = Field(description="Time of the check.")
    software_version: str = Field(description="Version that made it.")


class DifferenceReply(Reply):
    """A difference and its prediction."""

    value: float = Field(description="The difference.")
    sigma: float | None = Field(description="Standard deviation that both covariances predict; null: not known.")


class ChangeReply(Reply):
    """A difference of the cameras."""

    name: str = Field(description="Name, with its unit at the end.", examples=["relative_orientation_deg"])
    value: float = Field(description="B minus A.")
    sigma: float | None = Field(description="Its standard deviation; null: not known.")


class ExplanationReply(Reply):
    """A possible cause, and the disagreement that it leaves unexplained."""

    cause: str = Field(
        description="`scale`, `camera_moved`, `focal_length`, `image_centre`, `distortion` or `lens`.",
        examples=["camera_moved"],
    )
    camera: str | None = Field(description="Its camera; null: both, or their relative pose.")
    chi_square: float = Field(description="Chi-square of the other numbers.")
    degrees: int = Field(description="Their number.")
    probability: float = Field(description="Probability of so much.")


class ChangesReply(Reply):
    """Differences of the cameras and their likely cause."""

    numbers: list[ChangeReply] = Field(description="Scale, relative orientation, baseline, focal lengths, centres.")
    explanations: list[ExplanationReply] = Field(description="Causes, the likeliest first.")
    explained: bool = Field(description="True if the first explains the whole difference.")
    text: str = Field(description="The cause in a sentence.")


class ComparisonReply(Reply):
    """Two calibrations of one rig, compared in space."""

    points: int = Field(description="Points of the common volume.")
    shape_rms_mm: DifferenceReply = Field(description="Rms difference of shape, rigid motion taken out.")
    shape_max_mm: DifferenceReply = Field(description="Largest difference of a point.")
    scale: DifferenceReply = Field(description="Relative difference of size.")
    epipolar_rms_px: DifferenceReply = Field(description="Rms distance from the other's epipolar lines, camera 2.")
    epipolar_max_px: DifferenceReply = Field(description="Largest of these distances.")
    chi_square: float | None = Field(description="Chi-square of all differences by both covariances; null: not known.")
    degrees: int | None = Field(description="Its degrees of freedom: the parameters less the frame.")
    probability: float | None = Field(description="Probability of so much by chance.")
    unexplained_px: float = Field(description="Rms image difference that no parameter makes, as of two lens models.")
    shared: list[str] = Field(
        description="`target`, `stage`, `aspect`: parts that both declare alike and that are taken for the same; their "
        "errors cancel."
    )
    agrees: bool | None = Field(description="Verdict; null where a covariance is not known.")
    changes: ChangesReply = Field(description="What changed.")
    text: str = Field(description="The finding in a sentence.")


class AspectReply(Reply):
    """Aspect ratio of one camera, from images of the line grid."""

    aspect: float = Field(description="Rows' scale over columns' scale.", examples=[0.9617])
    sigma: float = Field(description="Its standard deviation.")
    images: int = Field(description="Images used.")
    tilt_rad: float = Field(description="Largest tilt of the grid; an upper bound without the stand-off.")
    tilt_sigma_rad: float = Field(description="Its standard deviation.")
    tilt_effect: float = Field(description="The most by which the tilts change the aspect ratio.")
    standoff_known: bool = Field(description="True if the tilt is an angle and no bound.")
    text: str = Field(description="The finding in a sentence.")


class CameraGeometry(Reply):
    """A calibrated camera before the target's plane."""

    focal_length_mm: float | None = Field(
        description="Distance of pinhole and sensor; null: the rig file does not state the width of a pixel."
    )
    standoff_mm: float = Field(description="From the pinhole along the optical axis to the plane.")
    field_of_view_mm: tuple[float, float] | None = Field(
        description="Width and height of the part of the plane in the image; null: image size not known."
    )
    scale_mm_per_px: tuple[float, float] = Field(description="On the plane, along the rows and down the columns.")


class GeometryReply(Reply):
    """Geometry of a calibrated rig."""

    stereo_angle_deg: float = Field(description="Between the optical axes.")
    baseline_mm: float = Field(description="Between the pinholes.")
    cameras: dict[CameraName, CameraGeometry] | None = Field(
        description="Before the plane Z = 0 at its origin, the target's of a calibration made here; where a camera "
        "does not see that, at the place where the optical axes come nearest to each other; null: neither is seen."
    )
    parameters: dict[CameraName, dict[str, float]] = Field(
        description="Parameters of each camera's lens and place, by name with the unit, another program's included."
    )


class KeptCheck(Reply):
    """A check made of a calibration after it was made; the check's own numbers are added to these."""

    agrees: bool = Field(description="Its finding.")
    text: str = Field(description="The same in a sentence.")
    checked_utc: str = Field(description="Time of the check.")
