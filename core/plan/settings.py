"""Assumptions of a planned measurement, and differences of a planned rig from a rig file.

Requests and the command line's options derive from these models.
"""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from stereorig.core.settings import (
    ODD,
    SPACING_PX,
    STRAIN_WINDOW,
    SUBSET_PX,
    Real,
    Settings,
    SpacingPx,
    SubsetPx,
    Whole,
    disagreement,
    require_odd,
)

Positive = Annotated[Real, Field(ge=1e-3, le=1e6)]
Share = Annotated[Real, Field(ge=0.0, le=0.1)]


class PlannedMeasurement(Settings):
    """The measurement whose uncertainty is predicted."""

    subset_px: SubsetPx = SUBSET_PX.default
    spacing_px: SpacingPx = SPACING_PX.default
    strain_window: Annotated[Whole, Field(ge=STRAIN_WINDOW.low, le=STRAIN_WINDOW.high)] = Field(
        STRAIN_WINDOW.default, description="Points across the strain's gauge, odd.", json_schema_extra=ODD
    )
    image_noise_grey: Annotated[Real, Field(ge=1e-3, le=1e4)] = Field(
        2.0, description="Standard deviation of a pixel's noise, grey levels; 2 of 255 is an ordinary camera of 8 bits."
    )
    contrast_grey: Annotated[Real, Field(ge=0.1, le=1e5)] = Field(
        40.0,
        description="Standard deviation of the pattern's grey levels; 40 of 255 is a well-lit black and white one.",
    )
    speckle_px: Annotated[Real, Field(ge=1.0, le=100.0)] = Field(
        5.0,
        description="Size of the pattern's features in the image: full width at half height of its autocorrelation, "
        "taken for a Gaussian's.",
    )
    gradient_grey_per_px: Annotated[Real, Field(ge=0.05, le=1e5)] | None = Field(
        None,
        description="Root mean square of the pattern's gradient along one direction, where it is known: it takes the "
        "place of speckle_px. null: 2.35 contrast_grey / speckle_px.",
    )
    translations_mm: Annotated[list[Annotated[Real, Field(ge=0.0, le=1e3)]], Field(min_length=1, max_length=5)] = Field(
        [0.5, 2.0], description="Translations of the body, each along X, Y and Z in turn."
    )
    exposure_ms: Positive | None = Field(None, description="Exposure, for the blur by motion.")
    speed_mm_s: Positive | None = Field(None, description="Speed of the specimen, for the blur by motion.")
    length_mm: Positive = Field(10.0, description="The length whose uncertainty is predicted, about the middle.")
    area_mm: Positive = Field(5.0, description="Side of the square over which means are taken, about the middle.")

    @model_validator(mode="after")
    def _agree(self) -> Self:
        require_odd(subset_px=self.subset_px, strain_window=self.strain_window)
        if self.image_noise_grey > self.contrast_grey:
            raise disagreement("image_noise_grey is larger than contrast_grey: such a pattern shows nothing")
        return self


class PlannedRig(Settings):
    """Differences from the rig file: lens, cameras, target, stage. Values that are left out are the file's."""

    focal_mm: Positive | None = Field(None, description="Focal length of both lenses; needs pixel_um.")
    pixel_um: Annotated[Real, Field(ge=0.1, le=100.0)] | None = Field(None, description="Width of a sensor's pixel.")
    f_number: Annotated[Real, Field(ge=0.5, le=100.0)] | None = Field(
        None, description="Aperture of both lenses, for the depth of field."
    )
    phd_px: Positive | None = Field(None, description="Pinhole distance of both cameras, in place of focal_mm.")
    image_size_px: tuple[Annotated[Whole, Field(ge=16, le=32767)], Annotated[Whole, Field(ge=16, le=32767)]] | None = (
        Field(None, description="Width and height of both images.")
    )
    standoff_mm: Positive | None = Field(None, description="Distance of both cameras from the target.")
    angle_deg: Annotated[Real, Field(ge=0.1, lt=170.0)] | None = Field(
        None, description="Angle between the optical axes; each camera stands at half of it."
    )
    pitch_mm: Positive | None = Field(None, description="Pitch of the target.")
    lines: tuple[Annotated[Whole, Field(ge=4, le=1000)], Annotated[Whole, Field(ge=4, le=1000)]] | None = Field(
        None, description="Lines of a line grid along X and Y; of a board its `size`."
    )
    node_tolerance_mm: Annotated[Real, Field(ge=0.0, le=10.0)] | None = Field(
        None, description="The maker's bound on the position error of a point."
    )
    pitch_scale_sigma: Share | None = Field(None, description="Relative standard deviation of the target's pitch.")
    stage_step_sigma_mm: Annotated[Real, Field(ge=0.0, le=10.0)] | None = Field(
        None, description="Standard deviation of a position read back."
    )
    stage_scale_sigma: Share | None = Field(None, description="Relative standard deviation of the stage's travel.")
    axis_tilt_sigma_rad: Share | None = Field(
        None, description="Standard deviation of the angle between stage axis and optical axis, per direction."
    )

    @model_validator(mode="after")
    def _one_lens(self) -> Self:
        if (self.focal_mm is None) != (self.pixel_um is None):
            raise disagreement("focal_mm and pixel_um need each other")
        if self.focal_mm is not None and self.phd_px is not None:
            raise disagreement("phd_px and focal_mm state the same: give one of them")
        return self

    @property
    def pinhole_px(self) -> float | None:
        """The pinhole distance from these values; None if the file's is used."""
        if self.focal_mm is not None and self.pixel_um is not None:
            return 1e3 * self.focal_mm / self.pixel_um
        return self.phd_px
